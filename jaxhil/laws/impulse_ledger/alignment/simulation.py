"""Alignment in JAX: batched version of `rig.py` in this folder."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxhil.laws.shared.delay_line import DelayLine, empty_delay_line, read_delayed, split_delay
from jaxhil.laws.simulation_base import Signals


class Alignment(NamedTuple):
    """Positions measured before the next tick; tau is the force delay, T the control period."""

    line: DelayLine
    middle: Float[Array, "*batch"]  # position measured tau before the next tick [m]
    last: Float[Array, "*batch"]  # position measured tau + T before the next tick [m]


def begin(ring: int, zeros: Array) -> Alignment:
    """Return the state before the first tick, with `ring` samples in the delay line."""
    return Alignment(empty_delay_line(ring, zeros), zeros, zeros)


def align(
    old: Alignment, delay: Array, period: Array, signals: Signals, tick: Array
) -> tuple[Array, Array, Alignment]:
    """Return the measured position [m] and velocity [m/s], delayed by `delay` [s], and the next state."""
    periods = split_delay(jnp.where(delay > period, delay - period, 0), period)
    newest, line = read_delayed(periods, old.line, signals, tick)
    begins, stride = signals.age == 0, period * signals.velocity_desired
    middle = jnp.where(begins, newest - stride, old.middle)
    last = jnp.where(begins, newest - 2 * stride, old.last)
    position = newest + jnp.where(delay > period, 1, delay / period) * (middle - newest)
    return position, (newest - last) / (2 * period), Alignment(line, newest, middle)
