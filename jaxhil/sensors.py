"""The force and position sensors: what a reading makes of the physical signal.

Delays are the simulator's business (`jaxhil.simulator`); here are the force sensor's first-order lag, in
continuous time between samples, and what happens to a sample: bias and noise, quantum, dead zone, range.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32


def lag(
    reading: Float[Array, "*batch"],
    before: tuple[Array, Array, Array],
    now: tuple[Array, Array, Array],
    control_period: Array,
    time_constant: Array,
) -> Float[Array, "*batch"]:
    """First-order lag T_s y' = F - y over one period, exact for a force that is straight while in touch.

    `before` and `now` are (distance, force, edge) at the period's two ends: distance [m] is positive in
    contact and negative outside, edge [N] is the limit of the force at the surface. Where contact begins or
    ends within the period, the force is zero outside and straight between edge and sample inside.
    """
    distance_0, force_0, edge_0 = before
    distance_1, force_1, edge_1 = now
    begins = (distance_0 <= 0) & (distance_1 > 0)
    ends = (distance_0 > 0) & (distance_1 <= 0)
    span = jnp.where(begins | ends, distance_1 - distance_0, 1)
    inside = jnp.where(begins, distance_1 / span, jnp.where(ends, -distance_0 / span, 1))
    ratio = control_period / jnp.maximum(time_constant, jnp.finfo(reading.dtype).tiny ** 0.5)
    first = jnp.where(begins, 1 - inside, jnp.where(ends, inside, 0))
    reading = _straight(reading, jnp.where(ends, force_0, 0), jnp.where(ends, edge_0, 0), first * ratio)
    second_from = jnp.where(begins, edge_1, jnp.where(ends, 0, force_0))
    second_to = jnp.where(ends, 0, force_1)
    return _straight(reading, second_from, second_to, (1 - first) * ratio)


def sample_force(
    force: Float[Array, "*batch"],
    quantum: Array,
    dead_zone: Array,
    range_: Array,
) -> Float[Array, "*batch"]:
    """A sample [N] of a noisy force: quantum, dead zone and range, in that order."""
    force = quantise(force, quantum)
    beyond = jnp.abs(force) - dead_zone
    force = jnp.where(dead_zone > 0, jnp.sign(force) * jnp.where(beyond > 0, beyond, 0), force)
    return jnp.where(force > range_, range_, jnp.where(force < -range_, -range_, force))


def quantise(value: Array, quantum: Array) -> Array:
    """quantum * round(value / quantum); the value itself where the quantum is 0."""
    safe = jnp.where(quantum > 0, quantum, 1)
    return jnp.where(quantum > 0, safe * jnp.round(value / safe), value)


def white_noise(
    keys: UInt32[Array, "2 *batch"], tick: Array, deviation: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Gaussian samples of the given standard deviation; a function of (key of the lane, tick) alone."""

    def draw(key):
        typed = jax.random.wrap_key_data(key, impl="threefry2x32")
        return jax.random.normal(jax.random.fold_in(typed, tick), dtype=deviation.dtype)

    return deviation * jax.vmap(draw)(keys.reshape(2, -1).T).reshape(deviation.shape)


def _straight(reading, start, end, duration):
    """y after `duration` time constants of an input that goes straight from start to end."""
    safe = jnp.where(duration > 1e-6, duration, 1)
    decay = jnp.exp(-duration)
    mean = jnp.where(duration > 1e-6, -jnp.expm1(-safe) / safe, 1 - duration / 2)
    return reading * decay + end - start * decay - (end - start) * mean
