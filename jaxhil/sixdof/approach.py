"""States of the bodies at the start of a run, in free flight towards the first touch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.bodies import Load, State, build_state, kick_drift
from jaxhil.sixdof.forces import ContactGroup, deepest
from jaxhil.sixdof.relative import Pair, Pose, States, Twist
from jaxhil.sixdof.rotations import Quaternion, compose, identity, reverse, rotate, rotate_back
from jaxhil.sixdof.vectors import Vector, cross

SEARCH_HEIGHT = 10.0  # z coordinate in target frame T at which the search for the first touch begins [m]
SEARCH_STEPS = 400  # number of search steps for the first touch
NEWTON_STEPS = 3  # number of Newton steps after the search; enough for rounding accuracy
FLIGHT_STEPS = 8  # number of integration steps of the free flight before the first touch


def find_touching_height(
    groups: tuple[ContactGroup, ...],
    offset_x: Float[Array, "*batch"],
    offset_y: Float[Array, "*batch"],
    attitude: Quaternion,
) -> Float[Array, "*batch"]:
    """Return the z coordinate [m] of chaser frame C at the first touch, in target frame T.

    The chaser moves along -z of T. If the chaser passes the target without a touch, the result is NaN. Each
    search step is as long as the gap between the shapes, so that no step can pass a surface. Newton's method
    then refines the result to within rounding error.
    """

    def depth(height: Array) -> Array:
        return deepest(groups, Pose(Vector(offset_x, offset_y, height), attitude))

    def newton(_, height: Array) -> Array:
        guess = jax.lax.stop_gradient(height)
        value, slope = jax.jvp(depth, (guess,), (jnp.ones_like(guess),))
        return guess - value / jnp.where(slope < 0, slope, -1)

    start = jnp.full_like(offset_x, SEARCH_HEIGHT)
    height = jax.lax.fori_loop(0, SEARCH_STEPS, lambda _, z: z + jax.lax.stop_gradient(depth(z)), start)
    touches = (jnp.abs(depth(height)) < 1e-6) & (height > -SEARCH_HEIGHT)
    refined = jax.lax.fori_loop(0, NEWTON_STEPS, newton, height)
    return jnp.where(touches, refined, jnp.nan)


def begin(bodies: Pair, pose: Pose, twist: Twist, before: Float[Array, "*batch"]) -> States:
    """Return the bodies' states from which a free flight of `before` [s] leads to `pose` and `twist`.

    The target is at rest with its centre of mass at the world's origin. The target's body axes equal the
    world axes.
    """
    zero = jnp.zeros_like(before)
    still = Vector(zero, zero, zero)
    target = build_state(bodies.target, still, still, identity(before), still)
    body = bodies.chaser
    to_world, to_body = (body.interface_attitude or identity(before) for body in bodies)
    attitude = compose(compose(to_world, pose.attitude), reverse(to_body))
    angular = rotate(to_world, twist.angular)
    arm = rotate(attitude, body.interface)
    chaser = build_state(
        body,
        bodies.target.interface + rotate(to_world, pose.position) - arm,
        rotate(to_world, twist.linear) - cross(angular, arm),
        attitude,
        rotate_back(attitude, angular),
    )

    def back(_, state: State) -> State:
        return kick_drift(body, state, Load(still, still), -before / FLIGHT_STEPS, 1.0)

    return States(target, jax.lax.fori_loop(0, FLIGHT_STEPS, back, chaser))
