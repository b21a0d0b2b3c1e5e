"""Friction laws: tangential force of a contact as a function of its normal force F and its slip.

All laws remain within Coulomb's cone, |f_t| <= mu F. None uses a basis of the tangent plane, which cannot be
chosen smoothly. Shapes are (candidates, *batch).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.vectors import Vector, dot, norm


class Touching(NamedTuple):
    """Input of a friction law."""

    force: Float[Array, "candidates *batch"]  # normal force F >= 0 [N]
    normal: Vector  # normal n
    slip: Vector  # tangential velocity of the chaser relative to the target [m/s]
    duration: Float[Array, "..."]  # time since the last evaluation of the law [s]


class Friction(eqx.Module):
    """Interface of all friction laws."""

    def init(self, like: Float[Array, "candidates *batch"]) -> tuple[Vector, ...]:
        """Return the state before the first touch."""
        return ()

    @abc.abstractmethod
    def step(self, touching: Touching, state: tuple[Vector, ...]) -> tuple[Vector, tuple[Vector, ...]]:
        """Return the tangential force on the chaser [N], and the next state."""


class Frictionless(Friction):
    """Friction law without tangential force."""

    def step(self, touching, state):
        return 0 * touching.slip, state


class Regularised(Friction):
    """Regularised Coulomb friction f_t = -mu F t/sqrt(|t|^2 + v_s^2).

    At slips t well above v_s it is Coulomb's friction, below it is a damper. Where bodies should stick they
    creep, at v_s s/sqrt(1 - s^2) for s = |f_t|/(mu F).
    """

    coefficient: Float[Array, "candidates *batch"]  # mu [1]
    slip: Float[Array, "candidates *batch"]  # v_s [m/s], positive

    def step(self, touching, state):
        slip = touching.slip
        share = self.coefficient * touching.force / jnp.sqrt(dot(slip, slip) + self.slip**2)
        return -share * slip, state


class Bristle(Friction):
    """Bristle friction f_t = -(k_t z + b_t t), |f_t| <= mu F, with z' = t - |t| z k_t/(mu F) (Dahl).

    The bristle's deflection z acts as a spring at rest; steady slip gives Coulomb's friction. Each evaluation
    is one implicit step. The deflection is projected to the tangent plane, and is 0 without contact.
    """

    coefficient: Float[Array, "candidates *batch"]  # mu [1]
    stiffness: Float[Array, "candidates *batch"]  # k_t [N/m]
    damping: Float[Array, "candidates *batch"]  # b_t [N s/m]

    def init(self, like):
        zero = jnp.zeros_like(like)
        return (Vector(zero, zero, zero),)

    def step(self, touching, state):
        (deflection,) = state
        slip, limit = touching.slip, self.coefficient * touching.force
        deflection = deflection - dot(deflection, touching.normal) * touching.normal
        moved = deflection + touching.duration * slip
        # This is z/(1 + h |t| k_t/(mu F)), without a division by zero force.
        resisted = limit + touching.duration * norm(slip) * self.stiffness
        deflection = (limit / jnp.where(resisted > 0, resisted, 1)) * moved
        force = self.stiffness * deflection + self.damping * slip
        size = norm(force)
        share = jnp.where(size > limit, limit / jnp.where(size > limit, size, 1), 1)
        return -share * force, (deflection,)
