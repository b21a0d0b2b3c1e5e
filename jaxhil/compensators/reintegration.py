"""The motion that a contact should have had, integrated over again from its entry while the map improves.

Scaled as in `force_depth_map`: the reference enters at depth 0 with speed 1 and obeys

    x' = v,    v' = -f,    f = F(x, v, x_m) + rho [y - F(X, V, X_m)]

with the bracket only as far as the hardware has been measured, until it separates: x <= 0, or v < 0 and
f <= 0; x_m and X_m are the deepest points so far. It is stepped by the velocity Verlet scheme, the damping
implicit in the first half of a step and explicit in the second (order 2), the bracket constant within a step:
the mean of y less that of F at its ends, over as much of the step as y could be read. Samples are counted in
ticks from the reference's entry; measured ones are moved to that grid by straight lines, such that the
hardware's own entry falls on the reference's. Passes from the entry take turns with a live motion, which goes
on tick by tick under the newest map (notebooks/guide/retrospective_reference.md section 3).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.compensators.force_depth_map import REACH, Curve, elastic
from jaxhil.compensators.force_depth_map import force as force_of
from jaxhil.compensators.ring_buffer import write

STRIDE = 24  # steps per tick of the pass from the entry
COARSE = 0.002  # s, the longest step of that pass, at least a tick
HISTORY = 1024  # samples kept; a longer contact is not integrated over again


class ReferenceState(NamedTuple):
    """The reference somewhere on its way."""

    depth: Float[Array, "*batch"]  # [s]
    speed: Float[Array, "*batch"]  # [1]
    deepest: Float[Array, "*batch"]  # point so far [s]
    force: Float[Array, "*batch"]  # without damping [1/s]
    # integral of the measured force since the entry, at the measured sample there [ticks/s]
    impulse: Float[Array, "*batch"]
    read: Float[Array, "*batch"]  # over how many ticks that is
    expected: Float[Array, "*batch"]  # force of the map at that sample [1/s]
    free: Float[Array, "*batch"]  # whether (1) it has separated


class History(NamedTuple):
    """Measured samples on the reference's grid, by the tick at which each came."""

    # per sample the integral since the entry [ticks/s] of the y that could be read, over how many ticks that
    # is, depth X [s], speed V [1], deepest point X_m [s]
    ring: Float[Array, "samples 5 *batch"]
    origin: Int[Array, "*batch"]  # tick at which sample 0 came
    number: Int[Array, "*batch"]  # of samples that have come


class Reintegration(NamedTuple):
    """Both integrations of the reference."""

    live: ReferenceState  # motion that goes on tick by tick
    behind: ReferenceState  # motion of the pass from the entry
    reached: Int[Array, "*batch"]  # sample that the pass has reached; -1 for the entry
    curve: Curve  # map of the pass


class Measured(NamedTuple):
    """What the reference is integrated with beside the map."""

    history: History  # measured samples
    replay: Array  # rho, share of the force that the map does not explain
    period: Array  # control period [s]
    # by how much the force is older than it was taken for when the samples were remembered [s]; it then
    # belongs to X - shift V. None for nothing.
    shift: Array | None


def entry(like: Array) -> ReferenceState:
    """Depth 0, speed 1, no force."""
    zeros = jnp.zeros_like(like)
    return ReferenceState(zeros, zeros + 1, zeros, zeros, zeros, zeros, zeros, zeros)


def no_history(like: Array) -> History:
    """Nothing measured so far."""
    counts = jnp.zeros(like.shape, jnp.int32)
    return History(jnp.zeros((HISTORY, 5, *like.shape), like.dtype), counts, counts)


def remember(history: History, tick: Array, sample: Array) -> Float[Array, "samples 5 *batch"]:
    """The ring with the sample (5, *batch) of this tick in it."""
    return write(history.ring, tick, sample)


