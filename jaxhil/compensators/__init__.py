"""The registry of compensators: tests, tuning, gain files and the command line pick them up from here."""

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, Signals
from jaxhil.compensators.multi_parameter_lead import MultiParameterLead
from jaxhil.compensators.none import NoCompensator
from jaxhil.compensators.phase_lead import PhaseLead
from jaxhil.compensators.response_error import ResponseError
from jaxhil.compensators.smith_hybrid import SmithHybrid
from jaxhil.compensators.smith_predictor import SmithPredictor
from jaxhil.mechanism import Mechanism

COMPENSATORS: dict[str, Compensator] = {
    compensator.name: compensator
    for compensator in (
        NoCompensator(),
        PhaseLead(),
        MultiParameterLead(),
        SmithPredictor(),
        SmithHybrid(),
        ResponseError(),
    )
}


def literature_gains(mechanism: Mechanism, compensator: str) -> dict[str, float]:
    """What the literature's rules set the gains of a compensator to, for a mechanism."""
    return {gain.name: float(gain.nominal(mechanism)) for gain in COMPENSATORS[compensator].gains}


__all__ = ["COMPENSATORS", "Compensator", "Constants", "Gain", "Gains", "Signals", "literature_gains"]
