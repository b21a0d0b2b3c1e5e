"""Contact of the oracle: force law, time segments with one smooth formula, work and peak force.

Contact, separation, slope changes and turning points are roots found by brentq; they divide the time axis
into segments.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from math import inf, isfinite
from typing import Any

import numpy as np
from oracle_motion import polynomial
from scipy.integrate import quad
from scipy.optimize import brentq, minimize_scalar

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = (_NODES + 1.0) / 2.0, _WEIGHTS / 2.0
# s -> 3 s^2 - 2 s^3 flattens the integrand at both ends: d^1.5 becomes smooth there.
SMOOTH_NODES = _NODES**2 * (3.0 - 2.0 * _NODES)
SMOOTH_WEIGHTS = _WEIGHTS * 6.0 * _NODES * (1.0 - _NODES)


class Law:
    """Contact law: force(d, d') without the clamp at zero, and depths at which the formula changes."""

    def __init__(self, contact, plane=0.0):
        self.kind, self.plane = contact["law"], plane
        kinds = ("linear", "kelvin_voigt", "hunt_crossley", "piecewise_linear")
        if self.kind not in (*kinds, "hardening", "depth_damped", "elastoplastic", "preloaded"):
            raise ValueError(f"unknown contact law {self.kind!r}")
        self.stiffness = _as_list(contact["stiffness"])
        self.damping = [0.0] if self.kind == "linear" else _as_list(contact.get("damping", 0.0))
        self.scale, self.ratio = contact.get("reference_depth"), contact.get("unloading_ratio")
        self.preload, self.friction = contact.get("preload", 0.0), contact.get("friction", 0.0)
        self.deepest = 0.0  # largest depth of the current surface, which the elastoplastic law needs
        self.exponent = contact.get("exponent", 1.5)
        self.depths = _as_list(contact.get("depths", [])) if self.kind == "piecewise_linear" else []
        self.tension = bool(contact.get("tension", False)) and self.kind == "kelvin_voigt"
        clearance = contact.get("clearance")
        self.clearance = inf if clearance is None else clearance

    def parameters(self, index):
        return (
            self.stiffness[min(index, len(self.stiffness) - 1)],
            self.damping[min(index, len(self.damping) - 1)],
        )

    def clamped(self, index):
        if self.kind in ("elastoplastic", "preloaded"):
            return True
        return self.parameters(index)[1] != 0.0 and not self.tension

    def damped(self):
        return any(self.damping) or self.friction > 0.0

    def levels(self):
        """Return the positions at which the formula may change."""
        levels = [0.0, *self.depths]
        far = [-self.clearance - depth for depth in levels] if isfinite(self.clearance) else []
        return [self.plane + level for level in (*levels, *far)]

    def side(self, position):
        depth = position - self.plane
        return 1 if depth > 0.0 else (-1 if depth < -self.clearance else 0)

    def penetration(self, position, side):
        depth = position - self.plane
        return depth if side > 0 else -self.clearance - depth

    def raw(self, depth, rate, index, deepest=0.0):
        stiffness, damping = self.parameters(index)
        depth = np.maximum(depth, 0.0)
        if self.kind == "hunt_crossley":
            return stiffness * depth**self.exponent * (1.0 + 1.5 * damping * rate)
        if self.kind == "piecewise_linear":
            edges = [0.0, *self.depths, inf]
            force = damping * rate
            for slope, low, high in zip(stiffness, edges[:-1], edges[1:], strict=True):
                force = force + slope * np.clip(depth - low, 0.0, high - low)
            return force
        if self.kind == "hardening":
            return stiffness * (depth + depth**3 / self.scale**2) + damping * rate
        if self.kind == "depth_damped":
            return depth * self.sign_of(depth, rate, index)
        if self.kind == "elastoplastic":
            # Two lines through the point of deepest penetration; max selects the loading line.
            peak = np.maximum(depth, deepest)
            return stiffness * (peak - self.ratio * (peak - depth))
        return self.preload + stiffness * depth + damping * rate + self.friction * np.sign(rate)

    def sign_of(self, depth, rate, index, deepest=0.0):
        """Return a value with the sign of the unclamped force, without the factor d^n, which would hide the
        root.
        """
        if self.kind == "hunt_crossley":
            return 1.0 + 1.5 * self.parameters(index)[1] * rate + 0.0 * depth
        if self.kind == "depth_damped":
            stiffness, damping = self.parameters(index)
            return stiffness * np.maximum(depth, 0.0) ** (self.exponent - 1.0) + damping * rate / self.scale
        return self.raw(depth, rate, index, deepest)


@dataclass
class Piece:
    """Time segment with one smooth formula of the force (0 if `side` is 0)."""

    origin: float  # ticks
    length: float
    theta: tuple
    position: np.ndarray
    velocity: np.ndarray  # coefficients in theta [m/s]
    side: int
    index: int
    deepest: float  # at the beginning of the segment
    law: Law = field(repr=False)

    @property
    def start(self):
        return self.origin + self.theta[0] * self.length

    @property
    def end(self):
        return self.origin + self.theta[1] * self.length

    def motion(self, theta):
        return polynomial(self.position)(theta), polynomial(self.velocity)(theta)

    def force(self, theta):
        """Return the contact force: positive at the surface at 0, negative at the surface at -clearance."""
        if self.side == 0:
            return np.zeros_like(np.asarray(theta, float))
        x, v = self.motion(theta)
        depth = self.law.penetration(x, self.side)
        return self.side * self.law.raw(depth, self.side * v, self.index, self.deepest)

    def force_at(self, time):
        theta = (time - self.origin) / self.length
        return float(self.force(min(max(theta, self.theta[0]), self.theta[1])))


class Work:
    """Work [J] done against the surface and by the surface, and largest force [N], of one contact."""

    def __init__(self, law, period):
        self.law, self.period = law, period
        self.jump_position = None
        self.begin()

    def begin(self):
        self.peak = self.work_in = self.work_out = self.duration = 0.0

    def jump(self, position, index):
        """Return the work along a jump of the position (ideal simulator, zero-order hold, undamped law)."""
        before, self.jump_position = self.jump_position, position
        if before is None or before == position:
            return
        for side in (1, -1):
            if side < 0 and not isfinite(self.law.clearance):
                continue
            d1, d2 = (max(0.0, self.law.penetration(p, side)) for p in (before, position))
            edges = sorted({d1, d2, *(e for e in self.law.depths if min(d1, d2) < e < max(d1, d2))})
            for low, high in pairwise(edges):
                work = quad(lambda d: float(self.law.raw(d, 0.0, index)), low, high, epsrel=1e-12)[0]
                if d2 > d1:
                    self.work_in += work
                else:
                    self.work_out += work

    def add(self, piece):
        a, b = piece.theta
        self.duration += (b - a) * piece.length * self.period
        theta = a + (b - a) * SMOOTH_NODES
        _, v = piece.motion(theta)
        power = piece.force(theta) * v * SMOOTH_WEIGHTS * (b - a) * piece.length * self.period
        inward = np.sum(power)  # v has constant sign on a segment
        if np.sum(v) * piece.side > 0.0:
            self.work_in += inward
        else:
            self.work_out -= inward
        theta = np.concatenate([[a], theta, [b]])
        magnitude = np.abs(piece.force(theta))
        best = int(np.argmax(magnitude))
        if magnitude[best] > self.peak:
            self.peak = float(magnitude[best])
            bounds = theta[max(best - 1, 0)], theta[min(best + 1, len(theta) - 1)]
            if 0 < best < len(theta) - 1 and bounds[1] > bounds[0]:
                minimum: Any = minimize_scalar(
                    lambda s: -abs(float(piece.force(s))),
                    bounds=bounds,
                    method="bounded",
                    options={"xatol": 1e-10},
                )
                self.peak = max(self.peak, -float(minimum.fun))


def cut(position, velocity, a, b, law, index):
    """Divide theta in [a, b] where the force's formula changes: [((start, end), side, reached, deepest)].

    `side` is 1 or -1 if the near or far surface exerts a force, otherwise 0; `reached` tells whether the
    position is beyond a surface. `deepest` is the law's value at the beginning of the segment; at the end the
    law has the value of the last segment.
    """

    x, v = polynomial(position), polynomial(velocity)
    near, far = law.plane, law.plane - law.clearance
    reach = float(np.sum(np.abs(position[1:])))
    if far < position[0] - reach and position[0] + reach < near:
        law.deepest = 0.0
        return [((a, b), 0, False, 0.0)]
    turning = [a, *_roots(v, a, b), b]
    cuts = {a, b, *turning}
    for low, high in pairwise(turning):
        dent = [law.plane + law.deepest, law.plane - law.clearance - law.deepest]
        dent = dent if law.kind == "elastoplastic" else []
        for level in [
            *law.levels(),
            *(d for d in dent if isfinite(d)),
        ]:  # x is monotonic here, so there is at most one root
            cuts.update(_roots(lambda s, level=level: x(s) - level, low, high, samples=1))
    cuts = sorted(cuts)
    pieces = []
    for low, high in pairwise(cuts):
        side = law.side(x((low + high) / 2.0))
        edges = [low, high]
        clamped = side != 0 and law.clamped(index)

        def sign(s, side=side):
            return law.sign_of(law.penetration(x(s), side), side * v(s), index, law.deepest)

        if side == 0:
            law.deepest = 0.0
        if clamped:
            edges = [low, *_roots(sign, low, high), high]
        for start, end in pairwise(edges):
            if end - start <= 1e-14:
                continue
            active = side if not clamped or sign((start + end) / 2.0) > 0.0 else 0
            pieces.append(((start, end), active, side != 0, law.deepest))
        if side != 0:
            law.deepest = max(law.deepest, law.penetration(x(high), side))
    return pieces


def _roots(function, a, b, samples=8):
    """Return the sign changes of a smooth function in (a, b), each refined to rounding."""
    grid = np.array([*(a + k * ((b - a) / samples) for k in range(samples)), b])
    values = function(grid)
    roots = []
    for low, high, f_low, f_high in zip(grid[:-1], grid[1:], values[:-1], values[1:], strict=True):
        if f_low * f_high < 0.0:
            root: Any = brentq(function, low, high, xtol=1e-15)
            roots.append(float(root))
        elif f_high == 0.0 and high < b:
            roots.append(float(high))
    return roots


def _as_list(value):
    return list(value) if isinstance(value, (list, tuple)) else [value]
