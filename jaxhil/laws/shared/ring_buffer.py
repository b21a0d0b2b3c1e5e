"""Ring buffer of past samples, written in place; each lane may read a different number of ticks back.

The first axis is that of the samples, and its length is a power of two. `tick` is common to all lanes. The
compiler updates a ring in place only if it can see that the read comes first; otherwise it copies the ring.
`depend_on` therefore makes the written sample depend on what was read.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


def look_back(
    ring: Float[Array, "samples *batch"],
    tick: Int[Array, ""],
    ticks: Int[Array, "*batch"],
    is_available: Bool[Array, "*batch"] | bool = True,
    otherwise: Any = 0,
) -> Float[Array, "*batch"]:
    """Return the sample written `ticks` before `tick`, or `otherwise` where `is_available` is false.

    `ticks` is less than `samples`. If all lanes look back equally far, the result is one row of the ring,
    which is much faster than a gather.
    """
    first, mask = ticks.reshape(-1)[0], ring.shape[0] - 1

    def row(ring):
        return lax.dynamic_index_in_dim(ring, (tick - first) & mask, 0, keepdims=False)

    def lane_by_lane(ring):
        index = (tick - ticks) & mask
        return jnp.take_along_axis(ring, index[None], axis=0, mode="promise_in_bounds")[0]

    def chosen(read):
        if is_available is True:
            return read
        return lambda ring: jnp.where(is_available, read(ring), otherwise)

    return lax.cond(jnp.all(ticks == first), chosen(row), chosen(lane_by_lane), ring)


def write_sample(
    ring: Float[Array, "samples *batch"], tick: Int[Array, ""], value: Float[Array, "*batch"]
) -> Float[Array, "samples *batch"]:
    """Store `value` as the sample of `tick`."""
    return lax.dynamic_update_index_in_dim(ring, value, tick & (ring.shape[0] - 1), 0)


def write_samples(rings: Any, tick: Int[Array, ""], values: Any) -> Any:
    """Store each leaf of `values` in the same leaf of `rings`, one after the other.

    The compiler would merge independent writes into one loop over the whole rings.
    """
    leaves, structure = jax.tree.flatten(rings)
    written = []
    for ring, value in zip(leaves, jax.tree.leaves(values), strict=True):
        if written:
            oldest = (tick + 1) & (ring.shape[0] - 1)
            value = depend_on(value, lax.dynamic_index_in_dim(written[-1], oldest, 0, keepdims=False))
        written.append(write_sample(ring, tick, value))
    return jax.tree.unflatten(structure, written)


def depend_on(value: Float[Array, "*batch"], *reads: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return `value`, but dependent on `reads`: NaN where one of them is NaN."""
    for read in reads:
        value = jnp.where(read == read, value, read)
    return value
