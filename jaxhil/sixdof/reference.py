"""Ideal contact as the reference of a run on the rig.

The ideal contact is integrated once, for the whole duration of the run. An episode of the rig ends when both
the rig and the ideal contact are free. Therefore this module records the gaps between touches of the ideal
contact (periods in which nothing touches), with the motion of the bodies at the start of each gap.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import select_lanes
from jaxhil.sixdof.first_touch import Meeting, meet
from jaxhil.sixdof.peaks import Peak, higher, no_peak
from jaxhil.sixdof.relative import Pair, States, Twist, mass_matrix, relative
from jaxhil.sixdof.space import (
    Flight,
    Instant,
    Space,
    advance_flight,
    fly,
    scale,
    start_flight,
)
from jaxhil.sixdof.vectors import norm

FIRST = 1e-4  # s; length of the first integration step
LONGEST = 2.0  # control periods; maximum length of an integration step near a touch
GAPS = 4  # maximum number of recorded gaps between touches
# Minimum change of the twist after which an episode may end, divided by the twist before the contact [1].
LEAST_CHANGE = 0.05


class Past(NamedTuple):
    """Past of the ideal contact: its metrics up to a time, and the states at this time."""

    time: Float[Array, "*batch"]  # time since the start [s]
    states: States  # states of the bodies at the instants in `time`
    touches: Int[Array, "*batch"]  # number of touches of all pairs of shapes
    touched: Float[Array, "*batch"]  # time during which shapes touched [s]
    peak_force: Float[Array, "*batch"]  # peak force [N]
    peak_moment: Float[Array, "*batch"]  # peak moment about the origin of target frame T [N m]
    captured: Bool[Array, "*batch"]  # whether a latch holds


class Gaps(NamedTuple):
    """Gaps of the ideal contact: periods without a touch that follow a noticeable change of the twist.

    Arrays are (GAPS, *batch). If there are more gaps, the latest gap overwrites the last entry. An unused
    entry begins at infinity.
    """

    begin: Past  # ideal contact up to the start of the gap
    end: Float[Array, "gaps *batch"]  # time of the next touch [s]; infinite if nothing touches again


class Reference(NamedTuple):
    """Ideal contact for the whole duration of a run: first touch, gaps, and values at the end."""

    meeting: Meeting  # first touch
    gaps: Gaps
    # ideal contact up to the end of the run; the time is infinite if it was too stiff to be integrated
    last: Past


class Passage(NamedTuple):
    """State of the integration of an ideal contact, with the metrics so far."""

    flight: Flight  # motion of the bodies, with the state of the integrator
    touching: tuple[Bool[Array, "candidates *batch"], ...]  # whether each pair of shapes touches, per group
    touches: Int[Array, "*batch"]  # number of touches of all pairs of shapes
    touched: Float[Array, "*batch"]  # time during which shapes touched [s]
    before: States  # states at the start of the step in which the first touch begins
    depths: tuple[Float[Array, "candidates *batch"], ...]  # penetrations at the end of the same step [m]
    force: Peak  # peak force [N]
    moment: Peak  # peak moment about the origin of target frame T [N m]
    gaps: Gaps
    slot: Int[Array, "*batch"]  # index of the current or next gap
    active: Bool[Array, "*batch"]  # whether the integration of each lane continues


class Approach(NamedTuple):
    """Quantities that stay constant during the integration of the ideal contact."""

    twist: Twist  # twist of chaser frame C relative to target frame T at the start
    mass: Float[Array, "6 6 *batch"]  # relative mass matrix
    speed: Float[Array, "*batch"]  # speed that scales the integration error, see `space.scale` [m/s]
    quiet: Float[Array, "*batch"]  # minimum duration of a recorded gap between touches [s]


def follow_contact(space: Space, states: States, quiet: Array, until: Array, period: Array) -> Reference:
    """Integrate the ideal contact of two bodies that start apart.

    Args:
        space: Constants of the ideal contact.
        states: States of the bodies at the start, without contact.
        quiet: Minimum duration of a recorded gap between touches [s].
        until: Duration of the integration [s].
        period: Control period [s]; integration steps near a touch last at most two control periods.
    """
    _, twist = relative(space.bodies, states)
    approach = Approach(twist, mass_matrix(space.bodies, states), scale(space, states), quiet)
    longest = LONGEST * period

    def body(passage: Passage) -> Passage:
        left = until - passage.flight.time
        after, step = advance_flight(space, passage.flight, left, longest, approach.speed)
        # A rejected step changes nothing but the length of the next step.
        going = select_lanes(step.accepted, _updated(passage, approach, after, step.now), passage)
        going = going._replace(flight=after)
        done = (until - after.time <= 1e-13 * until) | ~jnp.isfinite(after.time)
        return select_lanes(passage.active, going._replace(active=~done), passage)

    start = _start(space, states, jnp.minimum(FIRST, until))._replace(active=until > 0)
    passage = lax.while_loop(lambda passage: jnp.any(passage.active), body, start)
    return Reference(meet(space, passage.before, passage.depths), passage.gaps, _past(passage))


def is_quiet(reference: Reference, time: Array, quiet: Array) -> Bool[Array, "*batch"]:
    """Return whether the ideal contact, at a `time` [s], has had no touch for at least `quiet` [s]."""
    begin, end = reference.gaps.begin.time, reference.gaps.end
    return jnp.any((begin + quiet[None] <= time[None]) & (time[None] < end), axis=0)


def past_at(reference: Reference, time: Array, common: Bool[Array, "*batch"]) -> Past:
    """Return the past of the ideal contact at the start of the gap in which a `time` [s] lies.

    A gap is a period without a touch. In lanes in which `common` is false, return the past at the run's end.
    """
    past = reference.last
    for slot in range(GAPS):
        begin = jax.tree.map(lambda leaf, slot=slot: leaf[slot], reference.gaps.begin)
        past = select_lanes(common & (begin.time <= time) & (time < reference.gaps.end[slot]), begin, past)
    return past


def states_at(bodies: Pair, past: Past, time: Float[Array, "*batch"]) -> States:
    """Extend the ideal contact by free flight, and return the bodies' states at a `time` [s]."""
    free = Space(bodies, (), ())
    left = jnp.where(time > past.time, time - past.time, 0)
    flight = start_flight(free, past.states, left)
    return fly(free, flight, left, left, scale(free, past.states)).states


