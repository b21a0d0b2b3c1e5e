"""Tables of all compensators in JAX, and their gains by the rules of the literature.

Simulation, tuning, gain files and the command line use the compensators in these tables: the built-in
compensators and all that `jaxhil.register` adds.
"""

from importlib import import_module
from typing import Any

from jaxhil.laws import built_in_compensators, module_name
from jaxhil.laws.simulation_base import Compensator
from jaxhil.laws.six_axis_base import SixAxisCompensator
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism


def _load_compensators(axes: int) -> dict[str, Any]:
    return {name: import_module(module_name(name, axes)).COMPENSATOR for name in built_in_compensators(axes)}


COMPENSATORS: dict[str, Compensator] = _load_compensators(1)
SIX_AXIS_COMPENSATORS: dict[str, SixAxisCompensator] = _load_compensators(6)


def get_compensator(name: str, axes: int = 1) -> Compensator | SixAxisCompensator:
    """Return the compensator with this name. Raise KeyError if there is none.

    If `axes` is 6, or if the compensator has no version for 1 axis, return the version for 6 axes.
    """
    return SIX_AXIS_COMPENSATORS[name] if axes == 6 or name not in COMPENSATORS else COMPENSATORS[name]


def axes_of(mechanism: Mechanism | SixAxisMechanism) -> int:
    """Return a mechanism's number of axes, 1 or 6."""
    return 6 if isinstance(mechanism, SixAxisMechanism) else 1


def literature_gains(
    mechanism: Mechanism | SixAxisMechanism, compensator: str, setting: str | None = None
) -> dict[str, float]:
    """Return a compensator's gains for a mechanism, by the rules of the literature.

    Args:
        mechanism: mechanism with its rig.
        compensator: name of the compensator.
        setting: name of one of the compensator's settings, or None. The gains of the setting, clipped to
            their bounds for the mechanism, replace the gains of the literature.

    Raises:
        KeyError: if there is no such compensator or setting.
    """
    law = get_compensator(compensator, axes_of(mechanism))
    chosen = law.settings[setting] if setting is not None else {}
    source: Any = mechanism  # the rules of a compensator accept only its class of mechanism
    gains = {}
    for gain in law.gains:
        value = float(gain.nominal(source))
        if gain.name in chosen:
            value = min(max(float(gain.lower(source)), chosen[gain.name]), float(gain.upper(source)))
        gains[gain.name] = value
    return gains
