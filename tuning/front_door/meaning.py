"""What a mechanism means, said before work on it begins; refused where that work would never end."""

from collections.abc import Callable

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.six_axes import SixAxisMechanism
from tuning import terminal


def check(mechanism: AnyMechanism, label: str | None = None) -> None:
    """No contact, nominal or drawn, takes more ticks than can be run; in six axes the nominal run can begin.
    Raises `InputError`; imports jax."""
    if isinstance(mechanism, SixAxisMechanism):
        from jaxhil.sixdof.building import build_scenarios
        from jaxhil.sixdof.plausibility import check_scenario

        check_scenario(mechanism, build_scenarios(mechanism))
        return
    from jaxhil.simulation.plausibility import check_run

    check_run(mechanism, label, drawn=True)


def say(mechanism: AnyMechanism, tell: Callable[[str], None] | None) -> None:
    """`tell`, if anybody, in one line what a mechanism means; warn on standard error of what can hardly be
    meant. Imports jax. In six axes `jaxhil simulate` says it, of the run it makes."""
    if isinstance(mechanism, SixAxisMechanism):
        return
    from jaxhil.simulation.plausibility import meaning

    found = meaning(mechanism)
    if tell is not None:
        tell(found.line(mechanism.name))
    terminal.warn(f"{mechanism.name}: {warning}" for warning in found.warnings)
