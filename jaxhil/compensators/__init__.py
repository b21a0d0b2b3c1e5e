"""The registry of compensators: tests, tuning, gain files and the command line pick them up from here.

Which laws there are says `jaxhil.runtime.laws`; each is the module of its name.
"""

from collections.abc import Callable
from importlib import import_module
from typing import cast

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, Signals
from jaxhil.mechanism.structs import Mechanism
from jaxhil.runtime.laws import LAWS


def _law(name: str) -> Compensator:
    """The compensator called `name`, the one of that name in its module."""
    members = vars(import_module(f"{__name__}.{name}")).values()
    laws = [member for member in members if isinstance(member, type) and issubclass(member, Compensator)]
    [law] = [one for one in laws if vars(one).get("name") == name]
    return cast(Callable[[], Compensator], law)()


COMPENSATORS: dict[str, Compensator] = {name: _law(name) for name in LAWS}


def literature_gains(mechanism: Mechanism, compensator: str, setting: str | None = None) -> dict[str, float]:
    """What the literature's rules set the gains of a compensator to, for a mechanism; or one of its settings,
    within the bounds that the mechanism has for it.

    Raises KeyError for a setting that the compensator does not have.
    """
    law = COMPENSATORS[compensator]
    chosen = law.settings[setting] if setting is not None else {}
    found = {}
    for gain in law.gains:
        value = float(gain.nominal(mechanism))
        if gain.name in chosen:
            value = min(max(float(gain.lower(mechanism)), chosen[gain.name]), float(gain.upper(mechanism)))
        found[gain.name] = value
    return found


__all__ = ["COMPENSATORS", "Compensator", "Constants", "Gain", "Gains", "Signals", "literature_gains"]
