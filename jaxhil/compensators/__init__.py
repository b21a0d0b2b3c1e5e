"""The registry of compensators: simulation, tuning, gain files and the command line know those entered here.

A compensator of this package is the module of its name, here and in `jaxhil.runtime.laws`, and an entry in
either registry. `jaxhil.register` enters those of other packages.
"""

from typing import Any

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, Signals
from jaxhil.compensators.dead_zone_observer import DeadZoneObserver
from jaxhil.compensators.impulse_ledger import ImpulseLedger
from jaxhil.compensators.multi_parameter_lead import MultiParameterLead
from jaxhil.compensators.none import NoCompensator
from jaxhil.compensators.passivity import Passivity
from jaxhil.compensators.phase_lead import PhaseLead
from jaxhil.compensators.phase_lead_per_axis import PhaseLeadPerAxis
from jaxhil.compensators.position_lead import PositionLead
from jaxhil.compensators.response_error import ResponseError
from jaxhil.compensators.smith_hybrid import SmithHybrid
from jaxhil.compensators.smith_predictor import SmithPredictor
from jaxhil.compensators.virtual_contact import VirtualContact
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.mechanism.structs import Mechanism

_BUILT_IN = (
    NoCompensator(),
    PhaseLead(),
    MultiParameterLead(),
    SmithPredictor(),
    SmithHybrid(),
    PositionLead(),
    VirtualContact(),
    DeadZoneObserver(),
    Passivity(),
    ResponseError(),
    ImpulseLedger(),
)
COMPENSATORS: dict[str, Compensator] = {law.name: law for law in _BUILT_IN}
# Those of six axes, which work on each channel of the wrench by itself.
SIX_AXES: dict[str, Compensator] = {
    law.name: law for law in (NoCompensator(), PhaseLead(), PhaseLeadPerAxis())
}


def compensator_of(name: str) -> Compensator:
    """The compensator of a name, of one axis or of six. Raises KeyError for an unknown name."""
    return COMPENSATORS[name] if name in COMPENSATORS else SIX_AXES[name]


def literature_gains(
    mechanism: Mechanism | SixAxisMechanism, compensator: str, setting: str | None = None
) -> dict[str, float]:
    """What the literature's rules set the gains of a compensator to, for a mechanism; or one of its settings,
    within the bounds that the mechanism has for it.

    Raises KeyError for a setting that the compensator does not have.
    """
    law = compensator_of(compensator)
    chosen = law.settings[setting] if setting is not None else {}
    # Of six axes they are asked for force sensor and control period alone.
    known: Any = mechanism
    found = {}
    for gain in law.gains:
        value = float(gain.nominal(known))
        if gain.name in chosen:
            value = min(max(float(gain.lower(known)), chosen[gain.name]), float(gain.upper(known)))
        found[gain.name] = value
    return found


__all__ = [
    "COMPENSATORS",
    "SIX_AXES",
    "Compensator",
    "Constants",
    "Gain",
    "Gains",
    "Signals",
    "compensator_of",
    "literature_gains",
]
