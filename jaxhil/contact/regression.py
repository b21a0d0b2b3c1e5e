"""Contact laws as sums of known functions of depth and rate, so that fits to logs are linear regressions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Regression", "RegressionFamily"]

BasisFunctions = Callable[[np.ndarray, np.ndarray], list[np.ndarray]]


def _no_functions(depth: np.ndarray, rate: np.ndarray) -> list[np.ndarray]:
    return []


@dataclass(frozen=True)
class Regression:
    """Contact law F = sum_i c_i phi_i(d, d') with a fixed shape (an exponent, depths)."""

    name: str  # name of the law in mechanism files
    entry_functions: BasisFunctions = field(
        repr=False
    )  # phi(d [m], d' [m/s]) whose coefficients differ between entries
    names: tuple[str, ...]  # names of the coefficients of `own`, then of `shared`
    shared: BasisFunctions = field(
        repr=False, default=_no_functions
    )  # phi with coefficients common to all entries
    pulls: bool = False  # whether the force may be negative
    shape: dict[str, Any] = field(default_factory=dict)  # keys of the mechanism file that fix the shape

    @property
    def complexity(self) -> int:
        """Return the number of unknowns for one list entry: coefficients, depths and exponent."""
        return len(self.names) + len(self.shape.get("depths", ())) + ("exponent" in self.shape)


class RegressionFamily(NamedTuple):
    """Regressions of one contact law that differ in one number, the shape, which a fit chooses."""

    make: Callable[[float], Regression]  # returns the regression of a shape
    low: float = 0.0  # smallest shape that the fit tries
    high: float = 0.0  # largest shape that the fit tries; equal to `low` if the shape is fixed
    preferred: tuple[float, ...] = ()  # shapes that are preferred if they fit equally well
