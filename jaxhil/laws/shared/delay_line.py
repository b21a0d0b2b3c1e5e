"""Delay line of the measured position, linear between samples, with uniform motion before the run."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.laws.shared.ring_buffer import look_back, write_sample
from jaxhil.laws.simulation_base import Signals


class DelayInPeriods(NamedTuple):
    """Delay in control periods."""

    lookback: Int[Array, "*batch"]  # whole periods
    fraction: Float[Array, "*batch"]  # rest of a period [1]
    period: Float[Array, "*batch"]  # control period [s]


class DelayLine(NamedTuple):
    """Delay line of the measured position."""

    first_position: Float[Array, "*batch"]  # first reading of the run [m]
    first_velocity: Float[Array, "*batch"]  # velocity on the first tick [m/s]
    ring: Float[Array, "samples *batch"]  # readings [m]


def split_delay(delay: Array, period: Array) -> DelayInPeriods:
    """Convert a delay [s] >= 0 to periods, with a tolerance of 1e-9 below a whole number."""
    periods = delay / period
    whole = jax.lax.stop_gradient(jnp.floor(periods + 1e-9))
    return DelayInPeriods(whole.astype(jnp.int32), periods - whole, period)


def empty_delay_line(ring: int, zeros: Float[Array, "*batch"]) -> DelayLine:
    """Return a line of `ring` samples, a power of two; no sample is read before it is written."""
    return DelayLine(zeros, zeros, jnp.zeros((ring, *zeros.shape), zeros.dtype))


def read_delayed(
    delay: DelayInPeriods, line: DelayLine, signals: Signals, tick: Array
) -> tuple[Array, DelayLine]:
    """Return the measured position [m] one delay ago, and the line with this tick's reading."""
    measured, age = signals.position_measured, signals.age
    begins = age == 0
    first_position = jnp.where(begins, measured, line.first_position)
    first_velocity = jnp.where(begins, signals.velocity_desired, line.first_velocity)
    ring = write_sample(line.ring, tick, measured)
    newer, older = look_back(ring, tick, delay.lookback), look_back(ring, tick, delay.lookback + 1)
    recalled = newer - delay.fraction * (newer - older)
    ticks = (age - delay.lookback).astype(measured.dtype) - delay.fraction
    uniform = first_position + ticks * (delay.period * first_velocity)
    position = jnp.where(age <= delay.lookback, uniform, recalled)
    return position, DelayLine(first_position, first_velocity, ring)
