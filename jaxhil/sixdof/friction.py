"""Friction laws: the tangential force of a contact against its normal force F and its slip.

All stay within Coulomb's cone, |f_t| <= mu F. None needs a basis of the tangent plane, which cannot be chosen
smoothly. Shapes: (candidates, *batch).
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.vectors import Vector, dot, norm


class Touching(NamedTuple):
    """What a friction law sees of a contact."""

    force: Float[Array, "candidates *batch"]  # F, normal, not negative [N]
    normal: Vector  # n
    slip: Vector  # tangential velocity of the chaser against the target [m/s]
    duration: Float[Array, "..."]  # since the law was evaluated last [s]


class Friction(eqx.Module):
    """Interface of all friction laws."""

    def init(self, like: Float[Array, "candidates *batch"]) -> tuple[Vector, ...]:
        """State before the first touch."""
        return ()

    @abc.abstractmethod
    def step(self, touching: Touching, state: tuple[Vector, ...]) -> tuple[Vector, tuple[Vector, ...]]:
        """Tangential force on the chaser [N], and the next state."""


class Frictionless(Friction):
    """No tangential force."""

    def step(self, touching, state):
        return 0 * touching.slip, state


class Regularised(Friction):
    """f_t = -mu F t/sqrt(|t|^2 + v_s^2): Coulomb's friction at slips t well above v_s, a damper below.

    What should stick creeps, at v_s s/sqrt(1 - s^2) for s = |f_t|/(mu F).
    """

    coefficient: Float[Array, "candidates *batch"]  # mu [1]
    slip: Float[Array, "candidates *batch"]  # v_s [m/s], positive

    def step(self, touching, state):
        slip = touching.slip
        share = self.coefficient * touching.force / jnp.sqrt(dot(slip, slip) + self.slip**2)
        return -share * slip, state


class Bristle(Friction):
    """f_t = -(k_t z + b_t t), |f_t| <= mu F, with the bristle's deflection z' = t - |t| z k_t/(mu F) (Dahl).

    At rest a spring, at steady slip Coulomb's friction. One implicit step per evaluation; the deflection is
    kept in the tangent plane, and is 0 without contact.
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
        # z/(1 + h |t| k_t/(mu F)), with nothing divided by a force of 0.
        resisted = limit + touching.duration * norm(slip) * self.stiffness
        deflection = (limit / jnp.where(resisted > 0, resisted, 1)) * moved
        force = self.stiffness * deflection + self.damping * slip
        size = norm(force)
        share = jnp.where(size > limit, limit / jnp.where(size > limit, size, 1), 1)
        return -share * force, (deflection,)
