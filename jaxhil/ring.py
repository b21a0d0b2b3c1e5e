"""Delay lines: a ring of past samples, written in place, read back by a different number per lane.

The first axis counts samples and is a power of two long. `tick` is common to all lanes. The compiler updates
a ring in place only if it sees that the reading comes first: several rows are read in one operation that it
does not merge with others, and the sample written is tied to what was read. Else it copies the ring.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def look_back(
    ring: Float[Array, "samples *batch"],
    tick: Int[Array, ""],
    ticks: Int[Array, "*batch"],
    window: int = 0,
) -> Float[Array, "*batch"]:
    """The sample written `ticks` before `tick`; only the last `samples` ones are there.

    Where the lanes are known to differ by less than `window` ticks, that many rows are read and chosen from:
    many times faster than the gathering element by element that is done for a window of 0.
    """
    if window == 0:
        index = (tick - ticks) & (ring.shape[0] - 1)
        return jnp.take_along_axis(ring, index[None], axis=0, mode="promise_in_bounds")[0]
    least = jnp.min(ticks)
    rows = look_back_rows(ring, tick, least + jnp.arange(window, dtype=ticks.dtype))
    sample = rows[0]
    for more in range(1, window):
        sample = jnp.where(ticks == least + more, rows[more], sample)
    return sample


def look_back_rows(
    ring: Float[Array, "samples *batch"], tick: Int[Array, ""], ticks: Int[Array, "reads"]
) -> Float[Array, "reads *batch"]:
    """The samples written `ticks` before `tick`, the same ones for all lanes; two at least."""
    index = (tick - ticks) & (ring.shape[0] - 1)
    return ring.at[index].get(mode="promise_in_bounds", unique_indices=True)


def write(
    ring: Float[Array, "samples *batch"], tick: Int[Array, ""], value: Float[Array, "*batch"]
) -> Float[Array, "samples *batch"]:
    """Store `value` as the sample of `tick`."""
    return lax.dynamic_update_index_in_dim(ring, value, tick & (ring.shape[0] - 1), 0)


def tie(value: Float[Array, "*batch"], *reads: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """`value`, made to depend on `reads` (it is NaN where one of them is)."""
    for read in reads:
        value = jnp.where(read == read, value, read)
    return value
