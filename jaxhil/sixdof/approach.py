"""How a run begins: free flight towards the first touch."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.sixdof.bodies import Load, State, build_state, kick_drift
from jaxhil.sixdof.forces import ContactGroup, deepest
from jaxhil.sixdof.relative import Pair, Pose, States, Twist
from jaxhil.sixdof.rotations import Quaternion, compose, identity, reverse, rotate, rotate_back
from jaxhil.sixdof.vectors import Vector, cross

FAR = 10.0  # m: from where the chaser is lowered on the target
STEPS, POLISHES = 400, 3  # of the search for the first touch
FLIGHTS = 8  # steps of the flight back


def touching_height(
    groups: tuple[ContactGroup, ...],
    offset_x: Float[Array, "*batch"],
    offset_y: Float[Array, "*batch"],
    attitude: Quaternion,
) -> Float[Array, "*batch"]:
    """z [m] of C, in T axes, at which the chaser, lowered along z, first touches; NaN where it never does.

    A step as long as the gap cannot pass a surface; Newton's method has the last digits.
    """

    def depth(height: Array) -> Array:
        return deepest(groups, Pose(Vector(offset_x, offset_y, height), attitude))

    def polished(_, height: Array) -> Array:
        at = jax.lax.stop_gradient(height)
        found, slope = jax.jvp(depth, (at,), (jnp.ones_like(at),))
        return at - found / jnp.where(slope < 0, slope, -1)

    start = jnp.full_like(offset_x, FAR)
    height = jax.lax.fori_loop(0, STEPS, lambda _, z: z + jax.lax.stop_gradient(depth(z)), start)
    touches = (jnp.abs(depth(height)) < 1e-6) & (height > -FAR)
    polish = jax.lax.fori_loop(0, POLISHES, polished, height)
    return jnp.where(touches, polish, jnp.nan)


def begin(bodies: Pair, pose: Pose, twist: Twist, before: Float[Array, "*batch"]) -> States:
    """States `before` [s] bodies in free flight are at a pose and twist: the target at rest, its centre of
    mass at the origin and its body axes those of the world."""
    zero = jnp.zeros_like(before)
    still = Vector(zero, zero, zero)
    target = build_state(bodies.target, still, still, identity(before), still)
    body = bodies.chaser
    to_world, own = (body.interface_attitude or identity(before) for body in bodies)
    attitude = compose(compose(to_world, pose.attitude), reverse(own))
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
        return kick_drift(body, state, Load(still, still), -before / FLIGHTS, 1.0)

    return States(target, jax.lax.fori_loop(0, FLIGHTS, back, chaser))
