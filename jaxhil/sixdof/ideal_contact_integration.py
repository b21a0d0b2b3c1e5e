"""Integration of the ideal contact: continuous motion of the two bodies, without a rig or delays.

The integrator is the Dormand-Prince pair of order 5(4) with error control; every lane has its own steps. A
step in which a touch begins or ends is repeated with a shorter length, down to 1 us, so that derivatives with
respect to the time of this event are accurate too. All stages of a step use the state that the contact and
friction laws have at the start of the step. For laws with memory, the method is therefore of first order,
and the steps are shorter.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.contact.dormand_prince import take_looped_step
from jaxhil.lanes import select_lanes
from jaxhil.sixdof.bodies import Body, Load, State, angular_velocity
from jaxhil.sixdof.forces import ContactGroup, Forces, Memory, contact_wrench
from jaxhil.sixdof.latch import Latch, LatchState, init_latch, latch_points, latch_wrench
from jaxhil.sixdof.relative import (
    Pair,
    Pose,
    States,
    Twist,
    Wrench,
    interface_frame,
    loads,
    relative,
)
from jaxhil.sixdof.rotations import Quaternion, compose, normalise, rotate
from jaxhil.sixdof.vectors import norm

TOLERANCE = 1e-10  # maximum error of a step, divided by the relative speed (function `error_speed`)
MIN_STEP = 1e-9  # longest step that is accepted with any error [s], so that the integration proceeds
EVENT_ACCURACY = 1e-6  # accuracy of the time at which a touch begins or ends, or a latch catches [s]
MAX_STEP_WITH_MEMORY = 1e-4  # maximum length of a step for laws with memory [s]
MAX_STEPS = 200_000  # maximum number of steps if the mean step is short
MIN_STEP_RATIO, MAX_STEP_RATIO = 0.1, 4.0  # limits of the ratio of two successive step lengths
NEAREST_POINT_MARGIN = 1.0  # margin added to the lever arm, because contact points move along the shapes [m]
MIN_SPEED = 1e-30  # lower bound of speeds in divisions [m/s]


class IdealContactModel(NamedTuple):
    """Constants of an ideal contact: bodies, pairs of shapes that may touch, and latches."""

    bodies: Pair
    groups: tuple[ContactGroup, ...]  # groups of shape pairs that may touch
    latches: tuple[Latch, ...]


class LawStates(NamedTuple):
    """States of the contact laws, friction laws and latches."""

    laws: tuple[Memory, ...]  # states of each group's contact law and friction law
    latch_states: tuple[LatchState, ...]  # states of the latches


class Instant(NamedTuple):
    """Motion of the two bodies and contact forces at an instant."""

    states: States  # states of the bodies
    pose: Pose
    twist: Twist
    wrench: Wrench  # wrench on the chaser, about the origin of target frame T
    forces: tuple[Forces, ...]  # contact forces of each group of shape pairs


class IntegrationState(NamedTuple):
    """State of the integration of an ideal contact."""

    time: Float[Array, "*batch"]  # time since the start of the integration [s]
    length: Float[Array, "*batch"]  # length of the next step [s]
    touching: tuple[Bool[Array, "candidates *batch"], ...]  # whether each pair of shapes touches, per group
    memories: LawStates
    states: States  # states of the bodies
    steps: Int[Array, "*batch"]  # number of steps so far, including rejected steps
    # time from now in which nothing can touch [s]; 0 if something touches
    contact_free_time: Float[Array, "*batch"]


class Step(NamedTuple):
    """Result of an integration step, accepted or rejected."""

    now: Instant  # motion and forces at the end of the step
    memories: LawStates  # states of laws and latches at the end of the step
    accepted: Bool[Array, "*batch"]  # whether the step was accepted


def start_integration(
    contact_model: IdealContactModel, states: States, length: Float[Array, "*batch"]
) -> IntegrationState:
    """Return the state of an integration that starts with `states` and a first step of `length` [s]."""
    memories = LawStates(tuple(group.init() for group in contact_model.groups), ())
    if contact_model.latches:
        pose, _ = relative(contact_model.bodies, states)
        memories = memories._replace(
            latch_states=tuple(init_latch(latch, pose) for latch in contact_model.latches)
        )
    touching = tuple(jnp.zeros_like(group.parameters.damping, bool) for group in contact_model.groups)
    return IntegrationState(
        time=0 * length,
        length=length,
        touching=touching,
        memories=memories,
        states=states,
        steps=jnp.zeros(length.shape, jnp.int32),
        contact_free_time=0 * length,
    )


def compute_instant(
    contact_model: IdealContactModel, states: States, memories: LawStates, duration: Float[Array, "*batch"]
) -> tuple[Instant, LawStates]:
    """Compute relative motion and contact forces for the bodies' states, and the next states of the laws.

    `duration` is the time since the last evaluation of the laws [s].
    """
    pose, twist = relative(contact_model.bodies, states)
    wrench, forces, laws = contact_wrench(contact_model.groups, memories.laws, pose, twist, duration)
    latched = []
    for latch, before in zip(contact_model.latches, memories.latch_states, strict=True):
        pull, now = latch_wrench(latch, before, pose, twist)
        wrench = jax.tree.map(jnp.add, wrench, pull)
        latched.append(now)
    return Instant(states, pose, twist, wrench, forces), LawStates(laws, tuple(latched))


def advance_integration(
    contact_model: IdealContactModel,
    integration: IntegrationState,
    left: Float[Array, "*batch"],
    longest: Float[Array, "*batch"],
    speed: Float[Array, "*batch"],
) -> tuple[IntegrationState, Step]:
    """Integrate one step; return the state of the integration after the step, and the step itself.

    If the step is rejected, the state keeps its motion and has a shorter next step. If a number is not
    finite, or if there are too many steps, the time of the state becomes infinite.

    Args:
        contact_model: Constants of the ideal contact.
        integration: State of the integration before the step.
        left: Maximum length of the step [s].
        longest: Maximum length of a step while something touches or may touch soon [s].
        speed: Relative speed by which the error of the step is divided [m/s].
    """
    if _has_memory(contact_model):
        longest = jnp.minimum(longest, MAX_STEP_WITH_MEMORY)
    length = jnp.minimum(
        jnp.minimum(integration.length, left), jnp.maximum(longest, integration.contact_free_time)
    )
    length = lax.stop_gradient(length)
    now, memories, error = _try(contact_model, integration, length, speed)
    touching = tuple(forces.touch.depth > 0 for forces in now.forces)
    before = (*integration.touching, *(latch.caught for latch in integration.memories.latch_states))
    happens = jnp.zeros(length.shape, bool)
    for old, new in zip(before, (*touching, *(latch.caught for latch in memories.latch_states)), strict=True):
        happens = happens | jnp.any(old != new, axis=0)
    is_too_long = happens & (length > EVENT_ACCURACY)
    accepted = ((error <= 1) | (length <= MIN_STEP)) & ~is_too_long
    safe = jnp.where(jnp.isfinite(error), jnp.maximum(error, 1e-12), 1e12)
    change = jnp.clip(0.9 * safe**-0.2, MIN_STEP_RATIO, jnp.where(accepted, MAX_STEP_RATIO, 0.9))
    proposed = length * change
    # If `left` or `longest` shortened an accepted step, the next step may have the original length.
    cut = accepted & (length < integration.length)
    proposed = jnp.where(cut, jnp.maximum(integration.length, proposed), proposed)
    ahead = lax.stop_gradient(jnp.where(is_too_long, length / 4, proposed))
    steps = integration.steps + 1
    time = jnp.where(jnp.isfinite(error), integration.time + length, jnp.inf)
    apart = lax.stop_gradient(_contact_free_time(contact_model, now))
    moved = IntegrationState(time, ahead, touching, memories, now.states, steps, apart)
    after: IntegrationState = select_lanes(accepted, moved, integration._replace(length=ahead, steps=steps))
    # The integration stops after `MAX_STEPS` steps whose mean length is below a thousandth of `longest`.
    endless = (steps > MAX_STEPS) & (after.time < 1e-3 * steps.astype(length.dtype) * longest)
    time = jnp.where(endless, jnp.inf, after.time)
    return after._replace(time=time), Step(now, memories, accepted | endless)


def _try(
    contact_model: IdealContactModel,
    integration: IntegrationState,
    length: Float[Array, "*batch"],
    speed: Array,
) -> tuple[Instant, LawStates, Array]:
    """Compute a step of `length` [s]: final motion, final states of the laws, and error/`TOLERANCE` [1]."""

    def slope(offset, states):
        now, memories = compute_instant(contact_model, states, integration.memories, offset)
        return state_derivative(contact_model, now), (now._replace(states=None), memories)

    step = take_looped_step(slope, integration.states, length)
    now, memories = step.extra
    normalised: Any = States(*(body._replace(attitude=normalise(body.attitude)) for body in step.end))
    return (
        now._replace(states=normalised),
        memories,
        _relative_error(contact_model, step.error, speed) / TOLERANCE,
    )


def state_derivative(contact_model: IdealContactModel, now: Instant) -> States:
    """Return the time derivatives of the bodies' states under the contact wrench."""
    states = now.states
    target, chaser = loads(now.wrench, interface_frame(contact_model.bodies.target, states.target), states)
    return States(
        _slope(contact_model.bodies.target, states.target, target),
        _slope(contact_model.bodies.chaser, states.chaser, chaser),
    )


