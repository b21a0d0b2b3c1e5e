"""Ideal contact by numerical integration, for any contact law, with or without a push.

    M d'' = -F(d, d') - p(t),   d(0) = 0,   d'(0) = v > 0

F is the law's force while the bodies touch. The push p(t) >= 0 is a further force that drives the bodies
apart, for example from a spring-loaded pusher; the push also acts without contact. This integration
computes the ideal contact for laws without a closed form (`jaxhil.contact.ideal_contact`) and with a push.

The method is Dormand and Prince's pair of order 5(4) with one step size for each batch element. Steps end at
the turning point and at the separation, so that the motion is smooth within each step. Where the slope of the
force changes, the error control shortens the steps. The state of the law (`ContactLaw.init`, `step`) is
updated after each step.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.dormand_prince import StepEnd, interpolate_step, take_step
from jaxhil.lanes import select_lanes

STEP_TOLERANCE = 1e-10  # limit on a step's error, relative to approach velocity and deepest penetration
FIRST_STEP = 1e-4  # first step that is tried [s]
MAX_CONTACT_DURATION = 10.0  # duration of contact [s] beyond which the bodies count as sticking to each other
MAX_STEPS = 1000  # limit on the number of steps, including rejected ones
MAX_EVENT_ITERATIONS = 16  # limit on the iterations of the false position method (Illinois) for one event
INWARD, OUTWARD, FREE, ENDED = range(4)  # phases of the motion; FREE occurs only with a push


@runtime_checkable
class ForceLaw(Protocol):
    """Methods of `jaxhil.contact.base.ContactLaw` that the integration calls."""

    def init(self, penetration: Any) -> tuple[Any, ...]: ...

    def step(self, parameters: Any, state: Any, penetration: Any, rate: Any) -> tuple[Any, Any]: ...

    def onset_force(self, parameters: Any, rate: Any) -> Any: ...

    def separation_function(self, parameters: Any, state: Any, penetration: Any, rate: Any) -> Any: ...


class IdealContactMotion(NamedTuple):
    """Result of an integrated ideal contact, and its motion at the requested times."""

    restitution: Float[Array, "*batch"]  # speed |d'| after contact and push, divided by v [1]
    peak_force: Float[Array, "*batch"]  # largest contact force, without the push [N]
    # time from first touch to separation [s]; infinite if there is no separation within 10 s or the bodies
    # come to rest (`restitution` is then computed from the speed at the end of the integration)
    duration: Float[Array, "*batch"]
    position: Float[Array, "samples *batch"] | None  # at the requested times [m]; None without `times`
    velocity: Float[Array, "samples *batch"] | None  # at the requested times [m/s]; None without `times`


def integrate_contact(
    law: ForceLaw,
    parameters: Any,
    mass: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
    push: Callable[[Array], Array] | None = None,
    push_duration: Float[Array, "*batch"] | float = 0.0,
    times: Float[Array, "samples *batch"] | None = None,
    tolerance: Float[Array, ""] | float = STEP_TOLERANCE,
) -> IdealContactMotion:
    """Integrate the motion of one ideal contact.

    The bodies separate when the penetration, or `ContactLaw.separation_function`, crosses 0 during the
    outward motion. The push p(t) >= 0 drives the bodies apart, so that they never touch again. If the push
    lasts longer than the contact, the restitution is computed from the speed at the end of the push and may
    exceed 1.

    The function can be jitted, vmapped and differentiated in forward mode, also with respect to `times` and
    to the variables that `push` encloses. All arrays have one batch shape and one dtype; slopes and depths
    have a leading axis of segments.

    Args:
        law: contact law.
        parameters: parameters of the law (`jaxhil.contact.laws.ContactParameters`).
        mass: equivalent mass M [kg].
        velocity: approach speed v [m/s].
        push: function that returns p(t) [N] for a time t since the first touch [s], both (*batch). It is
            used for 0 <= t <= `push_duration`. p may have kinks and jumps, but no detail shorter than 1/50
            of `push_duration`.
        push_duration: end of the push [s]; later p = 0.
        times: requested times since the first touch [s], in any order. Before 0 and after the end the motion
            is assumed to be uniform.
        tolerance: limit on the relative error of each step, at least 32 times the rounding unit of the dtype.

    Returns:
        Restitution, peak force and duration of the contact, and the motion at `times`.
    """
    shape = jnp.broadcast_shapes(jnp.shape(mass), jnp.shape(velocity))
    mass, velocity = jnp.broadcast_to(mass, shape), jnp.broadcast_to(velocity, shape)
    push_end = jnp.broadcast_to(jnp.asarray(0.0 if push is None else push_duration, velocity.dtype), shape)
    problem = _Problem(law, parameters, mass, velocity, push, push_end, tolerance)
    end, nodes = _integrate_phases(problem, times is not None)
    position = rate = None
    if nodes is not None:
        position, rate = _interpolate_nodes(nodes, end, velocity, times)
    # Rounding may move bodies that come to rest at the surface out of the surface; this is no separation.
    is_moving = jnp.abs(end.velocity) > tolerance * velocity
    return IdealContactMotion(
        restitution=jnp.abs(end.velocity) / velocity,
        peak_force=end.peak,
        duration=jnp.where((end.phase >= FREE) & is_moving, end.separation_time, jnp.inf),
        position=position,
        velocity=rate,
    )


class _Problem(NamedTuple):
    law: Any  # contact law
    parameters: Any  # parameters of the law (`jaxhil.contact.laws.ContactParameters`)
    mass: Array  # equivalent mass M [kg]
    approach: Array  # approach speed v [m/s]
    push: Any  # function p(t) [N], or None
    push_end: Array  # end of the push [s]
    tolerance: Float[Array, ""] | float  # limit on the relative error of a step


class _IntegrationState(NamedTuple):
    time: Array  # time since the first touch [s]
    depth: Array  # penetration [m]
    velocity: Array  # rate of the penetration [m/s]
    memory: Any  # state of the contact law
    phase: Array  # INWARD, OUTWARD, FREE or ENDED
    deepest: Array  # largest |penetration| so far [m]
    peak: Array  # largest contact force so far [N]
    separation_scale: Array  # `ContactLaw.separation_function` at the turning point
    separation_time: Array  # time of separation [s]


class _Search(NamedTuple):
    """State of the step size control and of the search for an event, which ends a phase of the motion."""

    step: Array  # step to try next [s]
    tries: Array  # iterations of the false position method; 0 while no event is bracketed
    low: Array  # step that ends before the event [s]
    high: Array  # step that ends after the event [s]
    at_low: Array  # value of the event function after the step `low`
    at_high: Array  # value of the event function after the step `high`
    side: Array  # bound that moved last: 1 for `low`, -1 for `high`


class _Nodes(NamedTuple):
    """Nodes of the interpolation: the motion at the start of each integration step, (steps, *batch)."""

    time: Array  # time since the first touch [s]
    depth: Array  # penetration [m]
    velocity: Array  # rate of the penetration [m/s]
    start_acceleration: Array  # acceleration at the start of the step [m/s^2]
    end_acceleration: Array  # acceleration at the end of the step [m/s^2]


def _event_value(problem, state, time, depth, rate):
    """Return a value that is positive during a phase of the motion and 0 at the end of the phase.

    A phase ends at the turning point, at the separation, or at the end of the push (a force that drives the
    bodies apart).
    """
    law_value = problem.law.separation_function(problem.parameters, state.memory, depth, rate)
    # Force and depth are scaled to order 1; otherwise the root of their minimum would be hard to find.
    law_value = law_value / jnp.where(state.separation_scale > 0, state.separation_scale, 1)
    scaled_depth = depth / jnp.where(state.deepest > 0, state.deepest, 1)
    separation = jnp.where(law_value < scaled_depth, law_value, scaled_depth)
    event = jnp.where(state.phase == INWARD, rate, separation)
    return jnp.where(state.phase == FREE, problem.push_end - time, event)


def _contact_force(problem, state, depth, rate):
    """Return the contact force [N]; at d <= 0, return the limit of the force for d -> 0 from above."""
    force, _ = problem.law.step(problem.parameters, state.memory, depth, rate)
    force = jnp.where(depth > 0, force, problem.law.onset_force(problem.parameters, rate))
    return jnp.where(state.phase < FREE, force, 0)


def _try_step(problem, state, length):
    """Return the motion after a step of `length` [s], and the estimated errors of depth and rate [m, m/s]."""
    pushes = state.time < problem.push_end

    def slope(offset, motion):
        force = _contact_force(problem, state, *motion)
        if problem.push is not None:
            force = force + jnp.where(pushes, problem.push(state.time + offset), 0)
        return (motion[1], -force / problem.mass), None

    result = take_step(slope, (state.depth, state.velocity), length)
    depth, velocity = result.end
    return StepEnd(depth, velocity, result.slopes[0][1], result.slopes[-1][1]), result.error


def _initial_state(problem):
    zeros = jnp.zeros_like(problem.approach)
    return _IntegrationState(
        time=zeros,
        depth=zeros,
        velocity=problem.approach,
        memory=problem.law.init(zeros),
        phase=jnp.zeros(zeros.shape, jnp.int32),
        deepest=zeros,
        peak=zeros,
        separation_scale=zeros,
        separation_time=zeros,
    )


def _integrate_phases(problem, records):
    """Integrate all contacts; return the final state and the motion's `_Nodes` (None unless `records`)."""
    like = problem.approach
    dtype, zeros = like.dtype, jnp.zeros_like(like)
    rounding = float(np.finfo(dtype).eps)
    tolerance = jnp.maximum(problem.tolerance, 32 * rounding)
    none = jnp.zeros(like.shape, jnp.int32)
    start = _initial_state(problem)
    search = _Search(zeros + FIRST_STEP, none, *[zeros] * 5)
    nodes = None
    if records:
        nodes = _Nodes(*(jnp.zeros((MAX_STEPS, *like.shape), dtype) for _ in _Nodes._fields))

    def body(carry):
        state, search, count, nodes = carry
        active = (state.phase < ENDED) & (state.time < MAX_CONTACT_DURATION)
        searching = search.tries > 0
        step = _propose_step(problem, state, search)
        trial, error = _try_step(problem, state, step)
        if nodes is not None:
            node = state.time, state.depth, state.velocity, trial.start_acceleration, trial.end_acceleration
            nodes = _Nodes(*(leaf.at[count].set(value) for leaf, value in zip(nodes, node, strict=True)))

        deepest = jnp.maximum(state.deepest, jnp.abs(trial.depth))
        errors = jnp.abs(error[0]) / deepest, jnp.abs(error[1]) / problem.approach
        ratio = lax.stop_gradient(jnp.maximum(*errors) / tolerance)
        is_accurate = (ratio <= 1) | (step <= 8 * rounding * state.time)

        def event(time, depth, rate):
            return _event_value(problem, state, time, depth, rate)

        time = state.time + step
        rates = jnp.ones_like(time), trial.velocity, trial.end_acceleration
        value, slope = jax.jvp(event, (time, trial.depth, trial.velocity), rates)
        crosses = ~searching & is_accurate & (value <= 0)
        is_located = searching & ((search.tries >= MAX_EVENT_ITERATIONS) | (value == 0))
        is_accepted = active & (is_located | (~searching & is_accurate & ~crosses))
        # A final Newton step makes the time of the event differentiable.
        slope = lax.stop_gradient(slope)
        correction = jnp.where(is_located & (slope < 0), -value / jnp.where(slope < 0, slope, -1), 0)
        after = _update_state(problem, state, step, trial, correction, is_located)
        growth = jnp.clip(0.9 * jnp.maximum(ratio, 1e-6) ** -0.2, 0.2, 5)
        at_start = event(state.time, state.depth, state.velocity)
        search = _update_search(search, step, step * growth, value, at_start, crosses, is_located)
        # If a batch element has values that are not finite, its motion ends here.
        after = after._replace(phase=jnp.where(jnp.isfinite(ratio), after.phase, ENDED))
        return select_lanes(is_accepted | ~jnp.isfinite(ratio), after, state), search, count + 1, nodes

    def is_running(carry):
        state, _, count, _ = carry
        return jnp.any((state.phase < ENDED) & (state.time < MAX_CONTACT_DURATION)) & (count < MAX_STEPS)

    end, _, count, nodes = lax.while_loop(is_running, body, (start, search, jnp.zeros((), jnp.int32), nodes))
    return end, None if nodes is None else _fill_nodes(nodes, end, count)


