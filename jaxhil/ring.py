"""Delay lines: a ring of past samples, written in place, read back by a different number per lane.

The first axis counts samples and is a power of two long. `tick` is common to all lanes. The compiler updates
a ring in place only if the sample written depends on those read before; else it copies the ring every tick.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def look_back(
    ring: Float[Array, "samples *batch"], tick: Int[Array, ""], ticks: Int[Array, "reads *batch"]
) -> Float[Array, "reads *batch"]:
    """The samples written `ticks` before `tick`; only the last `samples` ones are there."""
    index = (tick - ticks) & (ring.shape[0] - 1)
    return jnp.take_along_axis(ring, index, axis=0, mode="promise_in_bounds")


def write(
    ring: Float[Array, "samples *batch"], tick: Int[Array, ""], value: Float[Array, "*batch"]
) -> Float[Array, "samples *batch"]:
    """Store `value` as the sample of `tick`."""
    return lax.dynamic_update_index_in_dim(ring, value, tick & (ring.shape[0] - 1), 0)


def tie(value: Float[Array, "*batch"], read: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """`value`, made to depend on `read` (it is NaN where that is)."""
    return jnp.where(read == read, value, read)
