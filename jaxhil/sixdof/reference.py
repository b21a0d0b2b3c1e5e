"""An episode in space: what becomes of two bodies that meet without a rig between them."""

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

FIRST = 1e-4  # s: the first step
TOUCH_STEPS = 4  # of Newton's method for the time of the first touch


class Meeting(NamedTuple):
    """The first touch of an episode, in T axes."""

    states: States  # then
    point: Vector  # where [m]
    normal: Vector  # of the target's surface


class Passage(NamedTuple):
    """An episode on its way."""

    flight: Flight
    touching: tuple[Bool[Array, "candidates *batch"], ...]
    touches: Int[Array, "*batch"]  # candidates that began to touch
    touched: Float[Array, "*batch"]  # time in which something touched [s]
    left: Float[Array, "*batch"]  # since when nothing touches [s]
    before: States  # the last ones before the first touch
    depths: tuple[Float[Array, "candidates *batch"], ...]  # of the candidates soon after it [m]
    force: Peak  # [N]
    moment: Peak  # about T's origin [N m]
    active: Bool[Array, "*batch"]


def pass_through(
    space: Space, states: States, quiet: Array, until: Float[Array, "*batch"], longest: Array
) -> Passage:
    """The episode of bodies that are free, until nothing has touched for a time `quiet` [s] after the first
    touch, or until a time [s]; no step is longer than `longest` [s], shorter than any touch."""
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
        after, tried = advance_flight(space, passage.flight, jnp.minimum(longest, left), speed)
        seen = _seen(passage, after, tried.now)
        # What is tried again changes the length alone.
        going = choose(tried.accepted, seen, passage)._replace(flight=after)
        free = (going.touches > 0) & (going.flight.time - going.left >= quiet) & ~_touches(going)
        done = free | (until - going.flight.time <= 1e-13 * until) | ~jnp.isfinite(going.flight.time)
        return choose(passage.active, going._replace(active=~done), passage)

    return lax.while_loop(lambda passage: jnp.any(passage.active), body, start)


def over_time(passage: Passage, quiet: Array) -> Float[Array, "*batch"]:
    """When [s] the episode was over: where nothing touches at its end, `quiet` [s] after the last touch."""
    free = (passage.touches > 0) & ~_touches(passage)
    return jnp.minimum(passage.flight.time, jnp.where(free, passage.left + quiet, jnp.inf))


def meet(space: Space, passage: Passage) -> Meeting:
    """The first touch, found on the free flight before it."""
    if not space.groups:
        apart = jnp.full_like(passage.left, jnp.nan)
        nowhere = Vector(apart, apart, apart)
        return Meeting(passage.before, nowhere, nowhere)

    def touch_of(states: States) -> tuple[Touch, Array]:
        """That of the candidate which is the deepest at the end of the step, and the rate of its depth."""
        pose, twist = jax.tree.map(lambda leaf: leaf[None], relative(space.bodies, states))
        touches = [group.candidates.touch(pose) for group in space.groups]
        found = [(touch, motion_at(touch, pose, twist)[0]) for touch in touches]
        return _deepest(found, passage.depths)

    # A loop, not unrolled: fused into one another the steps would be worked out over and over.
    def newton(_, reached: tuple[Array, States, Meeting]) -> tuple[Array, States, Meeting]:
        time, states, _ = reached
        touch, rate = touch_of(states)
        time = time - touch.depth / jnp.where(rate > 0, rate, jnp.inf)
        ahead = glide(space.bodies, passage.before, time)
        return time, ahead, Meeting(states, touch.point, touch.normal)

    zero = jnp.zeros_like(passage.left)
    nothing = Vector(zero, zero, zero)
    start = zero, passage.before, Meeting(passage.before, nothing, nothing)
    *_, meeting = lax.fori_loop(0, TOUCH_STEPS, newton, start)
    return meeting


def _deepest(found: list[tuple[Touch, Array]], depths: tuple[Array, ...]) -> tuple[Touch, Array]:
    """Of all candidates the one with the largest of the depths."""
    best: tuple[tuple[Touch, Array], Array] | None = None
    for one, depth in zip(found, depths, strict=True):
        which = jnp.argmax(depth, axis=0)[None]

        def of_it(leaf: Array, which: Array = which, like: Array = depth) -> Array:
            return jnp.take_along_axis(jnp.broadcast_to(leaf, like.shape), which, axis=0)[0]

        here = jax.tree.map(of_it, one), of_it(depth)
        best = here if best is None else choose(here[1] > best[1], here, best)
    assert best is not None
    return best[0]


def meeting_mass(bodies: Pair, meeting: Meeting) -> Float[Array, "*batch"]:
    """Effective mass [kg] that the first touch meets along its normal."""
    return effective_mass(bodies, meeting.states, meeting.point, meeting.normal)


def glide(bodies: Pair, states: States, time: Float[Array, "*batch"]) -> States:
    """The states after a short free flight [s], in one step."""
    zero = jnp.zeros_like(time)
    nothing = Vector(zero, zero, zero)
    return States(*(
        kick_drift(body, state, Load(nothing, nothing), time, 1.0)
        for body, state in zip(bodies, states, strict=True)
    ))  # fmt: skip


def _seen(passage: Passage, after: Flight, now: Instant) -> Passage:
    """What a step adds that ends now."""
    depths = tuple(forces.touch.depth for forces in now.forces)
    touching = tuple(depth > 0 for depth in depths)
    touches = passage.touches
    for one, before in zip(touching, passage.touching, strict=True):
        touches = touches + jnp.sum(one & ~before, axis=0, dtype=touches.dtype)
    ahead = passage._replace(flight=after, touching=touching, touches=touches)
    first = (passage.touches == 0) & (touches > 0)
    step = after.time - passage.flight.time
    # What begins or ceases to touch makes the force jump or bend.
    bends = jnp.zeros(step.shape, bool)
    for one, before in zip(touching, passage.touching, strict=True):
        bends = bends | jnp.any(one != before, axis=0)
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
    """Whether something touches, or a latch holds."""
    found = jnp.zeros(passage.left.shape, bool)
    for one in (*passage.touching, *(held.caught for held in passage.flight.memories.held)):
        found = found | jnp.any(one, axis=0)
    return found