def _propose_step(problem, state, search):
    """Return the next step to try [s].

    If an event is bracketed, the step comes from the false position method, else from the error control.
    """
    rise = search.at_high - search.at_low
    middle = search.high - search.at_high * (search.high - search.low) / jnp.where(rise < 0, rise, -1)
    # A step does not cross the end of the push, and is at most 1/50 of the duration of the push.
    push_left = problem.push_end - state.time
    bounded = jnp.minimum(jnp.minimum(search.step, problem.push_end / 50), push_left)
    step = jnp.where(search.tries > 0, middle, jnp.where(push_left > 0, bounded, search.step))
    return lax.stop_gradient(step)


def _fill_nodes(nodes, end, count):
    """Fill the unused rows of `nodes`, from index `count` on, with the final state `end` of the motion."""
    zeros = jnp.zeros_like(end.time)
    is_unused = jnp.arange(MAX_STEPS, dtype=count.dtype).reshape(-1, *[1] * zeros.ndim) >= count
    filling = end.time, end.depth, end.velocity, zeros, zeros
    pairs = zip(nodes, filling, strict=True)
    return _Nodes(*(jnp.where(is_unused, value[None], leaf) for leaf, value in pairs))


def _update_search(search, step, proposed, value, at_start, crosses, is_located):
    """Update the search for an event after a step: the search starts, narrows its bracket, or ends."""
    searching = search.tries > 0
    before = value > 0
    # The Illinois rule halves the value at a bound that does not move for a second time.
    at_low = jnp.where(before, value, jnp.where(search.side < 0, search.at_low / 2, search.at_low))
    at_high = jnp.where(before, jnp.where(search.side > 0, search.at_high / 2, search.at_high), value)
    side = jnp.where(before, 1, -1).astype(step.dtype)
    zeros = jnp.zeros_like(step)
    narrowed = _Search(
        step=jnp.where(searching, search.step, proposed),
        tries=jnp.where(is_located, 0, search.tries + searching.astype(search.tries.dtype)),
        low=jnp.where(before, step, search.low),
        high=jnp.where(before, search.high, step),
        at_low=at_low,
        at_high=at_high,
        side=side,
    )
    started = _Search(step, jnp.ones_like(search.tries), zeros, step, at_start, value, zeros)
    return lax.stop_gradient(select_lanes(crosses, started, narrowed))


