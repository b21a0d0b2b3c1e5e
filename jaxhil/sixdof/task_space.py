"""The motion simulator in task space: six coordinates, each with a model and a delay of its own.

Coordinates are (p, theta), six numbers along a leading axis, (6, *batch). Each follows its command as on one
axis (`jaxhil.simulation.motion_simulator`), propagated exactly. The hardware's pose at one time needs every
axis at that time: as each has its own delay, each is sampled at its own place in a sampling interval, and
looked up as many intervals back as its delay is long.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.compensators.ring_buffer import look_back, write_in_turn
from jaxhil.simulation.motion_simulator import (
    Delay,
    Propagation,
    advance,
    propagation,
    read,
    split_delay,
    steady_state,
)
from jaxhil.simulation.scenario import MotionSimulator


class TaskSpace(NamedTuple):
    """Six motion simulators, discretised, and where the force sensor samples them."""

    propagation: Propagation  # of each axis, (..., 6, *batch)
    delay: Delay  # of each axis and the force sensor together, (6, *batch)


class Sample(NamedTuple):
    """Coordinates of the hardware."""

    coordinates: Float[Array, "..."]  # (6, *batch) [m, rad]
    rates: Float[Array, "..."]  # (6, *batch) [m/s, rad/s]


class Hardware(NamedTuple):
    """What evolves of the motion simulator and its samples."""

    commands: tuple[Array, ...]  # c(n), c(n-1), ... as sent to the drives, (6, *batch) each
    state: tuple[Array, ...]  # of the six axes
    samples: Sample  # ring of the samples of each sampling interval, (samples, 6, *batch)
    before: Sample  # sample of the sampling interval before the run, and its growth in a period


def build_task_space(
    simulator: MotionSimulator,
    force_delay: Float[Array, "*batch"],
    control_period: Float[Array, "*batch"],
    hold: str,
) -> TaskSpace:
    """Six simulators without limits, leaves (..., 6, *batch), sampled by a sensor with a delay [s]."""
    period = jnp.broadcast_to(control_period[None], simulator.delay.shape)
    delay = split_delay(simulator.delay + force_delay[None], period)
    exact = propagation(
        simulator.numerator, simulator.denominator, period, delay.fraction, delay.fraction, hold
    )
    return TaskSpace(exact, delay)


def enter(
    plant: TaskSpace, at: Array, stride: Array, period: Array, hold: str, latency: int, ring: int
) -> Hardware:
    """The hardware in uniform motion, `at` now and growing by `stride` in a control period [s], both
    (6, *batch); `ring`, a power of two, is longer than any delay in periods."""
    commands = tuple(at - back * stride for back in range(latency + 1))
    drive = commands[-1] if hold == "linear" else commands[-1] + stride
    start = drive - stride
    end = drive if hold == "linear" else start
    rows = plant.propagation
    settled = steady_state(rows, start, stride)
    nothing = jnp.zeros((ring, *at.shape), at.dtype)
    return Hardware(
        commands=commands,
        state=steady_state(rows, drive, stride),
        samples=Sample(nothing, nothing),
        before=Sample(read(rows.position, settled, start, end), stride),
    )


def sampled(plant: TaskSpace, hardware: Hardware, tick: Int[Array, ""], period: Array) -> Sample:
    """What the force sensor meets that reads at `tick`, counted from the start of the run."""
    first, stride = hardware.before
    intervals = plant.delay.intervals
    uniform = first + (tick - intervals).astype(stride.dtype) * stride
    ran = tick > intervals
    # Rings are read up to one ring behind: an index below 0 wraps, and is not taken.
    found, rates = (look_back(ring, tick - 1, intervals) for ring in hardware.samples)
    return Sample(jnp.where(ran, found, uniform), jnp.where(ran, rates, stride / period[None]))


def actuate(
    plant: TaskSpace, hardware: Hardware, tick: Int[Array, ""], command: Array, hold: str, latency: int
) -> Hardware:
    """The hardware after the control period of `tick`, which ends with `command` sent."""
    commands = (command, *hardware.commands)
    end = commands[latency]
    start = commands[latency + 1] if hold == "linear" else end
    rows, state = plant.propagation, hardware.state
    sample = Sample(read(rows.position, state, start, end), read(rows.velocity, state, start, end))
    return hardware._replace(
        commands=commands[: latency + 1],
        state=advance(rows.transition, state, start, end),
        samples=write_in_turn(hardware.samples, tick, sample),
    )
