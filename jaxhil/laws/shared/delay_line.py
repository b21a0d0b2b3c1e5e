"""A measured position some time ago, straight between samples, in uniform motion before the run began."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.laws.shared.ring_buffer import look_back, write
from jaxhil.laws.simulation_base import Signals


class Delay(NamedTuple):
    """A delay in control periods."""

    lookback: Int[Array, "*batch"]  # whole periods
    fraction: Float[Array, "*batch"]  # the rest [1]
    period: Float[Array, "*batch"]  # control period [s]


class DelayLine(NamedTuple):
    """Readings of the measured position."""

    first_position: Float[Array, "*batch"]  # the run's first reading [m]
    first_velocity: Float[Array, "*batch"]  # its speed then [m/s]
    ring: Float[Array, "samples *batch"]  # of readings [m]


def split(delay: Array, period: Array) -> Delay:
    """`delay` [s] >= 0 in periods; within 1e-9 of a whole number it is that number."""
    periods = delay / period
    whole = jax.lax.stop_gradient(jnp.floor(periods + 1e-9))
    return Delay(whole.astype(jnp.int32), periods - whole, period)


def empty(ring: int, zeros: Float[Array, "*batch"]) -> DelayLine:
    """A line of `ring` samples, a power of two; nothing of it is read before it is written."""
    return DelayLine(zeros, zeros, jnp.zeros((ring, *zeros.shape), zeros.dtype))


def delayed(delay: Delay, line: DelayLine, signals: Signals, tick: Array) -> tuple[Array, DelayLine]:
    """The measured position [m] a delay ago, and the line with this tick's reading in it."""
    measured, age = signals.position_measured, signals.age
    begins = age == 0
    first_position = jnp.where(begins, measured, line.first_position)
    first_velocity = jnp.where(begins, signals.velocity_desired, line.first_velocity)
    ring = write(line.ring, tick, measured)
    newer, older = look_back(ring, tick, delay.lookback), look_back(ring, tick, delay.lookback + 1)
    recalled = newer - delay.fraction * (newer - older)
    ticks = (age - delay.lookback).astype(measured.dtype) - delay.fraction
    uniform = first_position + ticks * (delay.period * first_velocity)
    position = jnp.where(age <= delay.lookback, uniform, recalled)
    return position, DelayLine(first_position, first_velocity, ring)
