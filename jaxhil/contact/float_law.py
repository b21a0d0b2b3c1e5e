"""Contact laws in Python floats, for loops that run tick by tick in real time."""

from collections.abc import Callable
from typing import NamedTuple

__all__ = ["FloatLaw", "clamp_force"]

ForceFunction = Callable[[float, float], float]


class FloatLaw(NamedTuple):
    """Contact law of one contact, as functions of the penetration d [m] and its rate d' [m/s]."""

    force: ForceFunction  # force [N] at d > 0; 0 where the surfaces separate
    # positive until the surfaces separate (`ContactLaw.separation_function`)
    separation_function: ForceFunction
    # limit of the force [N] as d goes to 0 from above, a function of d' only
    onset_force: Callable[[float], float]
    # only for a law with memory: returns the law for a deepest penetration so far [m] (0 before contact)
    loaded_law: "Callable[[float], FloatLaw] | None" = None


def clamp_force(spring: ForceFunction, onset_force: Callable[[float], float]) -> FloatLaw:
    """Return a contact law whose force is `spring` [N], clamped at 0.

    `onset_force` is the limit of `spring` as the penetration goes to 0, a function of the rate [m/s].
    """

    def force(depth: float, rate: float) -> float:
        value = spring(depth, rate)
        return value if value > 0.0 else 0.0

    def limit(rate: float) -> float:
        value = onset_force(rate)
        return value if value > 0.0 else 0.0

    return FloatLaw(force, spring, limit)
