"""Kinematics of a Stewart-Gough hexapod: a platform on six legs, which are the axes.

The length of a leg is the distance from its joint on the base to its joint on the platform. Newton's method,
started at a pose nearby, finds the pose for given lengths.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.sixdof.axes import AxisMotion
from jaxhil.sixdof.equations import solve
from jaxhil.sixdof.kinematics import Kinematics
from jaxhil.sixdof.rotations import exponential, left_jacobian, rotate
from jaxhil.sixdof.vectors import Vector, cross, direction, norm, vector

NEWTON_STEPS = 3  # number of Newton steps, enough to reduce an error of 1e-3 to rounding


class Stewart(Kinematics):
    """Kinematics of a hexapod: its platform carries chaser frame C, and its base carries target frame T."""

    base: Vector  # joints on the base, from its origin, in target frame T, (6, *batch) [m]
    platform: Vector  # joints on the platform, from its origin, in chaser frame C, (6, *batch) [m]
    height: Vector  # vector from the base's origin to the platform's origin in the docked pose [m]
    stroke: Float[Array, "2 *batch"] | None = None  # minimum and maximum leg length [m]; None without limits

    @property
    def is_linear(self):
        return False

    def reaches(self, axes):
        if self.stroke is None:
            return super().reaches(axes)
        shortest, longest = self.stroke[:, None]
        return jnp.all((axes >= shortest) & (axes <= longest), axis=0)

    def command(self, coordinates):
        leg, *_ = _legs(self, coordinates)
        return norm(leg)

    def coordinates(self, motion, near):
        def newton(at: Array, lengths: Array) -> Array:
            return at + solve(jacobian(self, at), (lengths - self.command(at))[:, None])[:, 0]

        lengths, near = lax.stop_gradient((motion.position, near))
        at = lax.fori_loop(0, NEWTON_STEPS - 1, lambda _, at: newton(at, lengths), near)
        # Differentiating only the last Newton step gives the exact derivatives of the pose.
        at = newton(at, motion.position)
        slopes = jacobian(self, at)
        rate = solve(slopes, motion.rate[:, None])[:, 0]
        if motion.acceleration is None:
            return AxisMotion(at, rate, None)

        def leg_rates(at: Array) -> Array:
            return jax.jvp(self.command, (at,), (rate,))[1]

        curvature = jax.jvp(leg_rates, (at,), (rate,))[1]
        return AxisMotion(at, rate, solve(slopes, (motion.acceleration - curvature)[:, None])[:, 0])


def jacobian(hexapod: Stewart, at: Float[Array, "6 *batch"]) -> Float[Array, "6 6 *batch"]:
    """Return the derivatives of the leg lengths (rows) with respect to the coordinates (columns) [m, rad].

    A row consists of u and Jl(theta)^T (R b x u), where u is the direction of the leg and b its joint on
    the platform. R is the rotation with the rotation vector theta, and Jl is the left Jacobian.
    """
    leg, arm, theta = _legs(hexapod, at)
    along = direction(leg)
    turning = left_jacobian(-theta, cross(arm, along))
    return jnp.stack(jax.tree.leaves((along, turning)), axis=1)


def condition(hexapod: Stewart, at: Float[Array, "6 *batch"]) -> Float[Array, "*batch"]:
    """Return the condition number of the Jacobian (lengths in m); it is large near singular poses."""
    return jnp.linalg.cond(jnp.moveaxis(jacobian(hexapod, at), (0, 1), (-2, -1)))


def _legs(hexapod: Stewart, at: Float[Array, "6 *batch"]) -> tuple[Vector, Vector, Vector]:
    """Return the legs as vectors, the joints on the platform, and the rotation vector theta [rad].

    Legs and joints are in target frame T [m], (6, *batch). Joints are relative to the platform's origin.
    """
    position, theta = (vector(part[:, None]) for part in (at[:3], at[3:]))
    height = jax.tree.map(lambda part: part[None], hexapod.height)
    arm = rotate(exponential(theta), hexapod.platform)
    return height + position + arm - hexapod.base, arm, theta
