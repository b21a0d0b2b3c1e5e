"""Episode of the ideal contact: two bodies that touch without a rig."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.sixdof.bodies import Load, kick_drift
from jaxhil.sixdof.candidates import Touch, motion_at
from jaxhil.sixdof.peaks import Peak, higher, no_peak
from jaxhil.sixdof.relative import Pair, States, effective_mass, relative
from jaxhil.sixdof.space import Flight, Instant, Space, advance_flight, choose, scale, start_flight
from jaxhil.sixdof.vectors import Vector, norm

FIRST = 1e-4  # s; first step
TOUCH_STEPS = 4  # steps of Newton's method for the time of the first touch


class Meeting(NamedTuple):
    """First touch of an episode, in T axes."""

    states: States  # states of the bodies
    point: Vector  # point of the touch [m]
    normal: Vector  # normal of the target's surface


class Passage(NamedTuple):
    """State of an episode's integration."""

    flight: Flight
    touching: tuple[Bool[Array, "candidates *batch"], ...]
    touches: Int[Array, "*batch"]  # number of onsets of touch, over all candidates
    touched: Float[Array, "*batch"]  # time in touch [s]
    left: Float[Array, "*batch"]  # time of the last touch [s]
    before: States  # last states before the first touch
    depths: tuple[Float[Array, "candidates *batch"], ...]  # penetrations at the first step in touch [m]
    force: Peak  # peak force [N]
    moment: Peak  # peak moment about T's origin [N m]
    active: Bool[Array, "*batch"]


def pass_through(
    space: Space, states: States, quiet: Array, until: Float[Array, "*batch"], longest: Array
) -> Passage:
    """Integrate the episode of free bodies until it is over, or until a time [s].

    It is over when nothing has touched for a time `quiet` [s] after the first touch. No step is longer than
    `longest` [s], which must be shorter than any touch.
    """
    flight = start_flight(space, states, jnp.minimum(FIRST, until))
    speed = scale(space, states)
    zero, none = jnp.zeros_like(until), jnp.zeros(until.shape, jnp.int32)
    depths = tuple(jnp.zeros_like(group.parameters.damping) for group in space.groups)
    touching = tuple(depth > 0 for depth in depths)
    start = Passage(
        flight=flight,
        touching=touching,
        touches=none,
        touched=zero,
        left=zero,
        before=states,
        depths=depths,
        force=no_peak(zero),
        moment=no_peak(zero),
        active=until > 0,
    )

    def body(passage: Passage) -> Passage:
        left = until - passage.flight.time
        after, step = advance_flight(space, passage.flight, jnp.minimum(longest, left), speed)
        updated = _updated(passage, after, step.now)
        # A rejected step changes only the length of the next one.
        going = choose(step.accepted, updated, passage)._replace(flight=after)
        free = (going.touches > 0) & (going.flight.time - going.left >= quiet) & ~_touches(going)
        done = free | (until - going.flight.time <= 1e-13 * until) | ~jnp.isfinite(going.flight.time)
        return choose(passage.active, going._replace(active=~done), passage)

    return lax.while_loop(lambda passage: jnp.any(passage.active), body, start)


def over_time(passage: Passage, quiet: Array) -> Float[Array, "*batch"]:
    """Return the time [s] at which the episode was over.

    If nothing touches at its end, this is `quiet` [s] after the last touch.
    """
    free = (passage.touches > 0) & ~_touches(passage)
    return jnp.minimum(passage.flight.time, jnp.where(free, passage.left + quiet, jnp.inf))


