"""The motion that a contact should have had, integrated over again from its entry while the map improves.

Scaled as in `force_depth_map`: the reference enters at depth 0 with speed 1 and obeys

    x' = v,    v' = -f,    f = F(x, v, x_m) + rho [y - F(X, V, X_m)]

with the bracket only as far as the hardware has been measured, until it separates: x <= 0, or v < 0 and
f <= 0; x_m and X_m are the deepest points so far. It is stepped by the velocity Verlet scheme, the damping
implicit in the first half of a step and explicit in the second (order 2), the bracket constant within a step:
the mean of y less that of F at its ends, over as much of the step as y could be read. Samples count by the
hardware's ticks, the present lies between two of them. Passes from the entry take turns with a live motion,
which goes on tick by tick under the newest map (notebooks/guide/retrospective_reference.md section 3).
"""

from functools import reduce
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.compensators.force_depth_map import REACH, Curve, elastic, turning
from jaxhil.compensators.force_depth_map import force as force_of
from jaxhil.compensators.history import LEVELS, SLOTS, History, Samples, level_of, recall

STRIDE = 24  # steps per tick of the pass from the entry
COARSE = 0.002  # s, the longest step of a pass where every sample is kept, at least a tick
LONGEST = (SLOTS - 2) * 4 ** (LEVELS - 1)  # ticks of a contact, up to which it is integrated over again


class Scales(NamedTuple):
    """What the signals of a contact are scaled by."""

    side: Float[Array, "*batch"]  # of the surface, 1 or -1; 0 for no contact
    plane: Float[Array, "*batch"]  # by how much it is deeper than told [m]
    speed: Float[Array, "*batch"]  # approach speed [m/s]
    pace: Float[Array, "*batch"]  # seconds on the contact's scale of time in one [1]
    weight: Float[Array, "*batch"]  # mass times the approach speed times the pace [kg m/s]
    bias: Float[Array, "*batch"]  # of the force sensor [N]


class Entry(NamedTuple):
    """Where a contact's reference begins, and where it is."""

    start: Float[Array, "2 *batch"]  # impulse and shown at the last sample before the hardware's own entry
    tick: Int[Array, "*batch"]  # of the run, of that sample
    since: Float[Array, "*batch"]  # from the entry to the next sample [ticks]
    beyond: Float[Array, "*batch"]  # from the sample `present` to the present [ticks]
    present: Int[Array, "*batch"]  # number of the last whole sample


class ReferenceState(NamedTuple):
    """The reference somewhere on its way."""

    depth: Float[Array, "*batch"]  # [s]
    speed: Float[Array, "*batch"]  # [1]
    deepest: Float[Array, "*batch"]  # point so far [s]
    force: Float[Array, "*batch"]  # without damping and friction [1/s]
    impulse: Float[Array, "*batch"]  # of the hardware's sample there [N ticks]
    shown: Float[Array, "*batch"]  # over how many ticks that is
    farthest: Float[Array, "*batch"]  # deepest point of the hardware so far [s]
    expected: Float[Array, "*batch"]  # force of the map at that sample [1/s]
    free: Float[Array, "*batch"]  # whether (1) it has separated


class Reintegration(NamedTuple):
    """Both integrations of the reference."""

    live: ReferenceState  # motion that goes on tick by tick
    behind: ReferenceState  # motion of the pass from the entry
    reached: Int[Array, "*batch"]  # sample that the pass has reached
    curve: Curve  # map of the pass
    entry: Entry  # of the contact


class Measured(NamedTuple):
    """What the reference is integrated with beside the map."""

    history: History  # measured samples
    scales: Scales  # of the contact
    clearance: Array  # between two surfaces [m]
    replay: Array  # rho, share of the force that the map does not explain
    period: Array  # control period [s], on the contact's scale of time
    coarse: Array  # ticks of the longest step where every sample is kept
    # by how much the force is older than it was taken for, and the surface deeper than it was met [s], which
    # makes it belong to X - older V - deeper; None: 0
    moved: tuple[Array, Array] | None


