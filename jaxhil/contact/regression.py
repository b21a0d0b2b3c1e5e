"""Contact laws as linear combinations of known functions, for fits to logs by linear regression."""

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
    """Contact law F = sum_i c_i phi_i(d, d') with unknown coefficients c_i and known functions phi_i.

    Parameters on which the functions depend nonlinearly (exponent, depths) have fixed values (`shape`).
    """

    name: str  # name of the law in mechanism files
    # functions phi(d [m], d' [m/s]) whose coefficients differ between the entries of `stiffness`
    entry_functions: BasisFunctions = field(repr=False)
    names: tuple[str, ...]  # names of the coefficients of `entry_functions`, then of `shared`
    # functions phi(d [m], d' [m/s]) whose coefficients are common to all entries
    shared: BasisFunctions = field(repr=False, default=_no_functions)
    pulls: bool = False  # whether the force may be negative
    shape: dict[str, Any] = field(default_factory=dict)  # fixed values by key, for example {"exponent": 1.5}

    @property
    def complexity(self) -> int:
        """Return the number of unknowns of one contact: coefficients, depths and exponent."""
        return len(self.names) + len(self.shape.get("depths", ())) + ("exponent" in self.shape)


class RegressionFamily(NamedTuple):
    """Regressions of one contact law that differ in one nonlinear parameter, such as an exponent.

    Identification chooses the value of this parameter between `low` and `high`.
    """

    make: Callable[[float], Regression]  # returns the regression for a value of the parameter
    low: float = 0.0  # smallest value
    high: float = 0.0  # largest value; equal to `low` if there is no such parameter
    preferred: tuple[float, ...] = ()  # values that identification prefers if they fit equally well
