"""Contact laws: the force of a docking mechanism against penetration d > 0 and its rate d'.

A law is a pure function of the motion and of a state of its own (`init`, `step`). The laws here are
memoryless: their state is empty. All forces are zero for d <= 0 and, unless tension is allowed, never
negative. Shapes: every argument broadcasts to the batch shape; slopes and depths of the piecewise-linear
law carry a leading axis of segments.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.reference import Reference, hunt_crossley, kelvin_voigt, piecewise_linear


class ContactParameters(NamedTuple):
    """What a law needs of one contact; a leading axis of contacts, where there is one, comes first.

    stiffness [N/m, or N/m^n for Hunt-Crossley; (segments, ...) for piecewise-linear], damping [N s/m,
    or chi in s/m for Hunt-Crossley], exponent [1], depths [m, (segments - 1, ...)], tension [bool].
    """

    stiffness: Float[Array, "..."]
    damping: Float[Array, "..."]
    exponent: Float[Array, "..."]
    depths: Float[Array, "..."]
    tension: Bool[Array, "..."]


class ContactLaw(eqx.Module):
    """Interface of all contact laws."""

    def init(self, penetration: Array) -> tuple[Array, ...]:
        """State before the first touch, for a batch shaped like `penetration`."""
        return ()

    @abc.abstractmethod
    def step(
        self,
        parameters: ContactParameters,
        state: tuple[Array, ...],
        penetration: Array,
        rate: Array,
    ) -> tuple[Array, tuple[Array, ...]]:
        """Force [N] at `penetration` [m] and `rate` [m/s], and the next state."""

    @abc.abstractmethod
    def edge(self, parameters: ContactParameters, rate: Array) -> Array:
        """Limit of the force [N] as the penetration goes to 0 from above: the jump of a damped touch."""

    @abc.abstractmethod
    def hold(
        self, parameters: ContactParameters, state: tuple[Array, ...], penetration: Array, rate: Array
    ) -> Array:
        """Smooth and positive as long as penetrated surfaces hold on to each other, else not: they let go
        where it goes through 0. The force before its clamp, or anything of its sign."""

    @abc.abstractmethod
    def reference(self, parameters: ContactParameters, mass: Array, velocity: Array) -> Reference:
        """The same contact in space, entered at `velocity` [m/s]: see `jaxhil.reference`."""


class KelvinVoigt(ContactLaw):
    """F = k d + b d', clamped at 0 unless tension is allowed; with b = 0 the linear law F = k d."""

    def step(self, parameters, state, penetration, rate):
        force = parameters.stiffness * penetration + parameters.damping * rate
        force = jnp.where(parameters.tension | (force > 0), force, 0)
        return jnp.where(penetration > 0, force, 0), state

    def edge(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(parameters.tension | (force > 0), force, 0)

    def hold(self, parameters, state, penetration, rate):
        force = parameters.stiffness * penetration + parameters.damping * rate
        return jnp.where(parameters.tension, 1, force)

    def reference(self, parameters, mass, velocity):
        return kelvin_voigt(mass, parameters.stiffness, parameters.damping, velocity, parameters.tension)


class HuntCrossley(ContactLaw):
    """F = k d^n (1 + (3/2) chi d'), n = 1.5 for Hertz (Hunt and Crossley 1975)."""

    def step(self, parameters, state, penetration, rate):
        # The inner `where` keeps the derivative of d^n finite at d <= 0.
        touching = penetration > 0
        depth = jnp.where(touching, penetration, 1)
        force = parameters.stiffness * depth**parameters.exponent
        force = force * (1 + 1.5 * parameters.damping * rate)
        return jnp.where(touching & (force > 0), force, 0), state

    def edge(self, parameters, rate):
        return jnp.zeros_like(rate)

    def hold(self, parameters, state, penetration, rate):
        return 1 + 1.5 * parameters.damping * rate

    def reference(self, parameters, mass, velocity):
        return hunt_crossley(mass, parameters.stiffness, parameters.exponent, parameters.damping, velocity)


class PiecewiseLinear(ContactLaw):
    """Slopes k_1, k_2, ... between depths d_1 < d_2 < ...; F = sum_i k_i overlap_i(d) + b d' >= 0.

    Segment i spans d_{i-1} to d_i (d_0 = 0); the last slope goes on.
    """

    def step(self, parameters, state, penetration, rate):
        force = self.hold(parameters, state, penetration, rate)
        return jnp.where((penetration > 0) & (force > 0), force, 0), state

    def hold(self, parameters, state, penetration, rate):
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

    def edge(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(force > 0, force, 0)

    def reference(self, parameters, mass, velocity):
        return piecewise_linear(mass, parameters.stiffness, parameters.depths, parameters.damping, velocity)


LAWS: dict[str, type[ContactLaw]] = {
    "linear": KelvinVoigt,
    "kelvin_voigt": KelvinVoigt,
    "hunt_crossley": HuntCrossley,
    "piecewise_linear": PiecewiseLinear,
}


def deflection(position: Array, clearance: Array) -> Array:
    """Signed deflection [m] of the mechanism: x at x > 0, x + c at x < -c, else 0 (c may be inf)."""
    far = position + clearance
    return jnp.where(position > 0, position, jnp.where(far < 0, far, 0))


def two_sided(law, parameters, state, position, velocity, clearance):
    """Signed force [N] at either surface: law(d, d') with d = x, or -law(d, d') with d = -c - x."""
    signed = deflection(position, clearance)
    side = jnp.sign(signed)
    force, state = law.step(parameters, state, side * signed, side * velocity)
    return side * force, state
