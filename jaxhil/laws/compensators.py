"""Tables of the compensators in JAX, by name, and the gains that the literature's rules give them.

Simulation, tuning, gain files and the command line know the compensators entered here: those of this
package's folders, and those that `jaxhil.register` adds.
"""

from importlib import import_module
from typing import Any

from jaxhil.laws import names
from jaxhil.laws.simulation_base import Compensator
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism


def _table(axes: int) -> dict[str, Compensator]:
    return {name: import_module(f"jaxhil.laws.{name}.simulation").COMPENSATOR for name in names(axes)}


COMPENSATORS = _table(1)
SIX_AXES = _table(6)  # each works on the channels of the wrench one by one


def compensator_of(name: str) -> Compensator:
    """Return the compensator of a name, for one axis or for six. Raise KeyError for an unknown name."""
    return COMPENSATORS[name] if name in COMPENSATORS else SIX_AXES[name]


def literature_gains(
    mechanism: Mechanism | SixAxisMechanism, compensator: str, setting: str | None = None
) -> dict[str, float]:
    """Return the gains by the literature's rules for a mechanism, or one of the compensator's settings.

    A setting's gains are moved into the bounds that the mechanism has for them. Raise KeyError for a setting
    that the compensator does not have.
    """
    law = compensator_of(compensator)
    chosen = law.settings[setting] if setting is not None else {}
    # In six axes the rules read the force sensor and the control period alone.
    known: Any = mechanism
    gains = {}
    for gain in law.gains:
        value = float(gain.nominal(known))
        if gain.name in chosen:
            value = min(max(float(gain.lower(known)), chosen[gain.name]), float(gain.upper(known)))
        gains[gain.name] = value
    return gains
