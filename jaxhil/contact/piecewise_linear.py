"""Piecewise-linear contact law: the stiffness changes at given depths, as in buffers and hard stops."""

from itertools import pairwise
from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import clamp_force
from jaxhil.contact.keys import DEPTHS
from jaxhil.contact.regression import Regression, RegressionFamily


class PiecewiseLinear(ContactLaw):
    """Contact law F = max(0, sum_i k_i s_i(d) + b d'), where s_i(d) is the part of d within segment i.

    Segment i extends from the depth d_{i-1} to d_i (d_0 = 0), the last segment to infinity. The depths are
    `depths` [m]; `stiffness` contains the slopes k_i [N/m]; b is `damping` [N s/m].
    """

    name: ClassVar[str] = "piecewise_linear"
    keys: ClassVar = (DEPTHS,)
    is_segmented: ClassVar[bool] = True

    def step(self, parameters, state, penetration, rate):
        force = self.separation_function(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def separation_function(self, parameters, state, penetration, rate):
        segments = parameters.stiffness.shape[0]
        force = parameters.damping * rate
        for i in range(segments):
            overlap = penetration if i == 0 else penetration - parameters.depths[i - 1]
            overlap = jnp.where(overlap > 0, overlap, 0)
            if i < segments - 1:
                lower = 0 if i == 0 else parameters.depths[i - 1]
                overlap = jnp.minimum(overlap, parameters.depths[i] - lower)
            force = force + parameters.stiffness[i] * overlap
        return force

    def breakpoints(self, parameters, state):
        return tuple(parameters.depths)

    def onset_force(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(force > 0, force, 0)

    def ideal_contact(self, parameters, mass, velocity):
        from jaxhil.contact.ideal_contact import ideal_piecewise_linear

        return ideal_piecewise_linear(
            mass, parameters.stiffness, parameters.depths, parameters.damping, velocity
        )

    def undamped_peak_force(self, parameters, mass, velocity):
        """Return the peak force [N], where the segments together store the kinetic energy.

        A segment with the slope k that stores the energy E raises the force from F to sqrt(F^2 + 2 k E).
        """
        stiffness, depths = parameters.stiffness, parameters.depths
        slots, segments = stiffness.shape[:2]
        energy = np.broadcast_to(mass * velocity**2 / 2, (slots, stiffness.shape[-1]))
        force, begin = np.zeros_like(energy), np.zeros_like(energy)
        for segment in range(segments):
            slope = stiffness[:, segment]
            width = depths[:, segment] - begin if segment < segments - 1 else np.inf
            whole = force * width + slope * width**2 / 2
            spent = np.minimum(whole, energy)
            force = np.sqrt(force**2 + 2 * slope * spent)
            energy, begin = energy - spent, begin + width
        return force

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add 2 zeta sqrt(k M) to `damping`, where zeta is `ratio`, k the first slope and M `mass`."""
        return "damping", drawn("damping") + 2 * ratio * np.sqrt(drawn("stiffness") * mass)

    def as_float_law(self, contact, stiffness, damping):
        segments, start, level = [], 0.0, 0.0
        for slope, end in zip(stiffness, [*contact.depths, float("inf")], strict=True):
            segments.append((end, start, level, slope))
            level += slope * (end - start)
            start = end

        def spring(depth: float, rate: float) -> float:
            for end, start, level, slope in segments:
                if depth <= end:
                    return level + slope * (depth - start) + damping * rate
            raise ValueError("penetration: found NaN, expected a number")

        return clamp_force(spring, lambda rate: damping * rate)

    def regression(self, contact):
        return _regression(tuple(contact.depths))

    def families(self, deepest, entries):
        return [RegressionFamily(lambda depth: _regression((depth,)), 0.1 * deepest, 0.9 * deepest)]

    def coefficients(self, contact, stiffness, damping):
        return [*stiffness, damping]

    def file_values(self, fitted, entry):
        return {f"contact.stiffness.{entry}.{i}": slope for i, slope in enumerate(fitted.values())}


def _regression(depths: tuple[float, ...]) -> Regression:
    """Return the regression F = sum_i k_i s_i(d) + b d' with the unknown coefficients k_i and b.

    s_i(d) is the part of d within segment i; `depths` [m] separate the segments.
    """
    bounds = np.array([0.0, *depths, np.inf])

    def overlaps(d, v):
        return [np.clip(d - low, 0.0, high - low) for low, high in pairwise(bounds)]

    slopes = tuple(f"slope{i + 1}" for i in range(len(depths) + 1))
    names, shape = (*slopes, "damping"), {"depths": list(depths)}
    return Regression("piecewise_linear", overlaps, names, lambda d, v: [v], shape=shape)
