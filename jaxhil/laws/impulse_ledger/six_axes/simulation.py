"""Linear algebra and delay line of the impulse ledger in six axes in JAX.

Vectors have the shape (6, *batch), matrices (6, 6, *batch).
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


def product(matrix: Array, vector: Array) -> Float[Array, "6 *batch"]:
    """Return the product matrix @ vector on all lanes."""
    return jnp.sum(matrix * vector[None], axis=1)


def dot(a: Array, b: Array) -> Float[Array, "*batch"]:
    """Return the scalar product of two vectors on all lanes."""
    return jnp.sum(a * b, axis=0)


def cross(left: Array, right: Array) -> Float[Array, "3 *batch"]:
    """Return the vector product of two vectors of length 3 on all lanes."""
    (a, b, c), (x, y, z) = left, right
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x])


def wrench_at_chaser(wrench: Array, pose: Array) -> Float[Array, "6 *batch"]:
    """Move a wrench's reference point from the target's origin to the chaser's origin (at `pose`)."""
    return jnp.concatenate([wrench[:3], wrench[3:] - cross(pose[:3], wrench[:3])])


def wrench_at_target(wrench: Array, pose: Array) -> Float[Array, "6 *batch"]:
    """Move a wrench's reference point from the chaser's origin (at `pose`) to the target's origin."""
    return jnp.concatenate([wrench[:3], wrench[3:] + cross(pose[:3], wrench[:3])])


def look_back(
    ring: Float[Array, "samples rows *batch"],
    rows: slice,
    tick: Int[Array, ""],
    ticks: Float[Array, "*batch"],
) -> Float[Array, "some_rows *batch"]:
    """Return rows of the ring `ticks` before `tick`, interpolated linearly; `ticks` <= `samples` - 2."""
    whole = lax.stop_gradient(jnp.floor(ticks))
    newer, older = (_read(ring, rows, tick - whole.astype(jnp.int32) - more) for more in (0, 1))
    return newer + (ticks - whole)[None] * (older - newer)


def running_mean(mean: Array, value: Array, count: Array, used: Bool[Array, "*batch"]) -> Array:
    """Update a mean (rows, *batch) with one `value` on the lanes `used`; `count` includes this value."""
    share = jnp.where(used, 1 / jnp.maximum(count, 1), 0)
    return mean + share[None] * (value - mean)


def _read(ring: Array, rows: slice, index: Int[Array, "*batch"]) -> Float[Array, "some_rows *batch"]:
    """Return rows of the ring at an index, modulo the ring's length."""
    samples, number, *batch = ring.shape
    numbers = jnp.arange(rows.start, rows.stop, dtype=jnp.int32).reshape(-1, *[1] * len(batch))
    positions = (index & (samples - 1))[None] * number + numbers
    # A slice of the rows would be a copy of the whole ring on every tick.
    flat = ring.reshape(samples * number, *batch)
    return jnp.take_along_axis(flat, positions, axis=0, mode="promise_in_bounds")
