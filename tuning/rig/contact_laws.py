"""Contact laws in plain floats: the force of one contact against penetration d > 0 and its rate d'.

For loops that run tick by tick in real time; `jaxhil.contact.laws` has the same laws for batches.
"""

from collections.abc import Callable
from typing import NamedTuple

from jaxhil.mechanism.structs import Contact

Formula = Callable[[float, float], float]


class ContactLaw(NamedTuple):
    """One contact's law: functions of penetration d [m] and rate d' [m/s]."""

    force: Formula  # [N] at d > 0; 0 where the surfaces let go
    hold: Formula  # [N or 1]; positive as long as penetrated surfaces hold on to each other
    edge: Callable[[float], float]  # [N], of d' alone: the limit of the force as d goes to 0 from above
    # of a law that remembers, the law after a deepest penetration [m]; that of 0 is the law as new
    loaded: "Callable[[float], ContactLaw] | None" = None


def contact_law(contact: Contact, number: int) -> ContactLaw:
    """The law of successive contact `number` (from 0); the last entry of every list repeats."""
    stiffness = contact.stiffness[min(number, len(contact.stiffness) - 1)]
    damping = contact.damping[min(number, len(contact.damping) - 1)]
    if isinstance(stiffness, list):
        return _piecewise_linear(stiffness, contact.depths, damping)
    if contact.law == "hunt_crossley":
        return _hunt_crossley(stiffness, damping, contact.exponent)
    if contact.law == "hardening" and contact.reference_depth is not None:
        return _hardening(stiffness, damping, contact.reference_depth)
    if contact.law == "depth_damped" and contact.reference_depth is not None:
        return _depth_damped(stiffness, damping, contact.exponent, contact.reference_depth)
    if contact.law == "elastoplastic" and contact.unloading_ratio is not None:
        return _elastoplastic(stiffness, contact.unloading_ratio, 0.0)
    if contact.law == "preloaded":
        return _preloaded(contact.preload, stiffness, contact.friction)
    if contact.law == "linear":
        return _kelvin_voigt(stiffness, 0.0, False)
    return _kelvin_voigt(stiffness, damping, contact.tension)


def _kelvin_voigt(stiffness: float, damping: float, tension: bool) -> ContactLaw:
    """F = k d + b d', clamped at 0 unless tension is allowed."""

    def spring(depth: float, rate: float) -> float:
        return stiffness * depth + damping * rate

    if tension:
        return ContactLaw(spring, lambda depth, rate: 1.0, lambda rate: damping * rate)
    return _clamped(spring, lambda rate: damping * rate)


def _hunt_crossley(stiffness: float, damping: float, exponent: float) -> ContactLaw:
    """F = k d^n (1 + (3/2) chi d') >= 0."""

    def hold(depth: float, rate: float) -> float:
        return 1.0 + 1.5 * damping * rate

    def force(depth: float, rate: float) -> float:
        factor = 1.0 + 1.5 * damping * rate
        return stiffness * depth**exponent * factor if factor > 0.0 else 0.0

    return ContactLaw(force, hold, lambda rate: 0.0)


def _piecewise_linear(slopes: list[float], depths: list[float], damping: float) -> ContactLaw:
    """F = f(d) + b d' >= 0, f(0) = 0, of slope k_i between depths d_(i-1) and d_i; the last slope goes on."""
    pieces, start, level = [], 0.0, 0.0
    for slope, end in zip(slopes, [*depths, float("inf")], strict=True):
        pieces.append((end, start, level, slope))
        level += slope * (end - start)
        start = end

    def spring(depth: float, rate: float) -> float:
        for end, start, level, slope in pieces:
            if depth <= end:
                return level + slope * (depth - start) + damping * rate
        raise ValueError("the penetration is not a number")

    return _clamped(spring, lambda rate: damping * rate)


def _hardening(stiffness: float, damping: float, reference_depth: float) -> ContactLaw:
    """F = k d (1 + (d/d_0)^2) + b d' >= 0."""

    def spring(depth: float, rate: float) -> float:
        return stiffness * depth * (1.0 + (depth / reference_depth) ** 2) + damping * rate

    return _clamped(spring, lambda rate: damping * rate)


def _depth_damped(stiffness: float, damping: float, exponent: float, reference_depth: float) -> ContactLaw:
    """F = k d^n + b d' d/d_0 >= 0."""

    def hold(depth: float, rate: float) -> float:
        """F/d; outside, its damping's part alone, but for a linear spring, which has no end there."""
        return stiffness * max(depth, 0.0) ** (exponent - 1.0) + damping * rate / reference_depth

    def force(depth: float, rate: float) -> float:
        value = stiffness * depth**exponent + damping * rate * (depth / reference_depth)
        return value if value > 0.0 else 0.0

    return ContactLaw(force, hold, lambda rate: 0.0)


def _elastoplastic(stiffness: float, unloading_ratio: float, deepest: float) -> ContactLaw:
    """F = k d_max - k_u (d_max - d) >= 0, k_u = r k, after the penetration d_max; k d beyond it."""

    def spring(depth: float, rate: float) -> float:
        if depth >= deepest:
            return stiffness * depth
        return stiffness * deepest - stiffness * unloading_ratio * (deepest - depth)

    def loaded(depth: float) -> ContactLaw:
        return _elastoplastic(stiffness, unloading_ratio, depth)

    return _clamped(spring, lambda rate: 0.0)._replace(loaded=loaded)


def _preloaded(preload: float, stiffness: float, friction: float) -> ContactLaw:
    """F = F_0 + k d + F_r sign(d') >= 0."""

    def constant(rate: float) -> float:
        return preload + friction * ((rate > 0.0) - (rate < 0.0))

    def spring(depth: float, rate: float) -> float:
        return constant(rate) + stiffness * depth

    return _clamped(spring, constant)


def _clamped(spring: Formula, edge: Callable[[float], float]) -> ContactLaw:
    def force(depth: float, rate: float) -> float:
        value = spring(depth, rate)
        return value if value > 0.0 else 0.0

    def limit(rate: float) -> float:
        value = edge(rate)
        return value if value > 0.0 else 0.0

    return ContactLaw(force, spring, limit)
