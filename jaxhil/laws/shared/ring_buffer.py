"""Ring buffer of past samples, updated in place; each lane may read a sample of a different age.

The first axis of the array contains the samples; its length is a power of two. All lanes have the same
`tick`. XLA updates the array in place only if the write depends on all reads. Otherwise, XLA copies the
array. `depend_on` creates this dependence.
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
    """Return the sample that was written `ticks` ticks before `tick`.

    Where `is_available` is false, return `otherwise`. `ticks` must be less than the length of the ring. If
    `ticks` is equal on all lanes, the function reads one row of the ring, which is much faster than a gather.
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
    """Return the ring with `value` stored as the sample of `tick`."""
    return lax.dynamic_update_index_in_dim(ring, value, tick & (ring.shape[0] - 1), 0)


def write_samples(rings: Any, tick: Int[Array, ""], values: Any) -> Any:
    """Return the pytree `rings` with each leaf of `values` stored in the corresponding ring.

    Each write depends on the previous write, because XLA would merge independent writes into one loop over
    all samples.
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
    """Return `value` in a form that makes the compiler compute `reads` before its use.

    Where one of `reads` is NaN, the result is NaN.
    """
    for read in reads:
        value = jnp.where(read == read, value, read)
    return value
