"""A contact law in plain floats, for loops that run tick by tick in real time."""

from collections.abc import Callable
from typing import NamedTuple

__all__ = ["FloatLaw", "clamped"]

Formula = Callable[[float, float], float]


class FloatLaw(NamedTuple):
    """One contact's law: functions of penetration d [m] and rate d' [m/s]."""

    force: Formula  # [N] at d > 0; 0 where the surfaces let go
    hold: Formula  # [N or 1]; positive as long as penetrated surfaces hold on to each other
    edge: Callable[[float], float]  # [N], of d' alone: the limit of the force as d goes to 0 from above
    # of a law that remembers, the law after a deepest penetration [m]; that of 0 is the law as new
    loaded: "Callable[[float], FloatLaw] | None" = None


def clamped(spring: Formula, edge: Callable[[float], float]) -> FloatLaw:
    """Return the law whose force is that of `spring`, but never negative; `edge` is its limit at d = 0."""

    def force(depth: float, rate: float) -> float:
        value = spring(depth, rate)
        return value if value > 0.0 else 0.0

    def limit(rate: float) -> float:
        value = edge(rate)
        return value if value > 0.0 else 0.0

    return FloatLaw(force, spring, limit)
