"""Friction laws: tangential force of a contact as a function of normal force F and slip.

All laws satisfy Coulomb's condition |f_t| <= mu F. Slip and force are vectors in three dimensions, because a
basis of the tangent plane cannot be a smooth function of the normal. Arrays are (candidates, *batch).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.vectors import Vector, dot, norm


class Touching(NamedTuple):
    """Inputs of a friction law."""

    force: Float[Array, "candidates *batch"]  # normal force F >= 0 [N]
    normal: Vector  # normal n of the target's surface
    slip: Vector  # tangential velocity of the chaser relative to the target [m/s]
    duration: Float[Array, "..."]  # time since the last evaluation of the law [s]


class Friction(eqx.Module):
    """Interface of all friction laws."""

    def init(self, like: Float[Array, "candidates *batch"]) -> tuple[Vector, ...]:
        """Return the law's state before the first touch, in arrays with the shape of `like`."""
        return ()

    @abc.abstractmethod
    def step(self, touching: Touching, state: tuple[Vector, ...]) -> tuple[Vector, tuple[Vector, ...]]:
        """Return the tangential force on the chaser [N], and the law's next state."""


class Frictionless(Friction):
    """Friction law whose tangential force is 0."""

    def step(self, touching, state):
        return 0 * touching.slip, state


class Regularised(Friction):
    """Regularised Coulomb friction f_t = -mu F t/sqrt(|t|^2 + v_s^2) for normal force F and slip velocity t.

    The law is Coulomb friction at slips well above v_s, and a viscous damper at slips well below v_s. Bodies
    that would stick under Coulomb friction creep instead, with the slip v_s s/sqrt(1 - s^2). Here s is
    |f_t|/(mu F).
    """

    coefficient: Float[Array, "candidates *batch"]  # friction coefficient mu [1]
    slip: Float[Array, "candidates *batch"]  # regularising slip v_s [m/s], positive

    def step(self, touching, state):
        slip = touching.slip
        damping = self.coefficient * touching.force / jnp.sqrt(dot(slip, slip) + self.slip**2)
        return -damping * slip, state


class Bristle(Friction):
    """Bristle friction f_t = -(k_t z + b_t t), limited to mu F (Dahl's model).

    F is the normal force, and t is the slip velocity. The deflection z of the bristle (stiffness k_t, damping
    b_t) follows z' = t - |t| z k_t/(mu F). The law is a spring for small displacements, and Coulomb friction
    in steady slip. Each evaluation projects z on the tangent plane and integrates it by one implicit step.
    Without contact z is 0.
    """

    coefficient: Float[Array, "candidates *batch"]  # friction coefficient mu [1]
    stiffness: Float[Array, "candidates *batch"]  # bristle stiffness k_t [N/m]
    damping: Float[Array, "candidates *batch"]  # bristle damping b_t [N s/m]

    def init(self, like):
        zero = jnp.zeros_like(like)
        return (Vector(zero, zero, zero),)

    def step(self, touching, state):
        (deflection,) = state
        slip, limit = touching.slip, self.coefficient * touching.force
        deflection = deflection - dot(deflection, touching.normal) * touching.normal
        moved = deflection + touching.duration * slip
        # The implicit step of length h gives z/(1 + h |t| k_t/(mu F)); this form allows a force of 0.
        resisted = limit + touching.duration * norm(slip) * self.stiffness
        deflection = (limit / jnp.where(resisted > 0, resisted, 1)) * moved
        force = self.stiffness * deflection + self.damping * slip
        size = norm(force)
        scale = jnp.where(size > limit, limit / jnp.where(size > limit, size, 1), 1)
        return -scale * force, (deflection,)
