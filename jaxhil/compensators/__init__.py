"""The registry of compensators: tests, tuning, gain files and the command line pick them up from here.

Which laws there are says `jaxhil.runtime.laws`; each is the module of its name.
"""

from collections.abc import Callable
from importlib import import_module
from typing import cast

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, Signals
from jaxhil.mechanism import Mechanism
from jaxhil.runtime.laws import LAWS


def _law(name: str) -> Compensator:
    """The compensator called `name`, the one of that name in its module."""
    members = vars(import_module(f"{__name__}.{name}")).values()
    laws = [member for member in members if isinstance(member, type) and issubclass(member, Compensator)]
    [law] = [one for one in laws if vars(one).get("name") == name]
    return cast(Callable[[], Compensator], law)()


COMPENSATORS: dict[str, Compensator] = {name: _law(name) for name in LAWS}


def literature_gains(mechanism: Mechanism, compensator: str) -> dict[str, float]:
    """What the literature's rules set the gains of a compensator to, for a mechanism."""
    return {gain.name: float(gain.nominal(mechanism)) for gain in COMPENSATORS[compensator].gains}


__all__ = ["COMPENSATORS", "Compensator", "Constants", "Gain", "Gains", "Signals", "literature_gains"]