def _update_state(problem, state, step, trial, correction, is_located):
    """Return the state at the end of a step.

    The step has a duration of `step` [s], plus `correction` [s] if it ends at an event (`is_located`). The
    next phase of the motion starts at the event.
    """

    def force_at(s):
        depth, rate = interpolate_step(s, step, state.depth, state.velocity, trial)
        return _contact_force(problem, state, depth, rate)

    # The peak within the step is at the vertex of a parabola through the forces at 0, 1/2 and 1.
    first = _contact_force(problem, state, state.depth, state.velocity)
    half, last = force_at(0.5), _contact_force(problem, state, trial.depth, trial.velocity)
    slope, curvature = last - first, first + last - 2 * half
    vertex = jnp.clip(0.5 - slope / (4 * jnp.where(curvature < 0, curvature, -1)), 0, 1)
    top = jnp.where(curvature < 0, force_at(lax.stop_gradient(vertex)), first)
    peak = state.peak
    for force in (first, last, top):
        peak = jnp.where(force > peak, force, peak)
    time = state.time + step + correction
    depth = trial.depth + correction * trial.velocity
    velocity = trial.velocity + correction * trial.end_acceleration
    _, memory = problem.law.step(problem.parameters, state.memory, depth, velocity)
    magnitude, law_value = (
        jnp.abs(depth),
        problem.law.separation_function(problem.parameters, memory, depth, velocity),
    )
    phase = state.phase + is_located.astype(state.phase.dtype)
    phase = jnp.where((phase == FREE) & (time >= problem.push_end), ENDED, phase)
    return _IntegrationState(
        time=time,
        depth=depth,
        velocity=velocity,
        memory=memory,
        phase=phase,
        deepest=lax.stop_gradient(jnp.where(magnitude > state.deepest, magnitude, state.deepest)),
        peak=peak,
        separation_scale=lax.stop_gradient(
            jnp.where(state.phase == INWARD, law_value, state.separation_scale)
        ),
        separation_time=jnp.where(state.phase < FREE, time, state.separation_time),
    )


