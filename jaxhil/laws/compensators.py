"""Tables of the compensators in JAX, and their gains by the literature's rules.

Simulation, tuning, gain files and the command line use the compensators in these tables: those of this
package's folders, and those that `jaxhil.register` adds.
"""

from importlib import import_module
from typing import Any

from jaxhil.laws import built_in_compensators
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism


def _load_compensators(axes: int) -> dict[str, Compensator]:
    return {
        name: import_module(f"jaxhil.laws.{name}.simulation").COMPENSATOR
        for name in built_in_compensators(axes)
    }


COMPENSATORS = _load_compensators(1)
SIX_AXIS_COMPENSATORS = _load_compensators(6)  # each treats the channels of the wrench separately


def get_compensator(name: str) -> Compensator:
    """Return the compensator with this name, for one axis or for six. Raise KeyError if there is none."""
    return COMPENSATORS[name] if name in COMPENSATORS else SIX_AXIS_COMPENSATORS[name]


def literature_gains(
    mechanism: Mechanism | SixAxisMechanism, compensator: str, setting: str | None = None
) -> dict[str, float]:
    """Return the gains by the literature's rules for a mechanism, or one of the compensator's settings.

    Args:
        mechanism: mechanism with its rig.
        compensator: name of the compensator.
        setting: name of the setting; its gains are limited to their bounds for the mechanism.

    Raises:
        KeyError: if there is no such compensator or setting.
    """
    law = get_compensator(compensator)
    chosen = law.settings[setting] if setting is not None else {}
    # For six axes the rules read only the force sensor and the control period, which both classes have.
    source: Any = mechanism
    gains = {}
    for gain in law.gains:
        value = float(gain.nominal(source))
        if gain.name in chosen:
            value = min(max(float(gain.lower(source)), chosen[gain.name]), float(gain.upper(source)))
        gains[gain.name] = value
    return gains