def depth_of(scales: Scales, clearance: Array, position: Array) -> Array:
    """Depth [s] at a position [m]."""
    return (beyond(scales.side, clearance, position) - scales.plane) / (scales.speed / scales.pace)


def beyond(side: Array, clearance: Array, position: Array) -> Array:
    """By how much [m] a position [m] is beyond the surface of a side as told."""
    return jnp.where(side < 0, -clearance - position, position)


def unentered(like: Array, curve: Curve) -> Reintegration:
    """Before the first contact."""
    zeros, counts = jnp.zeros_like(like), jnp.zeros(like.shape, jnp.int32)
    entry = Entry(jnp.stack([zeros] * 2), counts - 1, zeros + 0.5, zeros, counts)
    state = _enter(entry, curve)
    return Reintegration(state, state, entry.tick, curve, entry)


def begin(
    old: Reintegration,
    found: Bool[Array, "*batch"],
    index: Int[Array, "*batch"],
    start: Samples,
    since: Array,
    depth: Array,
    period: Array,
) -> Reintegration:
    """Before a tick at which it is `found` that the hardware has met the surface `since` [ticks] before the
    sample after that of the tick `index`, the numerical model `depth` [s] ago: until the first pass is done,
    it should go on as it does."""
    ticks = depth / period - since
    ticks = jnp.where(ticks < LONGEST, ticks, LONGEST)
    whole = jnp.where(ticks > 0, jnp.floor(ticks), 0)
    entry = Entry(
        jnp.stack([start.impulse, start.shown]),
        index,
        since,
        jnp.where(ticks > 0, ticks - whole, 0),
        index + whole.astype(jnp.int32),
    )
    entry = _choose(found, entry, old.entry)
    goes_on = _enter(entry, old.curve)._replace(depth=depth - period, free=jnp.ones_like(depth))
    live = _choose(found, goes_on, old.live)
    return old._replace(live=live, reached=jnp.where(found, index, old.reached), entry=entry)


def follow(old: Reintegration, curve: Curve, measured: Measured) -> Reintegration:
    """One tick of the live motion, and of the pass."""
    period, history = measured.period, measured.history
    entry = old.entry._replace(present=old.entry.present + 1)
    present = entry.present
    starts = old.reached == entry.tick
    goes = ~starts | (history.age - entry.tick < LONGEST)
    curve_behind = _choose(starts, curve, old.curve)
    behind = _choose(starts, _enter(entry, curve), old.behind)
    coarse = measured.coarse

    def one(_, carry):
        motion, reached = carry
        ahead = goes & (reached < present)
        index = _next(history, reached, present, coarse)
        ticks = (index - reached).astype(period.dtype)
        ticks = jnp.where(reached == entry.tick, ticks + (entry.since - 1), ticks)
        moved = _advance(curve_behind, motion, measured, index, ticks)
        chosen = jax.tree.map(lambda a, b: jnp.where(ahead, a, b), moved, motion)
        return ReferenceState(*chosen), jnp.where(ahead, index, reached)

    behind, reached = lax.fori_loop(0, STRIDE, one, (behind, old.reached))
    done = reached == present
    newest, motion = _choose(done, (curve_behind, behind), (curve, old.live))
    live = _advance(newest, motion, measured, present, jnp.where(done, entry.beyond, 1))
    return Reintegration(live, behind, jnp.where(done, entry.tick, reached), curve_behind, entry)


def _enter(entry: Entry, curve: Curve) -> ReferenceState:
    """Depth 0, speed 1."""
    zeros = jnp.zeros_like(entry.since)
    impulse, shown = entry.start
    jump = curve.preload + (curve.damping + curve.friction)
    return ReferenceState(zeros, zeros + 1, zeros, curve.preload, impulse, shown, zeros, jump, zeros)


