"""Prior standard deviations of the impulse ledger's parameters, from the uncertainty in a mechanism file."""

import math

from jaxhil.laws.impulse_ledger.rig import MAX_DELAY_SPREAD
from jaxhil.laws.shared.nominal_values import typical_stiffness
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism

DELAY = "rig.force_sensor.delay"


def delay_spread(mechanism: Mechanism) -> float:
    """Return the force delay's standard deviation [s] in the file, limited to 4 ms; 0 if it states none."""
    uncertainty = mechanism.uncertainty.get(DELAY)
    is_range = uncertainty is not None and uncertainty.std is None
    spread = _spread(mechanism, DELAY)
    return min(spread / math.sqrt(3) if is_range else spread, MAX_DELAY_SPREAD)


def scaled_force(mechanism: Mechanism, path: str) -> float:
    """Return the largest force that the file permits for a key, divided by mass and approach speed [1/s]."""
    size = abs(value_at(mechanism, path)) + _spread(mechanism, path)
    return size / (mechanism.bodies.mass * mechanism.approach.velocity)


def unloading(mechanism: Mechanism) -> float:
    """Return the file's largest unloading minus loading stiffness, divided by mass [1/s^2].

    Return 0 if the contact law has no unloading ratio.
    """
    ratio = mechanism.contact.unloading_ratio
    if ratio is None:
        return 0.0
    excess = ratio + _spread(mechanism, "contact.unloading_ratio") - 1
    return excess * typical_stiffness(mechanism) / mechanism.bodies.mass


def _spread(mechanism: Mechanism, path: str) -> float:
    """Return a number's `std` in the file, or its distance from the farther bound; 0 without uncertainty."""
    uncertainty = mechanism.uncertainty.get(path)
    if uncertainty is None:
        return 0.0
    if uncertainty.std is not None:
        return uncertainty.std
    nominal = value_at(mechanism, path)
    factors = [factor * nominal for factor in uncertainty.factor or ()]
    ends = factors or [end for end in (uncertainty.low, uncertainty.high) if end is not None]
    return max(abs(end - nominal) for end in ends)