def sample_ideal_contact(
    contact_model: IdealContactModel,
    states: States,
    period: Float[Array, "*batch"],
    periods: int,
    longest: Float[Array, "*batch"],
) -> tuple[IntegrationState, Instant]:
    """Integrate the ideal contact over several periods, and record motion and forces when each begins.

    Args:
        contact_model: Constants of the ideal contact.
        states: States of the bodies at the start.
        period: Length of a period [s].
        periods: Number of periods.
        longest: Maximum length of a step while something touches or may touch soon [s].

    Returns:
        State of the integration at the end, and motion and forces at the start of each period, (periods,
        ...).
    """
    speed = error_speed(contact_model, states)

    def body(integration, _):
        integration = integration._replace(time=0 * period, steps=0 * integration.steps)
        seen, _ = compute_instant(contact_model, integration.states, integration.memories, integration.time)
        return integrate_until(contact_model, integration, period, longest, speed), seen

    begin = start_integration(contact_model, states, jnp.minimum(period, longest))
    return lax.scan(body, begin, None, length=periods)


def integrate_until(
    contact_model: IdealContactModel,
    integration: IntegrationState,
    until: Array,
    longest: Array,
    speed: Array,
) -> IntegrationState:
    """Continue an integration until `until` [s] after the integration's start.

    See `advance_integration` for `longest` and `speed`.
    """

    def body(integration):
        left = until - integration.time
        moved, _ = advance_integration(contact_model, integration, left, longest, speed)
        return select_lanes(left > _end_tolerance(until), moved, integration)

    def ahead(integration):
        return jnp.any(until - integration.time > _end_tolerance(until))

    return lax.while_loop(ahead, body, integration)


