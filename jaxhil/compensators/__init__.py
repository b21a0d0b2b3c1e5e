"""The registry of compensators: tests, tuning, gain files and the command line pick them up from here."""

from jaxhil.compensators.base import Compensator, Constants, Gain, Gains, Signals
from jaxhil.compensators.none import NoCompensator
from jaxhil.compensators.phase_lead import PhaseLead
from jaxhil.compensators.response_error import ResponseError

COMPENSATORS: dict[str, Compensator] = {
    compensator.name: compensator for compensator in (NoCompensator(), PhaseLead(), ResponseError())
}

__all__ = ["COMPENSATORS", "Compensator", "Constants", "Gain", "Gains", "Signals"]
