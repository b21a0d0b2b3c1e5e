"""The reference by numerical integration: the motion in space of any contact law, with or without a push.

    M d'' = -F(d, d') - p(t),   d(0) = 0,   d'(0) = v > 0

F is the law's force while the bodies touch and p(t) >= 0 another force on the same body, a spring-loaded
pusher for one, that acts whether they touch or not. Where a law has a closed form
(`jaxhil.contact.reference`) this is its check; where it has none, and wherever there is a push, it is the
reference.

Dormand and Prince's pair of order 5(4) with a step of each lane's own. Turning point and separation are
found by integrating up to them, so that every step ends within one smooth branch of the motion; a law's own
kinks are met by shortened steps. What a law remembers (`ContactLaw.init`, `step`) is carried from step to
step.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.dormand_prince import StepEnd, along, take_step

TOLERANCE = 1e-10  # of a step, against approach velocity and deepest penetration
FIRST_STEP = 1e-4  # s, tried first
LONGEST = 10.0  # s: later the bodies stick to each other
MOST_STEPS = 1000  # rejected ones included
ROOT_STEPS = 16  # of the false position method (Illinois) towards an event
INWARD, OUTWARD, FREE, OVER = range(4)  # phases of the motion, the last but one with a push only


@runtime_checkable
class ForceLaw(Protocol):
    """Part of a contact law that the integration needs (`jaxhil.contact.base.ContactLaw`)."""

    def init(self, penetration: Any) -> tuple[Any, ...]: ...

    def step(self, parameters: Any, state: Any, penetration: Any, rate: Any) -> tuple[Any, Any]: ...

    def edge(self, parameters: Any, rate: Any) -> Any: ...

    def hold(self, parameters: Any, state: Any, penetration: Any, rate: Any) -> Any: ...


class ReferenceMotion(NamedTuple):
    """What a contact in space does, of the batch shape, and its motion at the times asked for."""

    restitution: Float[Array, "*batch"]  # speed |d'| after contact and push are over, over v [1]
    peak_force: Float[Array, "*batch"]  # largest contact force, without the push [N]
    # time from first touch to separation [s]; infinite if there is none within 10 s, or the bodies come to
    # rest (`restitution` is then that of the speed by that time)
    duration: Float[Array, "*batch"]
    position: Float[Array, "samples *batch"] | None  # at the times asked for [m]; None without
    velocity: Float[Array, "samples *batch"] | None  # at the times asked for [m/s]; None without


def integrate_contact(
    law: ForceLaw,
    parameters: Any,
    mass: Float[Array, "*batch"],
    velocity: Float[Array, "*batch"],
    push: Callable[[Array], Array] | None = None,
    push_duration: Float[Array, "*batch"] | float = 0.0,
    times: Float[Array, "samples *batch"] | None = None,
    tolerance: Float[Array, ""] | float = TOLERANCE,
) -> ReferenceMotion:
    """The motion of one contact, entered at `velocity` v [m/s] with equivalent `mass` M [kg].

    It ends by separation: on the way out the penetration, or the force that holds the surfaces together
    (`ContactLaw.hold`), goes through 0. As p >= 0 pushes further apart, they never meet again.

    `push` is p(t) [N] of the time since first touch [s, *batch], for 0 <= t <= `push_duration` [s]; after
    that it is 0. It may have kinks and jumps, but nothing shorter than 1/50 of its duration. Where it
    outlasts the contact the bodies are pushed on, and the restitution is that of the speed when it is over:
    with a push it may exceed 1.
    `times` [s since first touch] may be any, in any order: before 0 and in the end the motion is uniform.
    `tolerance` of each step's error, relative; not below 32 roundings of the arrays' precision.

    Can be jitted, vmapped and differentiated forward, `times` and what `push` encloses included. Shapes as
    for the closed forms: all of one batch shape and one dtype, slopes and depths with a leading axis.
    """
    shape = jnp.broadcast_shapes(jnp.shape(mass), jnp.shape(velocity))
    mass, velocity = jnp.broadcast_to(mass, shape), jnp.broadcast_to(velocity, shape)
    until = jnp.broadcast_to(jnp.asarray(0.0 if push is None else push_duration, velocity.dtype), shape)
    problem = _Problem(law, parameters, mass, velocity, push, until, tolerance)
    end, nodes = _follow(problem, times is not None)
    position = rate = None
    if nodes is not None:
        position, rate = _at_times(nodes, end, velocity, times)
    # What comes to rest at the surface crosses it by rounding alone.
    moving = jnp.abs(end.velocity) > tolerance * velocity
    return ReferenceMotion(
        restitution=jnp.abs(end.velocity) / velocity,
        peak_force=end.peak,
        duration=jnp.where((end.phase >= FREE) & moving, end.separated, jnp.inf),
        position=position,
        velocity=rate,
    )


class _Problem(NamedTuple):
    """What `integrate_contact` is asked for."""

    law: Any  # contact law
    parameters: Any  # its parameters (`jaxhil.contact.laws.ContactParameters`)
    mass: Array  # M [kg]
    approach: Array  # v [m/s]
    push: Any  # p, or None
    until: Array  # end of the push [s]
    tolerance: Float[Array, ""] | float  # of a step's error, relative


class _State(NamedTuple):
    """The motion so far."""

    time: Array  # since first touch [s]
    depth: Array  # penetration [m]
    velocity: Array  # its rate [m/s]
    memory: Any  # state of the contact law
    phase: Array  # INWARD, OUTWARD, FREE or OVER
    deepest: Array  # penetration so far [m]
    peak: Array  # largest contact force so far [N]
    grip: Array  # `hold` at the turning point
    separated: Array  # time of separation [s]


class _Search(NamedTuple):
    """The search for the next step."""

    step: Array  # to try next [s]
    tries: Array  # false positions tried so far towards an event; 0 while there is none in sight
    low: Array  # step known to end before the event [s]
    high: Array  # step known to end behind it [s]
    at_low: Array  # value of the event's function there
    at_high: Array  # value of the event's function there
    side: Array  # which of the two moved last


class _Nodes(NamedTuple):
    """Where steps begin, (nodes, *batch)."""

    time: Array  # [s]
    depth: Array  # penetration [m]
    velocity: Array  # its rate [m/s]
    first: Array  # acceleration at the step's start [m/s^2]
    last: Array  # acceleration at its end [m/s^2]


def _event(problem, state, time, depth, rate):
    """Positive until the phase's end: the turning point, the separation, the end of the push."""
    hold = problem.law.hold(problem.parameters, state.memory, depth, rate)
    # Both of order 1, or the root of their lesser one would be hard to find.
    hold = hold / jnp.where(state.grip > 0, state.grip, 1)
    share = depth / jnp.where(state.deepest > 0, state.deepest, 1)
    parting = jnp.where(hold < share, hold, share)
    event = jnp.where(state.phase == INWARD, rate, parting)
    return jnp.where(state.phase == FREE, problem.until - time, event)


