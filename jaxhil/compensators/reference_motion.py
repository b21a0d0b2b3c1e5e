"""The motion that a contact should have had, integrated over again from its entry while the map improves.

Scaled as in `force_depth_map`: the reference enters at depth 0 with speed 1 and obeys

    x' = v,    v' = -f_i,    f_i = F(x, v) + rho [y_i - F(X_i, V_i)]

with the bracket only as far as the hardware has been measured, until it separates: x <= 0, or v < 0 and
f <= 0. It is stepped on the ticks, counted from its entry, by the velocity Verlet scheme with the damping
implicit in the first half of a step and explicit in the second (order 2). Measured samples are moved to that
grid by straight lines, such that the hardware's own entry falls on the reference's.

A pass from the entry takes up to `STRIDE` samples per tick under the map that it started with. When it has
caught up with the present it becomes the live reference, which goes on sample by sample under the newest map,
and the next pass starts: a bounded effort per tick, and a reference that is at most 1/(STRIDE - 1) of the
contact's duration behind what has been identified.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxhil.compensators.force_depth_map import elastic
from jaxhil.ring import write

STRIDE = 16  # samples per tick of the pass from the entry
HISTORY = 1024  # ticks of measured samples kept; a longer contact is not integrated over again


class Motion(NamedTuple):
    """Depth [s], speed [1], force [1/s] and whether (1) it has separated, as one array (4, *batch)."""

    depth: Float[Array, "*batch"]
    speed: Float[Array, "*batch"]
    force: Float[Array, "*batch"]
    free: Float[Array, "*batch"]


class History(NamedTuple):
    """Ring of measured samples y, X, V on the reference's grid, (HISTORY, 3, *batch), by the tick at which each
    came; the tick at which sample 0 came, and how many have come."""

    ring: Float[Array, "samples 3 *batch"]
    origin: Int[Array, "*batch"]
    number: Int[Array, "*batch"]


class Reference(NamedTuple):
    """The live motion; the pass under way, the sample that it has reached (-1: the entry) and its map."""

    live: Motion
    behind: Motion
    reached: Int[Array, "*batch"]
    theta: Float[Array, "parameters *batch"]


def entry(like: Array) -> Motion:
    """Depth 0, speed 1, no force."""
    zeros = jnp.zeros_like(like)
    return Motion(zeros, zeros + 1, zeros, zeros)


def no_history(like: Array) -> History:
    """Nothing measured yet."""
    counts = jnp.zeros(like.shape, jnp.int32)
    return History(jnp.zeros((HISTORY, 3, *like.shape), like.dtype), counts, counts)


def remember(history: History, tick: Array, sample: Array) -> Float[Array, "samples 3 *batch"]:
    """The ring with the sample (3, *batch) of this tick in it."""
    return write(history.ring, tick, sample)


def follow(
    old: Reference,
    theta: Array,
    history: History,
    replay: Array,
    first: Array,
    period: Array,
    present: Int[Array, "*batch"],
) -> Reference:
    """One tick of the live motion, to the sample `present` (0 at the first tick in contact), and of the pass.

    theta ends with the damping that counts; `first` [s] is the time from the entry to sample 0.
    """
    starts = old.reached < 0
    theta_behind = jnp.where(starts, theta, old.theta)
    may_start = history.number <= HISTORY

    def force_of(theta, index, depth):
        """Elastic force of the motion plus what was measured in excess of the map, [1/s]."""
        slot = (history.origin + index) & (HISTORY - 1)
        taken = jnp.take_along_axis(history.ring, slot[None, None], axis=0, mode="promise_in_bounds")[0]
        measured, hardware_depth, hardware_speed = taken
        both = elastic(theta[:-1, None], jnp.stack([depth, hardware_depth]))
        expected = both[1] + jnp.where(hardware_depth > 0, theta[-1] * hardware_speed, 0)
        known = (index >= 0) & (index < history.number)
        return both[0] + jnp.where(known, replay * (measured - expected), 0)

    def advance(theta, motion, index, duration):
        half = 0.5 * duration
        push = jnp.where(motion.free > 0, 0, 1)
        drag = theta[-1] * half * push
        middle = (motion.speed - half * push * motion.force) / (1 + drag)
        depth = motion.depth + duration * middle
        force = force_of(theta, index, depth)
        speed = middle - push * half * force - drag * middle
        free = (motion.free > 0) | (depth <= 0) | ((speed < 0) & (force + theta[-1] * speed <= 0))
        return Motion(depth, speed, force, free.astype(depth.dtype))

    def one(_, carry):
        motion, reached = carry
        ahead = reached < present
        index = reached + 1
        moved = advance(theta_behind, motion, index, jnp.where(reached < 0, first, period))
        chosen = jax.tree.map(lambda a, b: jnp.where(ahead, a, b), moved, motion)
        return Motion(*chosen), jnp.where(ahead, index, reached)

    behind, reached = lax.fori_loop(0, STRIDE, one, (old.behind, old.reached))
    live = advance(theta, old.live, present, period)
    held = starts & ~may_start
    behind = _choose(held, old.behind, behind)
    reached = jnp.where(held, old.reached, reached)
    done = reached == present
    return Reference(
        _choose(done, behind, live),
        _choose(done, entry(period), behind),
        jnp.where(done, -1, reached),
        theta_behind,
    )


def _choose(condition, when_true, when_false):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), when_true, when_false)
