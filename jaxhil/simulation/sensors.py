"""Force sensor and position sensor: first-order lag, noise, bias, quantisation, dead zone and range.

The first-order lag of the force sensor is computed in continuous time. The other effects apply to samples.
The delays of the sensors are part of `jaxhil.simulation.motion_simulator`.

The noise at a tick depends only on the key of the scenario, the index of the contact, and the number of ticks
since the run began. A contact therefore has the same noise for all gains, and for all durations of earlier
contacts. Results for different gains can be compared because of these common random numbers.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxhil.lanes import as_complex
from jaxhil.simulation.scenario import Scenario

THREEFRY_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))  # bits; rotation constants of Threefry-2x32
BIAS_WALK_STREAM = 0x20000000  # offset of the contact's index, which separates the bias from the noise
THREEFRY_PARITY = 0x1BD11BDA  # parity constant in the key schedule of Threefry-2x32


class SensorNoise(NamedTuple):
    """Noise of both sensors at several ticks, (ticks, *batch), or at one tick, (*batch)."""

    force: Array | None  # noise of the force sensor [N]; None for a sensor without noise
    position: Array | None  # noise of the position sensor [m]; None for a sensor without noise
    # change of the force sensor's bias since the last tick [N]; None for a constant bias
    bias_step: Array | None = None


def draw_noise(
    has_force: bool,
    has_position: bool,
    scenario: Scenario,
    contact: Int[Array, "*batch"],
    age: Int[Array, "ticks *batch"],
) -> SensorNoise:
    """Return the noise of both sensors, and the steps of the random walk of the force sensor's bias.

    Args:
        has_force: Whether the force sensor has noise.
        has_position: Whether the position sensor has noise.
        scenario: Scenarios with the noise keys and the standard deviations.
        contact: Index of the current contact.
        age: Number of ticks since the run began.
    """

    def white(sensor, deviation):
        return deviation[None] * white_noise(scenario.key, contact, 2 * age + sensor, deviation.dtype)

    walk = scenario.force_sensor.bias_walk
    return SensorNoise(
        white(0, scenario.force_sensor.noise_std) if has_force else None,
        white(1, scenario.position_sensor.noise_std) if has_position else None,
        None if walk is None else draw_bias_steps(walk, scenario.control_period, scenario.key, contact, age),
    )


def draw_bias_steps(
    walk: Float[Array, "*batch"],
    period: Float[Array, "*batch"],
    key: UInt32[Array, "2 *batch"],
    contact: Int[Array, "*batch"],
    age: Int[Array, "ticks *batch"],
) -> Float[Array, "ticks *batch"]:
    """Return the change of the force sensor's bias [N] since the last tick; 0 at the first tick of a run.

    Args:
        walk: Random walk of the bias [N/sqrt(s)].
        period: Control period [s].
        key: Noise keys of the scenarios.
        contact: Index of the current contact.
        age: Number of ticks since the run began.
    """
    steps = white_noise(key, contact + BIAS_WALK_STREAM, age, walk.dtype)
    return jnp.where(age > 0, (walk * jnp.sqrt(period))[None] * steps, 0)


def apply_lag(
    reading: Float[Array, "*batch"],
    idle: Array,
    touching: Array,
    free: Array,
    forces: list[Array],
    time_constant: Array,
) -> Float[Array, "*batch"]:
    """Return the output y [N] of a first-order lag T_s y' = F - y at the end of an interval with one contact.

    During contact, the force F is interpolated by parabolas, each through three of the values in `forces`.
    The result is exact for the interpolated force.

    Args:
        reading: Output of the lag at the interval's start [N].
        idle: Time before the contact, with F = 0 [s].
        touching: Duration of the contact [s].
        free: Time after the contact, with F = 0 [s].
        forces: Odd number of forces at evenly spaced times, from the beginning to the end of the contact [N].
        time_constant: Time constant T_s [s].
    """
    arc = touching / (len(forces) // 2)
    decay, straight, bow = _lag_response(arc / _bound_above_zero(time_constant))
    reading = reading * lag_decay(idle, time_constant)
    for start, middle, end in zip(forces[:-2:2], forces[1:-1:2], forces[2::2], strict=True):
        bend = middle - (start + end) / 2
        reading = reading * decay + end - start * decay - (end - start) * straight + bend * bow
    return reading * lag_decay(free, time_constant)


def follow_ramp(mode: Array, before: Array, now: Array, span: Array) -> Array:
    """Return the output y [N] of a filter mode y' = r (F - y) after a linear change of the input F.

    Args:
        mode: Output at the start, complex [N].
        before: Input at the start [N].
        now: Input at the end [N].
        span: Duration times the mode's rate r, complex [1].
    """
    decay, before, now = jnp.exp(-span), as_complex(before), as_complex(now)
    return mode * decay + now - before * decay - (now - before) * (1 - decay) / span


def lag_decay(duration: Array, time_constant: Array) -> Array:
    """Return the factor [1] by which the output of a lag decays in `duration` [s] with the input 0."""
    return jnp.exp(-duration / _bound_above_zero(time_constant))


def sample_force(
    force: Float[Array, "*batch"],
    quantum: Array,
    dead_zone: Array,
    range_: Array,
    step: Array | None = None,
) -> Float[Array, "*batch"]:
    """Apply quantisation, dead zone and range of the force sensor, in this order, to a force [N].

    Args:
        force: Force before these effects [N].
        quantum: Quantisation step [N]; 0 without quantisation.
        dead_zone: Half-width of the dead zone [N].
        range_: Largest |reading| [N].
        step: Change of the force since the last tick [N], for a cut dead zone (`cut_dead_zone`). None for a
            continuous dead zone, which is also subtracted from larger forces.
    """
    force = quantise(force, quantum)
    if step is None:
        beyond = jnp.abs(force) - dead_zone
        force = jnp.where(dead_zone > 0, jnp.sign(force) * jnp.where(beyond > 0, beyond, 0), force)
    else:
        force = cut_dead_zone(force, dead_zone, step)
    return jnp.where(force > range_, range_, jnp.where(force < -range_, -range_, force))


@jax.custom_jvp
def cut_dead_zone(force: Float[Array, "*batch"], dead_zone: Array, step: Array) -> Float[Array, "*batch"]:
    """Replace forces [N] of a magnitude up to `dead_zone` [N] by 0; larger forces remain unchanged.

    The reading jumps at the first tick after the force crosses the edge of the dead zone. The instant within
    a control period at which the contact begins determines this tick. The derivative of this function is
    therefore that of the mean reading for all such instants: for a force with a uniform distribution between
    `force - step` and `force` [N]. With a `step` of 0, the derivative excludes the jumps.
    """
    return jnp.where(jnp.abs(force) > dead_zone, force, 0)


@cut_dead_zone.defjvp
def _differentiate_cut(primals, tangents):
    force, dead_zone, step = primals
    force_slope, dead_zone_slope, _ = tangents
    slope = jnp.where(jnp.abs(force) > dead_zone, force_slope, 0)
    for side in (1, -1):
        edge = side * dead_zone
        crosses = (force > edge) != (force - step > edge)
        # If the force is larger by 1 N, it crosses the edge of the dead zone 1/|step| ticks earlier when it
        # rises, or later when it falls. During this time, the reading is larger by the dead zone.
        gain = jnp.where(crosses, dead_zone / jnp.where(crosses, jnp.abs(step), 1), 0)
        slope = slope + gain * (force_slope - side * dead_zone_slope)
    return cut_dead_zone(*primals), slope


def quantise(value: Array, quantum: Array) -> Array:
    """Round a value to a multiple of the quantum; return the value unchanged if the quantum is 0."""
    safe = jnp.where(quantum > 0, quantum, 1)
    return jnp.where(quantum > 0, safe * jnp.round(value / safe), value)


def white_noise(
    key: UInt32[Array, "2 *batch"],
    contact: Int[Array, "*batch"],
    count: Int[Array, "ticks *batch"],
    dtype: Any,
) -> Float[Array, "ticks *batch"]:
    """Return standard normal samples, independent for different (key, contact, count)."""
    # erf_inv is infinite at -1 and 1.
    return 2**0.5 * lax.erf_inv(_odd_multiples(key, contact, count, dtype) - 1)


def uniform_noise(
    key: UInt32[Array, "2 *batch"],
    contact: Int[Array, "*batch"],
    count: Int[Array, "ticks *batch"],
    dtype: Any,
) -> Float[Array, "ticks *batch"]:
    """Return uniform samples between 0 and 1, independent for different (key, contact, count)."""
    return _odd_multiples(key, contact, count, dtype) / 2


def _odd_multiples(key, contact, count, dtype):
    """Return uniform random numbers strictly between 0 and 2: odd multiples of a power of two."""
    bits, _ = threefry(key[0][None], key[1][None], contact[None].astype("uint32"), count.astype("uint32"))
    digits = min(32, jnp.finfo(dtype).nmant)
    return (2 * (bits >> (32 - digits)).astype(dtype) + 1) * 2**-digits


def threefry(key_0: Array, key_1: Array, count_0: Array, count_1: Array) -> tuple[Array, Array]:
    """Return 64 random bits, as two words, for a key of two words and a counter of two words [uint32].

    The algorithm is Threefry-2x32 with 20 rounds: Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as
    easy as 1, 2, 3" (2011). `jax.random` contains the same algorithm, but on a CPU, XLA compiles that version
    as an additional loop within the loop over ticks.
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
    """Return the time constant [s], raised to a tiny positive number if it is 0."""
    tiny = jnp.finfo(time_constant.dtype).tiny ** 0.5
    return jnp.where(time_constant > tiny, time_constant, tiny)


def _lag_response(span):
    """Return three factors from the outputs of a first-order lag at the time s = `span` [time constants].

    1. output for the initial output 1 and the input 0
    2. 1 minus the output for the initial output 0 and the ramp s/span as input
    3. output for the initial output 0 and the parabola 4 s/span (1 - s/span) as input
    """
    decay = jnp.exp(-span)
    positive = jnp.where(span > 0, span, 1)
    mean = jnp.where(span > 0, -jnp.expm1(-positive) / positive, 1)
    # For short spans, the closed form suffers from cancellation; a power series is used instead.
    short = jnp.where(span < 1e-2, span, 0)
    series = 4 * short * (1 / 6 - short * (1 / 12 - short * (1 / 40 - short / 180)))
    return decay, mean, jnp.where(span < 1e-2, series, 4 * (mean - 2 * (mean - decay) / positive))