def _contact_force(problem, state, depth, rate):
    """At the surface the limit from inside; beyond it, where a step overshoots, its continuation."""
    force, _ = problem.law.step(problem.parameters, state.memory, depth, rate)
    force = jnp.where(depth > 0, force, problem.law.edge(problem.parameters, rate))
    return jnp.where(state.phase < FREE, force, 0)


def _try(problem, state, length):
    """Return the motion after a step of a `length` [s], and the errors of penetration and rate."""
    pushes = state.time < problem.until

    def slope(offset, motion):
        force = _contact_force(problem, state, *motion)
        if problem.push is not None:
            force = force + jnp.where(pushes, problem.push(state.time + offset), 0)
        return (motion[1], -force / problem.mass), None

    tried = take_step(slope, (state.depth, state.velocity), length)
    return StepEnd(*tried.end, first=tried.slopes[0][1], last=tried.slopes[-1][1]), tried.error


def _first_touch(problem):
    """Return the state at the first touch."""
    zeros = jnp.zeros_like(problem.approach)
    return _State(
        time=zeros,
        depth=zeros,
        velocity=problem.approach,
        memory=problem.law.init(zeros),
        phase=jnp.zeros(zeros.shape, jnp.int32),
        deepest=zeros,
        peak=zeros,
        grip=zeros,
        separated=zeros,
    )