def _start(space: Space, states: States, first: Float[Array, "*batch"]) -> Passage:
    """Return the state of the integration before the first step, which has the length `first` [s]."""
    zero, none = jnp.zeros_like(first), jnp.zeros(first.shape, jnp.int32)
    depths = tuple(jnp.zeros_like(group.parameters.damping) for group in space.groups)
    touching = tuple(depth > 0 for depth in depths)
    passage = Passage(
        flight=start_flight(space, states, first),
        touching=touching,
        touches=none,
        touched=zero,
        before=states,
        depths=depths,
        force=no_peak(zero),
        moment=no_peak(zero),
        gaps=Gaps(None, zero),  # type: ignore[arg-type]
        slot=none,
        active=none == 0,
    )
    past: Any = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (GAPS, *leaf.shape)), _past(passage))
    never = jnp.full((GAPS, *first.shape), jnp.inf, first.dtype)
    return passage._replace(gaps=Gaps(past._replace(time=never), never))


def _past(passage: Passage) -> Past:
    """Return the metrics of the ideal contact so far."""
    captured = passage.touches < 0
    for latch in passage.flight.memories.held:
        captured = captured | jnp.any(latch.caught, axis=0)
    return Past(
        time=passage.flight.time,
        states=passage.flight.states,
        touches=passage.touches,
        touched=passage.touched,
        peak_force=passage.force.largest,
        peak_moment=passage.moment.largest,
        captured=captured,
    )


def _recorded(passage: Passage, approach: Approach, ahead: Passage, now: Instant) -> Passage:
    """Record in `ahead` the gap, if any, that begins or ends in the step from `passage` to `ahead`."""
    was, touches = _touches(passage), _touches(ahead)
    slot = jnp.arange(GAPS, dtype=jnp.int32).reshape(-1, *[1] * was.ndim) == passage.slot[None]
    change = jnp.stack(jax.tree.leaves(jax.tree.map(jnp.subtract, now.twist, approach.twist)))
    twist = jnp.stack(jax.tree.leaves(approach.twist))
    is_noticeable = _square(approach.mass, change) >= LEAST_CHANGE**2 * _square(approach.mass, twist)
    begins = slot & (was & ~touches & is_noticeable)[None]
    past = jax.tree.map(lambda new, old: jnp.where(begins, new[None], old), _past(ahead), ahead.gaps.begin)
    # A gap ends at the last time without a touch.
    start = jnp.min(jnp.where(slot, ahead.gaps.begin.time, jnp.inf), axis=0)
    ends = ~was & touches & jnp.isfinite(start)
    end = jnp.where(begins, jnp.inf, ahead.gaps.end)
    end = jnp.where(slot & ends[None], passage.flight.time[None], end)
    is_long = ends & (passage.flight.time - start >= approach.quiet)
    past = past._replace(time=jnp.where(slot & (ends & ~is_long)[None], jnp.inf, past.time))
    next_slot = jnp.minimum(passage.slot + is_long.astype(jnp.int32), GAPS - 1)
    return ahead._replace(gaps=Gaps(past, end), slot=next_slot)


def _square(matrix: Array, vector: Array) -> Array:
    """Return the quadratic form vector^T matrix vector."""
    return jnp.sum(vector[:, None] * matrix * vector[None], axis=(0, 1))


def _updated(passage: Passage, approach: Approach, after: Flight, now: Instant) -> Passage:
    """Update the metrics of the ideal contact with a step that ends with the motion `after`."""
    depths = tuple(forces.touch.depth for forces in now.forces)
    touching = tuple(depth > 0 for depth in depths)
    touches = passage.touches
    for now_touching, before in zip(touching, passage.touching, strict=True):
        touches = touches + jnp.sum(now_touching & ~before, axis=0, dtype=touches.dtype)
    ahead = passage._replace(flight=after, touching=touching, touches=touches)
    first = (passage.touches == 0) & (touches > 0)
    step = after.time - passage.flight.time
    # The force has a jump or a kink where a touch begins or ends.
    bends = jnp.zeros(step.shape, bool)
    for now_touching, before in zip(touching, passage.touching, strict=True):
        bends = bends | jnp.any(now_touching != before, axis=0)
    touched = passage.touched + jnp.where(_touches(passage), step, 0)
    ahead = ahead._replace(
        touched=touched,
        before=select_lanes(touches == 0, now.states, passage.before),
        depths=select_lanes(first, depths, passage.depths),
        force=higher(passage.force, norm(now.wrench.force), step, bends),
        moment=higher(passage.moment, norm(now.wrench.moment), step, bends),
    )
    return _recorded(passage, approach, ahead, now)


def _touches(passage: Passage) -> Array:
    """Return whether any pair of shapes touches or any latch holds."""
    result = jnp.zeros(passage.touched.shape, bool)
    for flags in (*passage.touching, *(latch.caught for latch in passage.flight.memories.held)):
        result = result | jnp.any(flags, axis=0)
    return result
