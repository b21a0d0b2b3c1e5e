"""Contact in space, without a rig: continuous and undelayed, which is what a rig is judged against.

The two bodies are followed by Runge and Kutta's method of order four. Within a step each stage sees what the
laws remember from the step's start; so laws with a memory are of first order in the step, and so is a force
that jumps within it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.sixdof.bodies import Body, Load, State, angular_velocity
from jaxhil.sixdof.forces import ContactGroup, Memory, contact_wrench
from jaxhil.sixdof.relative import (
    Pair,
    Pose,
    States,
    Twist,
    Wrench,
    interface_frame,
    loads,
    relative_motion,
)
from jaxhil.sixdof.rotations import Quaternion, compose, normalise

STAGES = ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6))  # place in the step, weight


class Instant(NamedTuple):
    """Two bodies in contact, at a time."""

    states: States  # of the bodies
    pose: Pose
    twist: Twist
    wrench: Wrench  # on the chaser, about T's origin


def follow(
    bodies: Pair, states: States, groups: tuple[ContactGroup, ...], step: Float[Array, "*batch"], steps: int
) -> tuple[States, Instant]:
    """The states after so many steps of `step` [s], and every step's start, (steps, ...)."""

    def body(carry, _):
        states, memories = carry
        after, instant = _stages(bodies, states, groups, memories, step)
        _, memories = _instant(bodies, after, groups, memories, step)
        return (after, memories), instant

    start = states, tuple(group.init() for group in groups)
    (states, _), seen = lax.scan(body, start, None, length=steps)
    return states, seen


def _stages(bodies, states, groups, memories, step):
    """The states after a step, and the instant at its start."""

    def stage(carry, place_and_weight):
        slope, total = carry
        place, weight = (part.astype(step.dtype) * step for part in place_and_weight)
        at = _moved(states, place, slope)
        instant, _ = _instant(bodies, at, groups, memories, place)
        target, chaser = loads(instant.wrench, interface_frame(bodies.target, at.target), at)
        slope = States(_slope(bodies.target, at.target, target), _slope(bodies.chaser, at.chaser, chaser))
        return (slope, _moved(total, weight, slope)), instant

    # A loop, not unrolled: a quarter to compile.
    nothing = jax.tree.map(jnp.zeros_like, states)
    (_, total), seen = lax.scan(stage, (nothing, states), jnp.asarray(STAGES))
    total = States(*(state._replace(attitude=normalise(state.attitude)) for state in total))
    return total, jax.tree.map(lambda leaf: leaf[0], seen)


def _instant(bodies, states, groups, memories, duration) -> tuple[Instant, tuple[Memory, ...]]:
    target = interface_frame(bodies.target, states.target)
    pose, twist = relative_motion(target, interface_frame(bodies.chaser, states.chaser))
    wrench, memories = contact_wrench(groups, memories, pose, twist, duration)
    return Instant(states, pose, twist, wrench), memories


def _slope(body: Body, state: State, load: Load) -> State:
    """Rates of a state."""
    angular = angular_velocity(body, state)
    turning = compose(state.attitude, Quaternion(0 * state.attitude.w, 0.5 * angular))
    return State(state.velocity, (1 / body.mass) * load.force, turning, load.torque)


def _moved(states: States, duration: Array, slope: States) -> States:
    moved: Any = jax.tree.map(lambda value, rate: value + duration * rate, states, slope)
    return moved
