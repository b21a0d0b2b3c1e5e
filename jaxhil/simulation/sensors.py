"""Force and position sensors: readings of the physical signals.

Delays are in `jaxhil.simulation.motion_simulator`. Here are the force sensor's first-order lag, in continuous
time, and the effects on a sample: bias and noise, quantum, dead zone, range.

Noise depends only on a lane's key, the number of the contact, and the tick within its run. Thus a contact has
the same noise for all gains and whatever the durations of previous contacts (common random numbers), so that
gains can be compared.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.simulation.scenario import Scenario

THREEFRY_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))  # bits, of Threefry's rounds
THREEFRY_PARITY = 0x1BD11BDA  # constant of Threefry's key schedule


class SensorNoise(NamedTuple):
    """Noise of readings, (ticks, *batch) or at one tick."""

    force: Array | None  # [N]; None for a sensor without noise
    position: Array | None  # [m]; None for a sensor without noise


def draw_noise(
    has_force: bool,
    has_position: bool,
    scenario: Scenario,
    contact: Int[Array, "*batch"],
    age: Int[Array, "ticks *batch"],
) -> SensorNoise:
    """Return the noise of both sensors at the ticks `age` of the run of contact number `contact`."""

    def white(sensor, deviation):
        return deviation[None] * white_noise(scenario.key, contact, 2 * age + sensor, deviation.dtype)

    return SensorNoise(
        white(0, scenario.force_sensor.noise_std) if has_force else None,
        white(1, scenario.position_sensor.noise_std) if has_position else None,
    )


def apply_lag(
    reading: Float[Array, "*batch"],
    idle: Array,
    touching: Array,
    free: Array,
    forces: list[Array],
    time_constant: Array,
) -> Float[Array, "*batch"]:
    """Return the output of a first-order lag T_s y' = F - y, exact for a force composed of parabolas.

    The force is 0 for `idle` [s]. While `touching` [s], it passes through an odd number of equidistant values
    `forces` [N], along parabolas through three of them each. It is 0 again for `free` [s].
    """
    arc = touching / (len(forces) // 2)
    decay, straight, bow = _lag_response(arc / _bound_above_zero(time_constant))
    reading = reading * lag_decay(idle, time_constant)
    for start, middle, end in zip(forces[:-2:2], forces[1:-1:2], forces[2::2], strict=True):
        bend = middle - (start + end) / 2
        reading = reading * decay + end - start * decay - (end - start) * straight + bend * bow
    return reading * lag_decay(free, time_constant)


def lag_decay(duration: Array, time_constant: Array) -> Array:
    """Return the remaining fraction of the lag's output after `duration` [s] without force."""
    return jnp.exp(-duration / _bound_above_zero(time_constant))


def sample_force(
    force: Float[Array, "*batch"], quantum: Array, dead_zone: Array, range_: Array
) -> Float[Array, "*batch"]:
    """Return a sample [N] of a noisy force, with quantum, dead zone and range, in that order."""
    force = quantise(force, quantum)
    beyond = jnp.abs(force) - dead_zone
    force = jnp.where(dead_zone > 0, jnp.sign(force) * jnp.where(beyond > 0, beyond, 0), force)
    return jnp.where(force > range_, range_, jnp.where(force < -range_, -range_, force))


def quantise(value: Array, quantum: Array) -> Array:
    """Return quantum * round(value / quantum), or the value itself if the quantum is 0."""
    safe = jnp.where(quantum > 0, quantum, 1)
    return jnp.where(quantum > 0, safe * jnp.round(value / safe), value)


def white_noise(
    key: UInt32[Array, "2 *batch"],
    contact: Int[Array, "*batch"],
    count: Int[Array, "ticks *batch"],
    dtype: Any,
) -> Float[Array, "ticks *batch"]:
    """Return independent samples of the standard normal distribution for all (key, contact, count)."""
    bits, _ = threefry(key[0][None], key[1][None], contact[None].astype("uint32"), count.astype("uint32"))
    # Odd multiples of a power of two lie strictly between -1 and 1, where erf_inv is infinite.
    digits = min(32, jnp.finfo(dtype).nmant)
    share = (2 * (bits >> (32 - digits)).astype(dtype) + 1) * 2**-digits - 1
    return 2**0.5 * lax.erf_inv(share)


def threefry(key_0: Array, key_1: Array, count_0: Array, count_1: Array) -> tuple[Array, Array]:
    """Return 64 random bits, as two words, for each key of two words and counter of two words [uint32].

    This is Threefry-2x32 with 20 rounds: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1,
    2, 3" (2011). On a CPU, the version of `jax.random` would be a separate loop inside the loop over ticks.
    """
    keys = key_0, key_1, key_0 ^ key_1 ^ THREEFRY_PARITY
    left, right = count_0 + keys[0], count_1 + keys[1]
    for turn in range(5):
        for rotation in THREEFRY_ROTATIONS[turn % 2]:
            left = left + right
            right = left ^ ((right << rotation) | (right >> (32 - rotation)))
        left = left + keys[(turn + 1) % 3]
        right = right + keys[(turn + 2) % 3] + (turn + 1)
    return left, right


def _bound_above_zero(time_constant):
    """Return the time constant [s], at least a tiny positive number."""
    tiny = jnp.finfo(time_constant.dtype).tiny ** 0.5
    return jnp.where(time_constant > tiny, time_constant, tiny)


def _lag_response(span):
    """Return the lag's response factors after `span` time constants.

    They are for the initial output, for an input s/span, and for an input 4 s/span (1 - s/span).
    """
    decay = jnp.exp(-span)
    positive = jnp.where(span > 0, span, 1)
    mean = jnp.where(span > 0, -jnp.expm1(-positive) / positive, 1)
    # The closed form suffers from cancellation for short spans.
    short = jnp.where(span < 1e-2, span, 0)
    series = 4 * short * (1 / 6 - short * (1 / 12 - short * (1 / 40 - short / 180)))
    return decay, mean, jnp.where(span < 1e-2, series, 4 * (mean - 2 * (mean - decay) / positive))
