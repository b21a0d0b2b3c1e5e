"""What a mechanism means, said before work on it begins; refused where that work would never end."""

from collections.abc import Callable

from jaxhil.mechanism.structs import Mechanism
from tuning import terminal


def check(mechanism: Mechanism, label: str | None = None) -> None:
    """No contact, nominal or drawn, takes more ticks than can be run. Raises `InputError`; imports jax."""
    from jaxhil.simulation.plausibility import check_run

    check_run(mechanism, label, drawn=True)


def say(mechanism: Mechanism, tell: Callable[[str], None] | None) -> None:
    """`tell`, if anybody, in one line what a mechanism means; warn on standard error of what can hardly be
    meant. Imports jax."""
    from jaxhil.simulation.plausibility import meaning

    found = meaning(mechanism)
    if tell is not None:
        tell(found.line(mechanism.name))
    terminal.warn(f"{mechanism.name}: {warning}" for warning in found.warnings)
