"""FMU of the rig with six axes: its C code is generated from the JAX program of `jaxhil simulate`.

A step has two functions. `rig_move` integrates the numerical model under the wrench command, and moves the
hardware by the pose command. `rig_sense` computes the real contact and the readings of the sensors.
"""

import dataclasses
import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxhil.errors import InputError
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.mechanism.file import any_from_plain_data
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.kinematics import RigidMotion
from jaxhil.sixdof.loop import begin, build_rig_constants, complete_tick, integrate
from jaxhil.sixdof.loop_state import Loop, RigConstants, RunState, Sensed
from jaxhil.sixdof.numerical_model import model_motion
from jaxhil.sixdof.relative import Wrench, interface_frame
from jaxhil.sixdof.rotations import rotate_back
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensing import sense
from jaxhil.sixdof.vectors import vector
from tuning.bundle.c99_tables import NO_CONTRACTION
from tuning.bundle.jaxpr_c.functions import to_c
from tuning.bundle.jaxpr_c.values import UnsupportedProgram, initialiser
from tuning.rig.six_axis_rig import build_unpacker, pack

_HEADER = """\
/* Program of the rig, generated from the equations of `jaxhil simulate`; numbers in SI units. */
#ifndef RIG_PROGRAM_H
#define RIG_PROGRAM_H

#include <stdint.h>

enum {{ RIG_NUMBERS = {count} }};

/* State at the start of a run. */
extern const double rig_start[RIG_NUMBERS];

/* Integrate the numerical model under a wrench command [N, N m], and move the hardware by a pose command
 * [m, rad]. The last argument is the state after one control period. */
void rig_move(const double *state, const double *wrench, const double *pose, double *moved);

/* Read the sensors with this key of the noise. `sensed` is the state with the contact's new state.
 * The readings are those of wrench and pose, then pose and twist of the model, the contact wrench, and the
 * target's angular velocity. */
void rig_sense(const double *state, const uint32_t *key, double *sensed, double *readings);

#endif
"""
_SOURCE = """\
/* See rig_program.h. */
#include "rig_program.h"

#include <math.h>
#include <stdbool.h>

{contraction}
const double rig_start[RIG_NUMBERS] = {start};

{functions}"""


class RigState(NamedTuple):
    """State of the rig, which the C functions `rig_move` and `rig_sense` change in turn.

    The contact's own state, such as its memories, changes only in `rig_sense`.
    """

    run: RunState
    reading: Wrench | None  # last reading of the force sensor's channels; None without timing effects


def rig_program(document: Mapping[str, Any], mechanism: SixAxisMechanism) -> dict[str, str]:
    """Return the generated C files of a rig.

    Args:
        document: gain document. Its compensator determines the pose commands before the start of a run.
        mechanism: mechanism of the document, without the command latency that the co-simulation adds.

    Raises:
        InputError: If a part of the rig's JAX program cannot be translated to C.
    """
    gains = {name: float(gain["value"]) for name, gain in document["gains"].items()}
    plain = json.dumps([document["mechanism"], mechanism.rig.command_latency, document["compensator"], gains])
    return dict(_generate(plain))


def nominal_start(mechanism: SixAxisMechanism) -> tuple[list[float], int]:
    """Return the states of both bodies at tick 0, and the maximum duration of the run [ticks]."""
    with jax_context():
        scenario = build_scenarios(mechanism)
        start = [float(leaf[0]) for leaf in jax.tree.leaves(scenario.start)]
        return start, round(float(scenario.duration[0]) / mechanism.rig.control_period)


@lru_cache(maxsize=8)
def _generate(plain: str) -> tuple[tuple[str, str], ...]:
    """Return name and text of each C file; `plain` is JSON: mechanism, latency, compensator, gains."""
    raw, latency, compensator, gains = json.loads(plain)
    raw["rig"]["command_latency"] = latency
    mechanism = any_from_plain_data(raw, "gain document")
    assert isinstance(mechanism, SixAxisMechanism)
    with jax_context():
        scenario = build_scenarios(mechanism)
        # The commands come from the controller's FMU, and the rig always measures the pose.
        loop = dataclasses.replace(make_loop(mechanism, "none", scenario), measures_pose=True)
        rig = build_rig_constants(loop, {}, scenario)
        state = _start(loop, rig, scenario, compensator, gains)
        numbers, unpack = pack(state), build_unpacker(state)
        six = np.zeros((6, 1))
        move = jax.make_jaxpr(lambda state, *commands: pack(_move(loop, rig, unpack(state), *commands)))
        read = jax.make_jaxpr(lambda state, key: _sense(loop, rig._replace(key=key), unpack(state)))
        try:
            code = to_c({"rig_move": move(numbers, six, six), "rig_sense": read(numbers, scenario.key)})
        except UnsupportedProgram as error:
            raise InputError(f"fmu: {error}; no FMU of the rig can be written") from None
    start = initialiser(np.asarray(numbers), "float64")
    return (
        ("rig_program.h", _HEADER.format(count=numbers.size)),
        ("rig_program.c", _SOURCE.format(contraction=NO_CONTRACTION, start=start, functions=code)),
    )


def _start(
    loop: Loop, rig: RigConstants, scenario: Scenario, compensator: str, gains: Mapping[str, float]
) -> RigState:
    """Return the rig's state at tick 0, before the sensors are read.

    Its latest pose command is that of the previous tick, because a co-simulation delays commands by one
    period.
    """
    position, rates, _ = model_motion(rig.bodies, scenario.start)
    law = SIX_AXIS_COMPENSATORS[compensator]
    full = {name: jnp.full_like(rig.period, value) for name, value in gains.items()}
    command = law.pose_command(full, position, rates) - rates * rig.period[None]
    run = begin(loop, rig, scenario.start, command)
    repeated = run.controller.held
    return RigState(run, None if repeated is None else repeated.reading)


def _move(
    loop: Loop, rig: RigConstants, state: RigState, wrench: Float[Array, "6 1"], pose: Float[Array, "6 1"]
) -> RigState:
    """Return the state after one control period, before the sensors are read."""
    run = state.run
    command = Wrench(vector(wrench[:3]), vector(wrench[3:]))
    states, position, _, twist = integrate(loop, rig, run, command)
    unused: Any = None
    sensed = Sensed(
        motion=RigidMotion(unused, unused, unused),
        contact=unused,
        forces=(),
        memories=run.memories,
        latch_states=run.latch_states,
        lag=run.controller.lag,
        signals=unused,
        reading=state.reading,
        missed=None,
        bias_walk=run.controller.bias_walk,
    )
    after, _ = complete_tick(loop, rig, run, sensed, command, (states, position, twist), pose)
    return RigState(after, state.reading)


def _sense(loop: Loop, rig: RigConstants, state: RigState) -> tuple[Array, Array]:
    """Return the state after the sensors were read, and the outputs of the FMU."""
    run, sensed = state.run, sense(loop, rig, state.run)
    after = run._replace(
        memories=sensed.memories,
        latch_states=sensed.latch_states,
        controller=run.controller._replace(lag=sensed.lag, bias_walk=sensed.bias_walk),
    )
    signals = sensed.signals
    target = interface_frame(rig.bodies.target, run.states.target)
    spin = rotate_back(target.attitude, target.angular_velocity)
    outputs = pack((signals.wrench, signals.pose_measured, run.near, run.twist, sensed.contact, spin))
    return pack(RigState(after, sensed.reading)), outputs
