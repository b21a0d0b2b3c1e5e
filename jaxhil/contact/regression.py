"""Contact laws as sums of known functions of depth and rate, which makes their fits to logs linear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Family", "Regression"]

Functions = Callable[[np.ndarray, np.ndarray], list[np.ndarray]]


def _nothing(depth: np.ndarray, rate: np.ndarray) -> list[np.ndarray]:
    return []


@dataclass(frozen=True)
class Regression:
    """One law with its shape (an exponent, depths) fixed: F = sum_i c_i phi_i(d, d')."""

    name: str  # in mechanism files
    own: Functions = field(repr=False)  # of depth [m] and rate [m/s], a coefficient per entry
    names: tuple[str, ...]  # of the coefficients of `own`, then of `shared`
    shared: Functions = field(repr=False, default=_nothing)  # the same for all entries
    pulls: bool = False  # whether the force may be negative
    shape: dict[str, Any] = field(default_factory=dict)  # keys of the mechanism file that make the shape

    @property
    def complexity(self) -> int:
        """Numbers to find with one entry of the list: coefficients, and those of the shape."""
        return len(self.names) + len(self.shape.get("depths", ())) + ("exponent" in self.shape)


class Family(NamedTuple):
    """Regressions of one law among which a fit chooses by one number, its shape."""

    make: Callable[[float], Regression]  # of the shape
    low: float = 0.0  # least and greatest shape that the fit tries; equal if there is nothing to choose
    high: float = 0.0
    usual: tuple[float, ...] = ()  # shapes that are preferred if they explain as much
