"""The force and position sensors: what a reading makes of the physical signal.

Delays are the simulator's business (`jaxhil.simulation.motion_simulator`); here are the force sensor's
first-order lag, in continuous time, and what happens to a sample: bias and noise, quantum, dead zone, range.

Noise is a function of a lane's key, the number of the contact and the tick within its run alone: whatever the
gains, and however long the contacts before have taken, a contact meets the same noise (common random
numbers, without which no two gains could be compared).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.simulation.scenario import Scenario

ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))  # of threefry's rounds, bits
PARITY = 0x1BD11BDA  # of its key schedule


class Noise(NamedTuple):
    """What noise adds to readings, (ticks, *batch) or at one tick."""

    force: Array | None  # [N]; None for a sensor without noise
    position: Array | None  # [m]; None for a sensor without noise


def draw_noise(
    has_force: bool,
    has_position: bool,
    scenario: Scenario,
    contact: Int[Array, "*batch"],
    age: Int[Array, "ticks *batch"],
) -> Noise:
    """Noise of both sensors at the ticks that are `age` into the run of contact number `contact`."""

    def white(sensor, deviation):
        return deviation[None] * white_noise(scenario.key, contact, 2 * age + sensor, deviation.dtype)

    return Noise(
        white(0, scenario.force_sensor.noise_std) if has_force else None,
        white(1, scenario.position_sensor.noise_std) if has_position else None,
    )


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
    force: Float[Array, "*batch"], quantum: Array, dead_zone: Array, range_: Array
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
    key: UInt32[Array, "2 *batch"],
    contact: Int[Array, "*batch"],
    count: Int[Array, "ticks *batch"],
    dtype: Any,
) -> Float[Array, "ticks *batch"]:
    """Independent samples of the standard normal distribution, for every (key, contact, count)."""
    bits, _ = threefry(key[0][None], key[1][None], contact[None].astype("uint32"), count.astype("uint32"))
    # Odd multiples of a power of two between -1 and 1, neither of which would do.
    digits = min(32, jnp.finfo(dtype).nmant)
    share = (2 * (bits >> (32 - digits)).astype(dtype) + 1) * 2**-digits - 1
    return 2**0.5 * lax.erf_inv(share)


def threefry(key_0: Array, key_1: Array, count_0: Array, count_1: Array) -> tuple[Array, Array]:
    """64 random bits, as two words, for every key of two words and counter of two words [uint32].

    Threefry-2x32 with 20 rounds: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3"
    (2011). That of `jax.random` is a loop of its own on a CPU, inside of the loop over ticks.
    """
    keys = key_0, key_1, key_0 ^ key_1 ^ PARITY
    left, right = count_0 + keys[0], count_1 + keys[1]
    for turn in range(5):
        for rotation in ROTATIONS[turn % 2]:
            left = left + right
            right = left ^ ((right << rotation) | (right >> (32 - rotation)))
        left = left + keys[(turn + 1) % 3]
        right = right + keys[(turn + 2) % 3] + (turn + 1)
    return left, right


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