def _interpolate_nodes(nodes, end, approach, times):
    """Return position [m] and velocity [m/s] at `times`; before 0 and after `end`, assume uniform motion."""
    columns = _Nodes(*(leaf.reshape(leaf.shape[0], -1) for leaf in nodes))
    last = [leaf.reshape(1, -1) for leaf in (end.time, end.depth, end.velocity)]
    requested = times.reshape(times.shape[0], -1)
    # The index has no derivative: the parameters change the times of the nodes, but not their order.
    search = jax.vmap(lambda column, at: jnp.searchsorted(column, at, side="right"), 1, 1)
    index = jnp.clip(search(columns.time, requested) - 1, 0, MAX_STEPS - 2)

    def pick(leaf, rows):
        return jnp.take_along_axis(leaf, rows, axis=0)

    time, depth, velocity = (pick(leaf, index) for leaf in columns[:3])
    step = pick(columns.time, index + 1) - time
    step_end = StepEnd(
        depth=pick(columns.depth, index + 1),
        velocity=pick(columns.velocity, index + 1),
        start_acceleration=pick(columns.start_acceleration, index),
        end_acceleration=pick(columns.end_acceleration, index),
    )
    s = (requested - time) / jnp.where(step > 0, step, 1)
    position, rate = interpolate_step(s, step, depth, velocity, step_end)
    before, after = requested < 0, requested >= last[0]
    approach = approach.reshape(1, -1)
    position = jnp.where(after, last[1] + last[2] * (requested - last[0]), position)
    rate = jnp.where(before, approach, jnp.where(after, last[2], rate))
    position = jnp.where(before, approach * requested, position)
    return position.reshape(times.shape), rate.reshape(times.shape)
