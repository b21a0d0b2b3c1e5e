"""Prior standard deviations of the impulse ledger's estimates, from the uncertainty in a mechanism file."""

import math

from jaxhil.laws.impulse_ledger.rig import LARGEST_DELAY_SPREAD
from jaxhil.laws.shared.nominal_values import typical_stiffness
from jaxhil.mechanism.structs import Mechanism, value_at


def delay_spread(mechanism: Mechanism) -> float:
    """Return the standard deviation [s] of the force delay in the file, at most 4 ms; 0 if it has none."""
    uncertainty = mechanism.uncertainty.get("rig.force_sensor.delay")
    if uncertainty is None:
        return 0.0
    spread = uncertainty.std
    if spread is None:
        spread = (_spread(mechanism, "rig.force_sensor.delay") or 0.0) / math.sqrt(3)
    return min(spread, LARGEST_DELAY_SPREAD)


def friction(mechanism: Mechanism) -> float:
    """Return the largest dry friction over mass and approach speed [1/s]; 0 if there is none."""
    return _size(mechanism, "contact.friction") / (mechanism.bodies.mass * mechanism.approach.velocity)


def preload(mechanism: Mechanism) -> float:
    """Return the largest preload over mass and approach speed [1/s]; 0 if there is none."""
    return _size(mechanism, "contact.preload") / (mechanism.bodies.mass * mechanism.approach.velocity)


def unloading(mechanism: Mechanism) -> float:
    """Return the largest excess of unloading over loading stiffness, over mass [1/s^2]; 0 without a ratio."""
    ratio = mechanism.contact.unloading_ratio
    if ratio is None:
        return 0.0
    spread = _spread(mechanism, "contact.unloading_ratio") or 0.0
    return (ratio + spread - 1) * typical_stiffness(mechanism) / mechanism.bodies.mass


def _size(mechanism: Mechanism, path: str) -> float:
    """Return the largest size of a number: its nominal size plus its spread."""
    return abs(value_at(mechanism, path)) + (_spread(mechanism, path) or 0.0)


def _spread(mechanism: Mechanism, path: str, deviations: float = 1.0) -> float | None:
    """Return the largest difference of a number from its nominal value; None if the file states none.

    It is that of the farther end of the number's range, or so many standard `deviations`.
    """
    uncertainty = mechanism.uncertainty.get(path)
    if uncertainty is None:
        return None
    if uncertainty.std is not None:
        return deviations * uncertainty.std
    nominal = value_at(mechanism, path)
    if uncertainty.factor is not None:
        ends = [factor * nominal for factor in uncertainty.factor]
    else:
        ends = [end for end in (uncertainty.low, uncertainty.high) if end is not None]
    return max(abs(end - nominal) for end in ends)