def follow(
    old: Reintegration, curve: Curve, measured: Measured, first: Array, present: Int[Array, "*batch"]
) -> Reintegration:
    """One tick of the live motion, to the sample `present` (0 at the first tick in contact, where all starts
    afresh), and of the pass.

    `first` [s] is the time from the entry to sample 0.
    """
    period = measured.period
    starts = (old.reached < 0) | (present == 0)
    old = old._replace(
        behind=_choose(starts, entry(period), old.behind), reached=jnp.where(starts, -1, old.reached)
    )
    curve_behind = _choose(starts, curve, old.curve)
    may_start = measured.history.number <= HISTORY
    coarse = jnp.clip(jnp.floor(COARSE / period + 1e-9), 1, HISTORY).astype(jnp.int32)

    def one(_, carry):
        motion, reached = carry
        ahead = reached < present
        jump = jnp.where((reached >= 0) & (present - reached >= coarse), coarse, 1)
        index = reached + jump
        ticks = jnp.where(reached < 0, first / period, jump.astype(period.dtype))
        moved = _advance(curve_behind, motion, measured, index, ticks)
        chosen = jax.tree.map(lambda a, b: jnp.where(ahead, a, b), moved, motion)
        return ReferenceState(*chosen), jnp.where(ahead, index, reached)

    behind, reached = lax.fori_loop(0, STRIDE, one, (old.behind, old.reached))
    live = _advance(curve, old.live, measured, present, jnp.ones_like(period))
    held = starts & ~may_start
    behind = _choose(held, old.behind, behind)
    reached = jnp.where(held, old.reached, reached)
    done = reached == present
    return Reintegration(_choose(done, behind, live), behind, jnp.where(done, -1, reached), curve_behind)


def _advance(
    curve: Curve, motion: ReferenceState, measured: Measured, index: Array, ticks: Array
) -> ReferenceState:
    """One step of so many `ticks`, to the sample `index`."""
    (impulse, read, *hardware), known = _recall(measured.history, index)
    if measured.shift is not None:
        hardware[0] = hardware[0] - measured.shift * hardware[1]
    known = known & (ticks > 0)
    expected = force_of(curve, *hardware)
    modelled = 0.5 * (motion.expected + expected)
    gap = (impulse - motion.impulse) - (read - motion.read) * modelled
    missing = jnp.where(known, measured.replay * (gap / jnp.where(known, ticks, 1)), 0)
    duration = ticks * measured.period
    half = 0.5 * duration
    push = jnp.where(motion.free > 0, 0, 1)

    def damping(depth):
        return curve.damping + curve.depth_damping * jnp.where(depth > 0, depth, 0) / REACH

    drag = damping(motion.depth) * half * push
    middle = (motion.speed - half * push * (motion.force + missing)) / (1 + drag)
    depth = motion.depth + duration * middle
    deeper = (depth > motion.deepest) & (push > 0)
    deepest = jnp.where(deeper, depth, motion.deepest)
    force = jnp.where(depth > 0, elastic(curve.slopes, depth) - curve.unloading * (deepest - depth), 0)
    dragging = damping(depth)
    speed = middle - push * half * (force + missing + dragging * middle)
    free = (depth <= 0) | ((speed < 0) & (force + missing + dragging * speed <= 0))
    free = (motion.free > 0) | free
    return ReferenceState(
        depth,
        speed,
        deepest,
        force,
        impulse=jnp.where(known, impulse, motion.impulse),
        read=jnp.where(known, read, motion.read),
        expected=jnp.where(known, expected, motion.expected),
        free=free.astype(depth.dtype),
    )


def _recall(history, index):
    """A measured sample, and whether it has come."""
    slot = (history.origin + index) & (HISTORY - 1)
    taken = jnp.take_along_axis(history.ring, slot[None, None], axis=0, mode="promise_in_bounds")[0]
    return taken, (index >= 0) & (index < history.number)


def _choose(condition, when_true, when_false):
    """Lane by lane; leaves may have a leading axis."""

    def choose(a, b):
        return jnp.where(condition if a.ndim == condition.ndim else condition[None], a, b)

    return jax.tree.map(choose, when_true, when_false)
