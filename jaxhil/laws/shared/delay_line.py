"""Delay line of the measured position, with linear interpolation, for uniform motion before the run."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.laws.shared.ring_buffer import look_back, write_sample
from jaxhil.laws.simulation_base import Signals


class DelayInPeriods(NamedTuple):
    """Delay as a whole number and a fraction of control periods."""

    lookback: Int[Array, "*batch"]  # whole number of periods
    fraction: Float[Array, "*batch"]  # fraction of a period [1]
    period: Float[Array, "*batch"]  # control period [s]


class DelayLine(NamedTuple):
    """State of the delay line of the measured position."""

    first_position: Float[Array, "*batch"]  # measured position on the run's first tick [m]
    first_velocity: Float[Array, "*batch"]  # velocity of the model on the run's first tick [m/s]
    ring: Float[Array, "samples *batch"]  # ring buffer of measured positions [m]


def split_delay(delay: Array, period: Array) -> DelayInPeriods:
    """Convert a delay [s] >= 0 to control periods; a fraction above 1 - 1e-9 counts as a whole period."""
    periods = delay / period
    whole = jax.lax.stop_gradient(jnp.floor(periods + 1e-9))
    return DelayInPeriods(whole.astype(jnp.int32), periods - whole, period)


def empty_delay_line(ring: int, zeros: Float[Array, "*batch"]) -> DelayLine:
    """Return a delay line with `ring` samples of 0; `ring` is a power of two."""
    return DelayLine(zeros, zeros, jnp.zeros((ring, *zeros.shape), zeros.dtype))


def read_delayed(
    delay: DelayInPeriods, line: DelayLine, signals: Signals, tick: Array
) -> tuple[Array, DelayLine]:
    """Add this tick's measured position to the line; return the delayed position [m] and the line."""
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