def _follow(problem, records):
    """From the first touch until all is over, at the latest to `LONGEST`; the nodes passed, if recorded."""
    like = problem.approach
    dtype, zeros = like.dtype, jnp.zeros_like(like)
    rounding = float(np.finfo(dtype).eps)
    tolerance = jnp.maximum(problem.tolerance, 32 * rounding)
    none = jnp.zeros(like.shape, jnp.int32)
    start = _first_touch(problem)
    search = _Search(zeros + FIRST_STEP, none, *[zeros] * 5)
    nodes = None
    if records:
        nodes = _Nodes(*(jnp.zeros((MOST_STEPS, *like.shape), dtype) for _ in _Nodes._fields))

    def body(carry):
        state, search, count, nodes = carry
        active = (state.phase < OVER) & (state.time < LONGEST)
        searching = search.tries > 0
        step = _proposed(problem, state, search)
        tried, error = _try(problem, state, step)
        if nodes is not None:
            here = state.time, state.depth, state.velocity, tried.first, tried.last
            nodes = _Nodes(*(leaf.at[count].set(value) for leaf, value in zip(nodes, here, strict=True)))

        deepest = jnp.maximum(state.deepest, jnp.abs(tried.depth))
        errors = jnp.abs(error[0]) / deepest, jnp.abs(error[1]) / problem.approach
        ratio = lax.stop_gradient(jnp.maximum(*errors) / tolerance)
        fine = (ratio <= 1) | (step <= 8 * rounding * state.time)

        def event(time, depth, rate):
            return _event(problem, state, time, depth, rate)

        time = state.time + step
        value, slope = jax.jvp(
            event, (time, tried.depth, tried.velocity), (jnp.ones_like(time), tried.velocity, tried.last)
        )
        crosses = ~searching & fine & (value <= 0)
        found = searching & ((search.tries >= ROOT_STEPS) | (value == 0))
        moves = active & (found | (~searching & fine & ~crosses))
        # A last step of Newton's method gives the event its derivative.
        slope = lax.stop_gradient(slope)
        rest = jnp.where(found & (slope < 0), -value / jnp.where(slope < 0, slope, -1), 0)
        moved = _moved(problem, state, step, tried, rest, found)
        growth = jnp.clip(0.9 * jnp.maximum(ratio, 1e-6) ** -0.2, 0.2, 5)
        at_start = event(state.time, state.depth, state.velocity)
        search = _narrowed(search, step, step * growth, value, at_start, crosses, found)
        # What is not a number ends there.
        moved = moved._replace(phase=jnp.where(jnp.isfinite(ratio), moved.phase, OVER))
        return _choose(moves | ~jnp.isfinite(ratio), moved, state), search, count + 1, nodes

    def goes_on(carry):
        state, _, count, _ = carry
        return jnp.any((state.phase < OVER) & (state.time < LONGEST)) & (count < MOST_STEPS)

    end, _, count, nodes = lax.while_loop(goes_on, body, (start, search, jnp.zeros((), jnp.int32), nodes))
    return end, None if nodes is None else _filled(nodes, end, count)


def _proposed(problem, state, search):
    """The step to try: towards an event that is in sight, else as the errors so far allow."""
    rise = search.at_high - search.at_low
    middle = search.high - search.at_high * (search.high - search.low) / jnp.where(rise < 0, rise, -1)
    # No step across the end of the push, nor across much of it.
    left = problem.until - state.time
    bounded = jnp.minimum(jnp.minimum(search.step, problem.until / 50), left)
    step = jnp.where(search.tries > 0, middle, jnp.where(left > 0, bounded, search.step))
    return lax.stop_gradient(step)


def _filled(nodes, end, count):
    """The nodes, from the number `count` on those of the end."""
    like, zeros = end.time, jnp.zeros_like(end.time)
    late = jnp.arange(MOST_STEPS, dtype=count.dtype).reshape(-1, *[1] * like.ndim) >= count
    rest = end.time, end.depth, end.velocity, zeros, zeros
    return _Nodes(*(jnp.where(late, r[None], leaf) for leaf, r in zip(nodes, rest, strict=True)))