def error_speed(contact_model: IdealContactModel, states: States) -> Float[Array, "*batch"]:
    """Return the relative speed [m/s] by which integration errors are divided.

    The result is the sum of the relative speed of the centres of mass and the speed that the relative
    rotation gives a point at a distance of 1 m. The result does not depend on the interface frames.
    """
    target, chaser = (
        rotate(state.attitude, angular_velocity(body, state))
        for body, state in zip(contact_model.bodies, states, strict=True)
    )
    apart = states.chaser.velocity - states.target.velocity
    return lax.stop_gradient(norm(apart) + norm(chaser - target) + 1e-9)


def _end_tolerance(until: Array) -> Array:
    """Return the tolerance [s] with which an integration must reach the time `until` [s]."""
    return 1e-14 + 1e-13 * until


def _contact_free_time(contact_model: IdealContactModel, now: Instant) -> Float[Array, "*batch"]:
    """Return a step length [s] in which no shapes can touch and no latch can catch.

    The step length is half of the shortest time until one of these events is possible. A latch is assumed to
    catch at any angle and speed.
    """
    linear, angular = norm(now.twist.linear), norm(now.twist.angular)
    time = jnp.full_like(linear, jnp.inf)
    for forces in now.forces:
        arm = jax.tree.map(lambda point, origin: point - origin[None], forces.touch.point, now.pose.position)
        closing = linear[None] + angular[None] * (NEAREST_POINT_MARGIN + norm(arm))
        time = jnp.minimum(time, jnp.min(-forces.touch.depth / (2 * closing + MIN_SPEED), axis=0))
    for latch in contact_model.latches:
        height = latch_points(latch, now.pose).z + latch.depth
        closing = linear[None] + angular[None] * (NEAREST_POINT_MARGIN + norm(latch.point))
        time = jnp.minimum(time, jnp.min(height / (2 * closing + MIN_SPEED), axis=0))
    return jnp.maximum(time, 0)


def _has_memory(contact_model: IdealContactModel) -> bool:
    """Return whether any contact law or friction law has memory."""
    memories = jax.eval_shape(lambda: [group.init() for group in contact_model.groups])
    return bool(jax.tree.leaves(memories))


def _relative_error(contact_model: IdealContactModel, error: States, speed: Array) -> Array:
    """Return the error of a step, divided by the relative speed [1].

    Velocity errors are divided by `speed`, position errors by the distance that `speed` covers in 0.1 s.
    """
    largest = jnp.zeros_like(speed)
    for body, state in zip(contact_model.bodies, error, strict=True):
        turning = norm(body.inverse_inertia @ state.spin)
        tilt = 2 * norm(state.attitude.v)
        for part in (norm(state.velocity), turning, 10 * norm(state.position), 10 * tilt):
            largest = jnp.maximum(largest, part / speed)
    return lax.stop_gradient(largest)


def _slope(body: Body, state: State, load: Load) -> State:
    angular = angular_velocity(body, state)
    turning = compose(state.attitude, Quaternion(0 * state.attitude.w, 0.5 * angular))
    return State(state.velocity, (1 / body.mass) * load.force, turning, load.torque)
