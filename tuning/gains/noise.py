"""Amplification of the force sensor's noise by a compensator, computed from the gains only."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxhil.laws.compensators import COMPENSATORS, axes_of
from jaxhil.laws.simulation_base import Compensator, KnownConstants


def has_noise_trade_off(compensator: str) -> bool:
    """Return whether a compensator's amplification of sensor noise depends on its gains."""
    law = COMPENSATORS.get(compensator)
    return law is not None and type(law).noise_amplification is not Compensator.noise_amplification


def compute_noise_amplification(mechanism: Any, compensator: str, gains: Mapping[str, float]) -> float:
    """Return a compensator's amplification of force sensor noise [1]; 1 for a six-axis mechanism."""
    if axes_of(mechanism) != 1:
        return 1.0
    period, clearance = mechanism.rig.control_period, mechanism.contact.clearance
    # With NumPy's numbers, JAX need not compile a program for each operation.
    numbers: Any = np.asarray(period), np.asarray(clearance)
    constants = KnownConstants(*numbers)
    values: Any = {name: np.asarray(value) for name, value in gains.items()}
    return float(COMPENSATORS[compensator].noise_amplification(values, constants))
