"""Contact laws as sums of known functions of depth and rate: what makes their fits linear.

A law with its shape fixed (an exponent, depths at which the slope changes) is F = sum_i c_i phi_i(d, d'); the
coefficients are stiffness and damping. One `Law` for each law of mechanism files that can be told from logs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

Functions = Callable[[np.ndarray, np.ndarray], list[np.ndarray]]


@dataclass(frozen=True)
class Law:
    """One law with its shape fixed."""

    name: str  # in mechanism files
    own: Functions = field(repr=False)  # of depth [m] and rate [m/s], a coefficient per entry
    shared: Functions = field(repr=False)  # the same for all entries
    names: tuple[str, ...]  # of the coefficients of `own`, then of `shared`
    pulls: bool = False  # whether the force may be negative
    shape: dict[str, Any] = field(default_factory=dict)  # keys of the mechanism file that make the shape

    @property
    def complexity(self) -> int:
        """Numbers to find with one entry of the list: coefficients, and those of the shape."""
        return len(self.names) + len(self.shape.get("depths", ())) + ("exponent" in self.shape)


def _nothing(depth, rate):
    return []


def linear() -> Law:
    """F = k d."""
    return Law("linear", lambda d, v: [d], _nothing, ("stiffness",))


def kelvin_voigt(pulls: bool = False) -> Law:
    """F = k d + b d', clamped at 0 unless it pulls."""
    shape = {"tension": True} if pulls else {}
    return Law("kelvin_voigt", lambda d, v: [d], lambda d, v: [v], ("stiffness", "damping"), pulls, shape)


def hunt_crossley(exponent: float) -> Law:
    """F = k d^n (1 + 1.5 chi d'): coefficients k and k chi."""
    return Law(
        "hunt_crossley",
        lambda d, v: [d**exponent, 1.5 * v * d**exponent],
        _nothing,
        ("stiffness", "damping"),
        shape={"exponent": exponent},
    )


def hardening() -> Law:
    """F = k d + k d^3/d_0^2 + b d': coefficients k, k/d_0^2 and b."""
    return Law("hardening", lambda d, v: [d, d**3], lambda d, v: [v], ("stiffness", "cubic", "damping"))


def depth_damped(exponent: float, reference_depth: float) -> Law:
    """F = k d^n + (b/d_0) d d'."""
    return Law(
        "depth_damped",
        lambda d, v: [d**exponent],
        lambda d, v: [d * v / reference_depth],
        ("stiffness", "damping"),
        shape={"exponent": exponent, "reference_depth": reference_depth},
    )


def piecewise_linear(depths: tuple[float, ...]) -> Law:
    """Slopes k_1, k_2 ... between the depths, plus b d'."""
    edges = np.array([0.0, *depths, np.inf])

    def own(d, v):
        return [np.clip(d - low, 0.0, high - low) for low, high in pairwise(edges)]

    slopes = tuple(f"slope{i + 1}" for i in range(len(depths) + 1))
    return Law(
        "piecewise_linear", own, lambda d, v: [v], (*slopes, "damping"), shape={"depths": list(depths)}
    )