def _next(history: History, index: Array, present: Array, coarse: Array) -> Int[Array, "*batch"]:
    """The sample to go on to: as far as is measured, one that is kept."""
    stride = jnp.maximum(coarse, 1 << (2 * level_of(history, index)))
    kept = jnp.minimum(((index + 1) // stride + 1) * stride - 1, history.age)
    return jnp.minimum(jnp.where(index < history.age, kept, index + coarse), present)


def _advance(
    curve: Curve, motion: ReferenceState, measured: Measured, index: Array, ticks: Array
) -> ReferenceState:
    """One step of so many `ticks`, to the sample `index`."""
    known = (index <= measured.history.age) & (ticks > 0)
    sample = recall(measured.history, jnp.minimum(index, measured.history.age))
    scales = measured.scales
    rate = scales.side * sample.velocity / scales.speed
    hardware = depth_of(scales, measured.clearance, sample.position)
    if measured.moved is not None:
        hardware = hardware - (measured.moved[0] * rate + measured.moved[1])
    farthest = jnp.where(hardware > motion.farthest, hardware, motion.farthest)
    expected = force_of(curve, hardware, rate, farthest)
    shown = sample.shown - motion.shown
    part = jnp.where(shown < ticks, shown, ticks)
    impulse = (sample.impulse - motion.impulse) - scales.bias * shown
    gap = scales.side * impulse / scales.weight - part * (0.5 * (motion.expected + expected))
    missing = jnp.where(known, measured.replay * (gap / jnp.where(known, ticks, 1)), 0)
    moved = _verlet(curve, motion, ticks * measured.period, missing)
    return moved._replace(
        impulse=jnp.where(known, sample.impulse, motion.impulse),
        shown=jnp.where(known, sample.shown, motion.shown),
        farthest=jnp.where(known, farthest, motion.farthest),
        expected=jnp.where(known, expected, motion.expected),
    )


def _verlet(curve: Curve, motion: ReferenceState, duration: Array, missing: Array) -> ReferenceState:
    """One step of this `duration` [s] with so much force [1/s] beside the map's."""
    half = 0.5 * duration
    push = jnp.where(motion.free > 0, 0, 1)

    def damping(depth):
        return curve.damping + curve.depth_damping * jnp.where(depth > 0, depth, 0) / REACH

    drag = damping(motion.depth) * half * push
    rubbed = curve.friction * turning(motion.speed)
    middle = (motion.speed - half * push * (motion.force + rubbed + missing)) / (1 + drag)
    depth = motion.depth + duration * middle
    deeper = (depth > motion.deepest) & (push > 0)
    deepest = jnp.where(deeper, depth, motion.deepest)
    inside = depth > 0
    force = jnp.where(inside, elastic(curve, depth) - curve.unloading * (deepest - depth), 0)
    rubbing = jnp.where(inside, curve.friction * turning(middle), 0)
    dragging = damping(depth)
    speed = middle - push * half * (force + rubbing + missing + dragging * middle)
    free = ~inside | ((speed < 0) & (force + rubbing + missing + dragging * speed <= 0))
    free = (motion.free > 0) | free
    return motion._replace(
        depth=depth, speed=speed, deepest=deepest, force=force, free=free.astype(depth.dtype)
    )


def longest_step(period: Array) -> Int[Array, "*batch"]:
    """The ticks of the longest step of a pass where every sample is kept: a power of two."""
    most = COARSE * (1 + 1e-9) / period
    return 1 + reduce(add, ((most >= 2**power).astype(jnp.int32) << (power - 1) for power in range(1, 8)))


def _choose(condition, when_true, when_false):
    """Lane by lane; leaves may have a leading axis."""

    def choose(a, b):
        return jnp.where(condition if a.ndim == condition.ndim else condition[None], a, b)

    return jax.tree.map(choose, when_true, when_false)
