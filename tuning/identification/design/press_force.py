"""Contact force of a mechanism in a press run, and the preload of the run."""

from typing import Any

import numpy as np
from scipy import optimize

from jaxhil.mechanism.structs import Mechanism
from tuning.identification import mechanism_models

PRELOAD_SHARE = 0.45  # mean force of a press run as a share of the largest allowed force
LIMIT_SHARE = 0.9  # maximum used share of the limits of speed, acceleration and force


def compute_force(mechanism: Mechanism, depth: np.ndarray, rate: float = 0.0) -> np.ndarray:
    """Return the contact force [N] at each depth [m], for one rate of change of the depth [m/s]."""
    law = mechanism_models.make_regression_law(mechanism.contact)
    numbers = mechanism_models.get_regression_coefficients(mechanism.contact, 0)
    return np.array(numbers) @ np.array(law.entry_functions(depth, np.full_like(depth, rate)))


def differentiate_force(mechanism: Mechanism, depth: float) -> tuple[float, float]:
    """Differentiate the force at a depth [m] with respect to depth [N/m] and to rate [N s/m]."""
    step = 1e-3 * depth
    low, high = compute_force(mechanism, np.array([depth - step, depth + step]))
    back, forth = (float(compute_force(mechanism, np.array([depth]), rate)[0]) for rate in (-step, step))
    return float(high - low) / (2.0 * step), (forth - back) / (2.0 * step)


def find_preload(mechanism: Mechanism) -> tuple[float, float]:
    """Return the depth [m] at the mean force of a press run, and the largest allowed force [N].

    A press run keeps the mechanism pressed against the surface. The force must exceed neither the sensor's
    range nor the peak force of a contact at the approach speed.
    """
    energy = 0.5 * mechanism.bodies.mass * mechanism.approach.velocity**2

    def excess_energy(depth: float) -> float:
        grid = np.linspace(0.0, depth, 400)
        return float(np.trapezoid(compute_force(mechanism, grid), grid)) - energy

    upper = 1e-6
    while excess_energy(upper) < 0.0:
        upper *= 2.0
    deepest: Any = optimize.brentq(excess_energy, 0.0, upper)
    greatest = min(
        float(compute_force(mechanism, np.array([deepest]))[0]),
        LIMIT_SHARE * mechanism.rig.force_sensor.range,
    )
    pressed: Any = optimize.brentq(
        lambda depth: float(compute_force(mechanism, np.array([depth]))[0]) - PRELOAD_SHARE * greatest,
        0.0,
        deepest,
    )
    return float(pressed), greatest
