"""Recorded readings of six-axis rigs, and the commands of JAX and rig compensators for them."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jittered import Jittered

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.laws.six_axis_base import SixAxisConstants, SixAxisSignals
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig.six_axes import SIX_AXIS_COMPENSATORS as ON_THE_RIG
from jaxhil.rig.six_axes import ModelConstants
from jaxhil.rig.six_axes.vectors import coordinate_rates
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.controller_record import ControllerRecord, known_constants, record_controller

RING = 128  # length of the JAX compensators' delay line [samples]


class Records(NamedTuple):
    """Recorded runs of a mechanism, and the constants that the compensator knows."""

    mechanism: object
    gains: dict[str, float]
    lanes: list[ControllerRecord]
    constants: SixAxisConstants
    longest_delay: float  # [s]

    def on_the_rig(self, lane: int) -> ModelConstants:
        known = self.constants
        matrices = (known.mass_matrix, known.inverse_mass, known.tool_correction)
        lists = (matrix[..., lane].tolist() for matrix in matrices)
        return ModelConstants(*lists, self.longest_delay, 1.0, [0.0] * 6)


def recorded(mechanism, compensator, lanes, seed=1, changes=None):
    """Record drawn runs of a mechanism with the gains from the literature, some of them changed."""
    with jax_context():
        scenario = build_scenarios(mechanism, draw(mechanism, lanes, seed), seed=seed)
        loop = dataclasses.replace(make_loop(mechanism, compensator, scenario), measures_pose=True)
        gains = {**literature_gains(mechanism, compensator), **(changes or {})}
        arrays = {name: jnp.asarray(value) for name, value in gains.items()}
        _, records = record_controller(loop, arrays, scenario)
        constants = known_constants(loop, scenario)
    longest = (loop.controller_ring - 2) * mechanism.rig.control_period
    return Records(mechanism, gains, records, constants, longest)


@functools.partial(jax.jit, static_argnums=0)
def _simulate(name, gains, constants, readings):
    """Return the JAX compensator's wrenches (ticks, 6) for the readings (ticks, 6) of one run."""
    law = SIX_AXIS_COMPENSATORS[name]
    wrench, desired, twist = readings[:3]
    prepared = law.prepare(gains, constants)
    start = SixAxisSignals(tuple(0 * wrench[0]), desired[0], twist[0], None, jnp.int32(0))

    def tick(state, now):
        index, wrench, desired, twist, measured = now
        measured = measured if law.reads_pose else None
        signals = SixAxisSignals(tuple(wrench), desired, twist, measured, index)
        command, state = law.step(prepared, state, signals, index)
        return state, jnp.stack(command)

    index = jnp.arange(len(wrench), dtype=jnp.int32)
    state = law.init(prepared, constants, start, RING)
    return lax.scan(tick, state, (index, *readings))[1]


def simulated_alone(name, gains, constants, period, readings):
    """Return the JAX compensator's commands for four arrays of readings (ticks, 6), without a rig."""
    with jax_context():
        arrays = {gain: jnp.asarray(value) for gain, value in gains.items()}
        matrices = (jnp.asarray(matrix) for matrix in constants[:3])
        known = SixAxisConstants(jnp.asarray(period), *matrices)
        return np.asarray(_simulate(name, arrays, known, tuple(map(jnp.asarray, readings))))


def rig_commands(name, gains, constants, period, readings):
    """Return the rig compensator's wrench and pose commands (ticks, 6) for the readings."""
    law = ON_THE_RIG[name](gains, constants, period)
    commands, sent = [], []
    for wrench, desired, twist, measured in zip(*(column.tolist() for column in readings), strict=True):
        commands.append(law.step(wrench, desired, twist, measured))
        sent.append(law.pose_command(desired, coordinate_rates(desired, twist)))
    return np.array(commands), np.array(sent)


def random_readings(rng, ticks, period):
    """Draw readings of contacts in random directions, with random stiffness, noise and hardware lag."""
    time = period * np.arange(-60, ticks)[:, None]
    middle, phase = rng.uniform(-0.3, 0.3, 6), rng.uniform(0, 2 * np.pi, 6)
    size, rate = 10 ** rng.uniform(-4, -2, 6), rng.uniform(5, 40, 6)
    motion = middle + size * np.sin(rate * time + phase)
    twist = size * rate * np.cos(rate * time + phase)
    axis = rng.standard_normal(6)
    depth = np.maximum((motion - middle) @ axis - rng.uniform(-1, 1) * np.linalg.norm(size), 0)
    wrench = -(10 ** rng.uniform(3, 5)) * depth[:, None] * axis
    lag = int(rng.integers(5, 40))
    late = np.roll(motion, lag, axis=0)[60:] + 1e-6 * rng.standard_normal((ticks, 6))
    noise = rng.choice([0.0, 0.5]) * rng.standard_normal((ticks, 6))
    return np.roll(wrench, lag + 4, axis=0)[60:] + noise, motion[60:], twist[60:], late


def rounding_spread(name, gains, constants, period, readings):
    """Return the spread of the rig's commands with random rounding, divided by their range."""
    noisy = {gain: Jittered(value) for gain, value in gains.items()}
    rows = [
        [[*map(Jittered, vector)] for vector in row]
        for row in zip(*(column.tolist() for column in readings), strict=True)
    ]
    runs = []
    for seed in range(3):
        Jittered.generator.seed(seed)
        law = ON_THE_RIG[name](noisy, constants, Jittered(period))
        runs.append([law.step(*row) for row in rows])
    commands = np.array(runs, float)
    return max(relative_difference(run, commands[0]) for run in commands[1:])


def relative_difference(found, expected):
    """Return the largest difference, divided by the range (including 0) of force or torque."""
    worst = 0.0
    for part in (slice(0, 3), slice(3, 6)):
        span = np.max(expected[:, part], initial=0.0) - np.min(expected[:, part], initial=0.0)
        error = np.max(np.abs(found[:, part] - expected[:, part]))
        worst = max(worst, error / span if span > 0 else (0.0 if error == 0 else np.inf))
    return worst