def _narrowed(search, step, proposed, value, at_start, crosses, found):
    """The search after a step: begun, narrowed down, or over."""
    searching = search.tries > 0
    before = value > 0
    # An end that stays for a second time counts half (Illinois).
    at_low = jnp.where(before, value, jnp.where(search.side < 0, search.at_low / 2, search.at_low))
    at_high = jnp.where(before, jnp.where(search.side > 0, search.at_high / 2, search.at_high), value)
    side = jnp.where(before, 1, -1).astype(step.dtype)
    zeros = jnp.zeros_like(step)
    narrowed = _Search(
        step=jnp.where(searching, search.step, proposed),
        tries=jnp.where(found, 0, search.tries + searching.astype(search.tries.dtype)),
        low=jnp.where(before, step, search.low),
        high=jnp.where(before, search.high, step),
        at_low=at_low,
        at_high=at_high,
        side=side,
    )
    begun = _Search(step, jnp.ones_like(search.tries), zeros, step, at_start, value, zeros)
    return lax.stop_gradient(_choose(crosses, begun, narrowed))


def _moved(problem, state, step, tried, rest, found):
    """The state at the end of a step and, where an event was `found`, a `rest` of time later."""

    def force_at(s):
        depth, rate = along(s, step, state.depth, state.velocity, tried)
        return _contact_force(problem, state, depth, rate)

    first = _contact_force(problem, state, state.depth, state.velocity)
    half, last = force_at(0.5), _contact_force(problem, state, tried.depth, tried.velocity)
    slope, bend = last - first, first + last - 2 * half
    vertex = jnp.clip(0.5 - slope / (4 * jnp.where(bend < 0, bend, -1)), 0, 1)
    top = jnp.where(bend < 0, force_at(lax.stop_gradient(vertex)), first)
    peak = state.peak
    for force in (first, last, top):
        peak = jnp.where(force > peak, force, peak)
    time = state.time + step + rest
    depth = tried.depth + rest * tried.velocity
    velocity = tried.velocity + rest * tried.last
    _, memory = problem.law.step(problem.parameters, state.memory, depth, velocity)
    magnitude, hold = jnp.abs(depth), problem.law.hold(problem.parameters, memory, depth, velocity)
    phase = state.phase + found.astype(state.phase.dtype)
    phase = jnp.where((phase == FREE) & (time >= problem.until), OVER, phase)
    return _State(
        time=time,
        depth=depth,
        velocity=velocity,
        memory=memory,
        phase=phase,
        deepest=lax.stop_gradient(jnp.where(magnitude > state.deepest, magnitude, state.deepest)),
        peak=peak,
        grip=lax.stop_gradient(jnp.where(state.phase == INWARD, hold, state.grip)),
        separated=jnp.where(state.phase < FREE, time, state.separated),
    )


def _at_times(nodes, end, approach, times):
    """Position and velocity at `times`, uniform before the first node and after the last."""
    lines = _Nodes(*(leaf.reshape(leaf.shape[0], -1) for leaf in nodes))
    last = [leaf.reshape(1, -1) for leaf in (end.time, end.depth, end.velocity)]
    asked = times.reshape(times.shape[0], -1)
    # The time of a node is a number only: it moves with the parameters, but not which node is next.
    index = jax.vmap(lambda line, at: jnp.searchsorted(line, at, side="right"), 1, 1)(lines.time, asked)
    index = jnp.clip(index - 1, 0, MOST_STEPS - 2)

    def pick(leaf, at):
        return jnp.take_along_axis(leaf, at, axis=0)

    time, depth, velocity = (pick(leaf, index) for leaf in lines[:3])
    step = pick(lines.time, index + 1) - time
    tried = StepEnd(
        depth=pick(lines.depth, index + 1),
        velocity=pick(lines.velocity, index + 1),
        first=pick(lines.first, index),
        last=pick(lines.last, index),
    )
    s = (asked - time) / jnp.where(step > 0, step, 1)
    position, rate = along(s, step, depth, velocity, tried)
    before, after = asked < 0, asked >= last[0]
    approach = approach.reshape(1, -1)
    position = jnp.where(after, last[1] + last[2] * (asked - last[0]), position)
    rate = jnp.where(before, approach, jnp.where(after, last[2], rate))
    position = jnp.where(before, approach * asked, position)
    return position.reshape(times.shape), rate.reshape(times.shape)


def _choose(condition, when_true, when_false):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), when_true, when_false)
