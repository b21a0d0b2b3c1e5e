"""What was measured in a run, by tick.

Of the newest 255 ticks every sample is kept, of the 4 times as many before every 4th, then every 16th, 64th
and 256th: the last of each block of so many ticks of the run. Rings are written in place at a slot that all
lanes share; as their runs begin at different ticks, what is written is the newest such sample of each lane.
"""

from functools import reduce
from operator import add
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

SLOTS = 256
LEVELS = 5


class Samples(NamedTuple):
    """What was measured at ticks."""

    impulse: Array  # integral of the force that the sensor showed [N ticks]
    shown: Array  # over how many ticks that is
    position: Array  # of the hardware, as old as the force [m]
    velocity: Array  # likewise [m/s]


class History(NamedTuple):
    """The samples of a run."""

    ring: Float[Array, "slots 4 *batch"]  # of each level one after the other; the four as in `Samples`
    newest: Float[Array, "levels 4 *batch"]  # sample of each level
    readings: Float[Array, "slots 2 *batch"]  # force [N], and whether (1) the sensor showed it
    reading: Float[Array, "2 *batch"]  # the newest
    run: Int[Array, "*batch"]  # tick at which the run began
    age: Int[Array, "*batch"]  # ticks since then


def no_history(like: Float[Array, "*batch"]) -> History:
    """Nothing measured so far."""
    counts = jnp.zeros(like.shape, jnp.int32)

    def zeros(*shape):
        return jnp.zeros((*shape, *like.shape), like.dtype)

    return History(zeros(LEVELS * SLOTS, 4), zeros(LEVELS, 4), zeros(SLOTS, 2), zeros(2), counts, counts)


def take(
    old: History,
    tick: Int[Array, ""],
    age: Int[Array, "*batch"],
    force: Array,
    shows: Array,
    position: Array,
    velocity: Array,
) -> History:
    """One more tick, `age` ticks after its run began: force [N], whether the sensor `shows` it, position [m]
    and velocity [m/s] of the hardware."""
    begins = age == 0
    both = jnp.where(shows & ~begins, old.reading[1], 0)
    before = jnp.where(begins[None], 0, old.newest[0, :2])
    mean = 0.5 * (old.reading[0] + force)
    sample = jnp.stack([before[0] + jnp.where(both > 0, mean, 0), before[1] + both, position, velocity])
    newest = [sample]
    ring = lax.dynamic_update_index_in_dim(old.ring, sample, tick & (SLOTS - 1), 0)
    for level in range(1, LEVELS):
        stride = 4**level
        last = jnp.where(((age + 1) & (stride - 1)) == 0, sample, old.newest[level])
        slot = level * SLOTS + ((tick >> (2 * level)) & (SLOTS - 1))
        ring = lax.dynamic_update_index_in_dim(ring, last, slot, 0)
        newest.append(last)
    reading = jnp.stack([force, shows.astype(force.dtype)])
    readings = lax.dynamic_update_index_in_dim(old.readings, reading, tick & (SLOTS - 1), 0)
    return History(ring, jnp.stack(newest), readings, reading, tick - age, age)


def level_of(history: History, index: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """Of the samples as old as that of the tick `index` of the run, every 4^level-th is kept."""
    age = history.age - index
    return reduce(add, ((age >= (SLOTS - 1) * 4**level).astype(jnp.int32) for level in range(LEVELS - 1)))


def recall(history: History, index: Int[Array, "*batch"]) -> Samples:
    """The sample of a tick of the run that is kept."""
    level = level_of(history, index)
    slot = level * SLOTS + (((history.run + index) >> (2 * level)) & (SLOTS - 1))
    return Samples(*jnp.take_along_axis(history.ring, slot[None, None], axis=0, mode="promise_in_bounds")[0])


def reading_at(history: History, index: Int[Array, "*batch"]) -> tuple[Array, Bool[Array, "*batch"]]:
    """The force [N] at one of the newest 256 ticks of the run, and whether the sensor showed it."""
    slot = (history.run + index) & (SLOTS - 1)
    force, shown = jnp.take_along_axis(history.readings, slot[None, None], axis=0, mode="promise_in_bounds")[
        0
    ]
    return force, shown > 0


def positions_before(
    history: History, tick: Int[Array, ""], ages: Int[Array, "ages *#batch"]
) -> Float[Array, "ages *batch"]:
    """The positions [m] so many ticks ago, less than 256."""
    return jnp.take_along_axis(
        history.ring[:SLOTS, 2], (tick - ages) & (SLOTS - 1), axis=0, mode="promise_in_bounds"
    )
