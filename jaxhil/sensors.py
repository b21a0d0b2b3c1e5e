"""The force and position sensors: what a reading makes of the physical signal.

Delays are the simulator's business (`jaxhil.simulator`); here are the force sensor's first-order lag, in
continuous time, and what happens to a sample: bias and noise, quantum, dead zone, range.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32


def lag(
    reading: Float[Array, "*batch"],
    idle: Array,
    touching: Array,
    free: Array,
    forces: list[Array],
    time_constant: Array,
) -> Float[Array, "*batch"]:
    """First-order lag T_s y' = F - y, exact for a force made of parabolas.

    The force is 0 for `idle` [s], goes through `forces` [N] while `touching` [s], an odd number of values at
    equal distances, along parabolas through three of them each, and is 0 again for `free` [s].
    """
    arc = touching / (len(forces) // 2)
    decay, straight, bow = _parabola(arc / _longer_than_0(time_constant))
    reading = reading * lag_decay(idle, time_constant)
    for start, middle, end in zip(forces[:-2:2], forces[1:-1:2], forces[2::2], strict=True):
        bend = middle - (start + end) / 2
        reading = reading * decay + end - start * decay - (end - start) * straight + bend * bow
    return reading * lag_decay(free, time_constant)


def lag_decay(duration: Array, time_constant: Array) -> Array:
    """What is left of the lag's output after `duration` [s] without force."""
    return jnp.exp(-duration / _longer_than_0(time_constant))


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


def _longer_than_0(time_constant):
    tiny = jnp.finfo(time_constant.dtype).tiny ** 0.5
    return jnp.where(time_constant > tiny, time_constant, tiny)


def _parabola(span):
    """What is left after `span` time constants of y, of an input s/span, and of 4 s/span (1 - s/span)."""
    decay = jnp.exp(-span)
    some = jnp.where(span > 0, span, 1)
    mean = jnp.where(span > 0, -jnp.expm1(-some) / some, 1)
    # The closed form cancels for short spans.
    short = jnp.where(span < 1e-2, span, 0)
    series = 4 * short * (1 / 6 - short * (1 / 12 - short * (1 / 40 - short / 180)))
    return decay, mean, jnp.where(span < 1e-2, series, 4 * (mean - 2 * (mean - decay) / some))
