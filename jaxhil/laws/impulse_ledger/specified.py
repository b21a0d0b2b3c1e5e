"""Prior standard deviations of the impulse ledger's estimates, from the uncertainty in a mechanism file."""

import math

from jaxhil.laws.impulse_ledger.rig import LARGEST_DELAY_SPREAD
from jaxhil.laws.shared.estimates import typical_stiffness
from jaxhil.mechanism.structs import Mechanism, value_at


def delay_spread(mechanism: Mechanism) -> float:
    """Return the standard deviation [s] that the file states for the force delay, at most 4 ms; else 0."""
    stated = mechanism.uncertainty.get("rig.force_sensor.delay")
    if stated is None:
        return 0.0
    spread = stated.std
    if spread is None:
        spread = (_spread(mechanism, "rig.force_sensor.delay") or 0.0) / math.sqrt(3)
    return min(spread, LARGEST_DELAY_SPREAD)


def friction(mechanism: Mechanism) -> float:
    """How large the contact's dry friction may be, over mass and approach speed [1/s]; 0 where it has
    none."""
    return _size(mechanism, "contact.friction") / (mechanism.bodies.mass * mechanism.approach.velocity)


def preload(mechanism: Mechanism) -> float:
    """How large the contact's preload may be, over mass and approach speed [1/s]; 0 where it has none."""
    return _size(mechanism, "contact.preload") / (mechanism.bodies.mass * mechanism.approach.velocity)


def unloading(mechanism: Mechanism) -> float:
    """Return by how much the stiffness over the mass [1/s^2] may be larger in unloading than in loading.

    It is 0 where the contact law has no unloading ratio.
    """
    ratio = mechanism.contact.unloading_ratio
    if ratio is None:
        return 0.0
    spread = _spread(mechanism, "contact.unloading_ratio") or 0.0
    return (ratio + spread - 1) * typical_stiffness(mechanism) / mechanism.bodies.mass


def _size(mechanism: Mechanism, path: str) -> float:
    """Return how far a number may lie from 0: its nominal value and its spread."""
    return abs(value_at(mechanism, path)) + (_spread(mechanism, path) or 0.0)


def _spread(mechanism: Mechanism, path: str, deviations: float = 1.0) -> float | None:
    """How far a number may lie from its nominal value: the farther end of the range that the file gives it,
    or so many standard deviations; None where it says nothing of that."""
    found = mechanism.uncertainty.get(path)
    if found is None:
        return None
    if found.std is not None:
        return deviations * found.std
    nominal = value_at(mechanism, path)
    if found.factor is not None:
        ends = [factor * nominal for factor in found.factor]
    else:
        ends = [end for end in (found.low, found.high) if end is not None]
    return max(abs(end - nominal) for end in ends)