def meet(space: Space, passage: Passage) -> Meeting:
    """Return the first touch, found on the free flight before it."""
    if not space.groups:
        apart = jnp.full_like(passage.left, jnp.nan)
        nowhere = Vector(apart, apart, apart)
        return Meeting(passage.before, nowhere, nowhere)

    def touch_of(states: States) -> tuple[Touch, Array]:
        """Return a candidate's touch and the rate of its penetration.

        The candidate is the one with the largest penetration at the end of the step.
        """
        pose, twist = jax.tree.map(lambda leaf: leaf[None], relative(space.bodies, states))
        touches = [group.candidates.touch(pose) for group in space.groups]
        rates = [motion_at(touch, pose, twist)[0] for touch in touches]
        return _deepest(list(zip(touches, rates, strict=True)), passage.depths)

    # The loop is not unrolled: the compiler would fuse and repeat the computations.
    def newton(_, carry: tuple[Array, States, Meeting]) -> tuple[Array, States, Meeting]:
        time, states, _ = carry
        touch, rate = touch_of(states)
        time = time - touch.depth / jnp.where(rate > 0, rate, jnp.inf)
        ahead = glide(space.bodies, passage.before, time)
        return time, ahead, Meeting(states, touch.point, touch.normal)

    zero = jnp.zeros_like(passage.left)
    nothing = Vector(zero, zero, zero)
    start = zero, passage.before, Meeting(passage.before, nothing, nothing)
    *_, meeting = lax.fori_loop(0, TOUCH_STEPS, newton, start)
    return meeting


def _deepest(candidates: list[tuple[Touch, Array]], depths: tuple[Array, ...]) -> tuple[Touch, Array]:
    """Return the candidate with the largest of the penetrations `depths`."""
    best: tuple[tuple[Touch, Array], Array] | None = None
    for candidate, depth in zip(candidates, depths, strict=True):
        index = jnp.argmax(depth, axis=0)[None]

        def pick(leaf: Array, index: Array = index, like: Array = depth) -> Array:
            return jnp.take_along_axis(jnp.broadcast_to(leaf, like.shape), index, axis=0)[0]

        deepest = jax.tree.map(pick, candidate), pick(depth)
        best = deepest if best is None else choose(deepest[1] > best[1], deepest, best)
    assert best is not None
    return best[0]


def meeting_mass(bodies: Pair, meeting: Meeting) -> Float[Array, "*batch"]:
    """Return the effective mass [kg] of the first touch along its normal."""
    return effective_mass(bodies, meeting.states, meeting.point, meeting.normal)


def glide(bodies: Pair, states: States, time: Float[Array, "*batch"]) -> States:
    """Return the states after a short free flight [s], in one step."""
    zero = jnp.zeros_like(time)
    nothing = Vector(zero, zero, zero)
    return States(*(
        kick_drift(body, state, Load(nothing, nothing), time, 1.0)
        for body, state in zip(bodies, states, strict=True)
    ))  # fmt: skip


def _updated(passage: Passage, after: Flight, now: Instant) -> Passage:
    """Return the episode after a step that ends `now`."""
    depths = tuple(forces.touch.depth for forces in now.forces)
    touching = tuple(depth > 0 for depth in depths)
    touches = passage.touches
    for now_touching, before in zip(touching, passage.touching, strict=True):
        touches = touches + jnp.sum(now_touching & ~before, axis=0, dtype=touches.dtype)
    ahead = passage._replace(flight=after, touching=touching, touches=touches)
    first = (passage.touches == 0) & (touches > 0)
    step = after.time - passage.flight.time
    # At the begin or end of a touch the force jumps or has a corner.
    bends = jnp.zeros(step.shape, bool)
    for now_touching, before in zip(touching, passage.touching, strict=True):
        bends = bends | jnp.any(now_touching != before, axis=0)
    touched = passage.touched + jnp.where(_touches(passage), step, 0)
    return ahead._replace(
        touched=touched,
        left=jnp.where(_touches(ahead), after.time, passage.left),
        before=choose(touches == 0, now.states, passage.before),
        depths=choose(first, depths, passage.depths),
        force=higher(passage.force, norm(now.wrench.force), step, bends),
        moment=higher(passage.moment, norm(now.wrench.moment), step, bends),
    )


def _touches(passage: Passage) -> Array:
    """Return whether something touches or a latch holds."""
    result = jnp.zeros(passage.left.shape, bool)
    for flags in (*passage.touching, *(latch.caught for latch in passage.flight.memories.held)):
        result = result | jnp.any(flags, axis=0)
    return result
