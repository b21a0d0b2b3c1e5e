"""The controller as it runs on the rig: plain Python floats, a fixed order of operations, no jax.

`Controller.from_file(path)` reads a gain file and refuses one that does not fit; `step` is then
called once per control period. Each compensator is one file and enters itself in
`registry.COMPENSATORS`, so that a bundle may concatenate `controller`, one compensator and what
the two import, and nothing else.
"""

from . import multi_parameter_lead, none, phase_lead, response_error, smith_hybrid, smith_predictor
from .controller import Controller
from .errors import GainFileError
from .gain_file import digest
from .registry import COMPENSATORS

__all__ = [
    "COMPENSATORS",
    "Controller",
    "GainFileError",
    "digest",
    "multi_parameter_lead",
    "none",
    "phase_lead",
    "response_error",
    "smith_hybrid",
    "smith_predictor",
]
