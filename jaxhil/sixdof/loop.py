"""Loop of the six-axis rig, tick by tick.

A tick has four steps. The sensors read the delayed wrench of the real contact and the pose of the hardware.
The compensator computes the wrench command. The numerical model integrates the motion of both bodies under
this wrench. The motion simulator receives the relative pose of the bodies as its command.

The contact wrench is computed at the hardware's pose, in the axes of target frame T and about T's origin.
This wrench acts on the numerical model at the origin of the model's frame T.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxhil.lanes import select_lanes
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.laws.simulation_base import Gains
from jaxhil.laws.six_axis_base import SixAxisSignals
from jaxhil.simulation.scenario import add_jitter
from jaxhil.simulation.timing import HeldValues, hold_compensator, update_held_values
from jaxhil.sixdof.axes import actuate, build_axes, start_uniform_motion, static_lags
from jaxhil.sixdof.bodies import SHARES
from jaxhil.sixdof.latch import init_latch
from jaxhil.sixdof.loop_state import (
    SETTLING_TICKS,
    Loop,
    NumericalController,
    RigConstants,
    RunState,
    Sensed,
    Tick,
)
from jaxhil.sixdof.numerical_model import controller_constants, model_motion
from jaxhil.sixdof.relative import (
    States,
    Wrench,
    advance,
    relative,
)
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensing import sense, start_filter
from jaxhil.sixdof.vectors import vector


def build_loop(scenario: Scenario, **static: Any) -> Loop:
    """Build the loop for a batch of scenarios; `static` sets the fields that scenarios do not determine."""
    sensor, period = scenario.sensor, np.asarray(scenario.control_period)
    errors = sensor.errors
    force_delay = np.asarray(add_jitter(sensor.delay, scenario.timing))
    slowest = np.maximum(force_delay, sensor.position_delay)[None] + np.asarray(scenario.simulator.delay)
    window = scenario.simulator.window
    longest = slowest if window is None else np.maximum(slowest, np.asarray(window))
    intervals = int(np.max(longest / period[None])) + 2
    law = SIX_AXIS_COMPENSATORS[static.get("compensator", "none")]
    # A compensator may estimate the delay of the whole loop, with an error of up to 100 %.
    whole = int(np.max((slowest + static_lags(scenario.simulator)) / period[None]))
    loop = Loop(
        ring=1 << intervals.bit_length(),
        controller_ring=1 << (2 * whole + 4).bit_length() if law.reads_pose else 1,
        has_lag=bool(np.any(np.asarray(sensor.time_constant) > 0)),
        has_sample_effects=bool(
            np.any(np.asarray(errors.quantum) > 0)
            or np.any(np.asarray(errors.dead_zone) > 0)
            or np.any(np.isfinite(errors.range))
        ),
        **static,
    )
    return loop


def build_rig_constants(loop: Loop, gains: Gains, scenario: Scenario) -> RigConstants:
    """Discretise the axes and prepare the compensator; each gain is a scalar or has the batch shape."""
    sensor, period, law = scenario.sensor, scenario.control_period, SIX_AXIS_COMPENSATORS[loop.compensator]
    has_tool = loop.side == "moving"
    axes = build_axes(
        scenario.simulator,
        sensor.delay,
        sensor.position_delay,
        period,
        loop.hold,
        has_tool,
        has_tool or law.reads_pose or loop.measures_pose,
        scenario.timing is not None and scenario.timing.jitter is not None,
    )
    full = {name: jnp.zeros_like(period) + value for name, value in gains.items()}
    constants = controller_constants(scenario, has_tool)
    return RigConstants(
        bodies=scenario.bodies,
        axes=axes,
        kinematics=scenario.kinematics,
        groups=scenario.groups,
        latches=scenario.latches,
        sensor=sensor,
        period=period,
        key=scenario.key,
        gains=full,
        constants=constants,
        prepared=law.prepare(full, constants),
        timing=scenario.timing,
    )


def begin(
    loop: Loop, rig: RigConstants, states: States, command: Float[Array, "6 *batch"] | None = None
) -> RunState:
    """Compute the state of the loop before tick 0 from the states of the bodies at tick 0.

    Before tick 0, the pose command is assumed to move uniformly with the bodies' relative rates. `command` is
    the pose command of tick 0. If it is None, the compensator computes this command.
    """
    law = SIX_AXIS_COMPENSATORS[loop.compensator]
    position, rates, twist = model_motion(rig.bodies, states)
    stride = rates * rig.period[None]
    # The number of ticks is a multiple of the delay line's length, because `start_uniform_motion` fills the
    # line for a start at tick 0.
    history = 0 if rig.kinematics.is_linear else max(SETTLING_TICKS, loop.ring)
    command = law.pose_command(rig.gains, position, rates) if command is None else command
    legs, leg_rates = jax.jvp(rig.kinematics.command, (command - history * stride,), (stride,))
    hardware = start_uniform_motion(rig.axes, legs, leg_rates, rig.period, loop.hold, loop.latency, loop.ring)

    def before(hardware, tick):
        legs = rig.kinematics.command(command + (tick + 1).astype(position.dtype) * stride)
        return actuate(rig.axes, hardware, tick, legs, loop.hold, loop.latency), None

    hardware, _ = lax.scan(before, hardware, jnp.arange(-history, 0, dtype=jnp.int32))
    zero = vector(jnp.zeros_like(position[:3]))
    nothing = Wrench(zero, zero)
    pose, _ = relative(rig.bodies, states)
    start = SixAxisSignals(
        wrench=tuple(jax.tree.leaves(nothing)),
        pose_desired=position,
        twist_desired=twist,
        pose_measured=None,
        age=jnp.zeros(rig.period.shape, jnp.int32),
    )
    return RunState(
        states=states,
        near=position,
        twist=twist,
        hardware=hardware,
        memories=tuple(group.init() for group in rig.groups),
        latch_states=tuple(init_latch(latch, pose) for latch in rig.latches),
        controller=NumericalController(
            (nothing, start_filter(loop.sensor_filter, nothing)) if loop.has_lag else None,
            law.init(rig.prepared, rig.constants, start, loop.controller_ring),
            None if rig.timing is None else HeldValues(nothing, nothing, start.age),
            None if rig.sensor.bias_walk is None else jnp.zeros_like(rig.sensor.bias_walk),
        ),
        tick=jnp.array(0, jnp.int32),
    )


def run(loop: Loop, gains: Gains, scenario: Scenario, ticks: int) -> tuple[RunState, Tick]:
    """Run a batch of scenarios for `ticks` ticks; return the final state and one record per tick."""
    rig = build_rig_constants(loop, gains, scenario)
    state = begin(loop, rig, scenario.start)
    return lax.scan(lambda state, _: tick(loop, rig, state), state, None, length=ticks)


def tick(loop: Loop, rig: RigConstants, state: RunState) -> tuple[RunState, Tick]:
    """Simulate one control period; return the next state and the record of the tick."""
    sensed, law = sense(loop, rig, state), SIX_AXIS_COMPENSATORS[loop.compensator]
    # A compensator that does not use the measured pose does not get it.
    signals = sensed.signals
    signals = signals if law.reads_pose else signals._replace(pose_measured=None)
    before, missed = state.controller, sensed.missed
    if before.held is not None:
        # As on the rig, the compensator counts only the ticks at which it runs, not the missed ticks.
        signals = signals._replace(age=signals.age - before.held.missed)
    commands, law_state = law.step(rig.prepared, before.law, signals, state.tick)
    command = jax.tree.unflatten(jax.tree.structure(sensed.contact), commands)
    if missed is not None and before.held is not None:
        command = select_lanes(missed, before.held.command, command)
        law_state = hold_compensator(missed, before.law, law_state, loop.controller_ring)
    states, position, rates, twist = integrate(loop, rig, state, command, missed)
    sent = law.pose_command(rig.gains, position, rates)
    after, seen = complete_tick(loop, rig, state, sensed, command, (states, position, twist), sent)
    return after._replace(controller=after.controller._replace(law=law_state)), seen


def integrate(
    loop: Loop,
    rig: RigConstants,
    state: RunState,
    command: Wrench,
    missed: Bool[Array, "*batch"] | None = None,
) -> tuple[States, Array, Array, Array]:
    """Return the numerical model's next states, and its next coordinates, rates and twist (6, *batch).

    In lanes where `missed` is true, the controller does not run at this tick, and the states do not change.
    """
    states = advance(rig.bodies, state.states, command, rig.period, SHARES[loop.integrator])
    if missed is not None:
        states = select_lanes(missed, state.states, states)
    return states, *model_motion(rig.bodies, states)


def complete_tick(
    loop: Loop,
    rig: RigConstants,
    state: RunState,
    sensed: Sensed,
    command: Wrench,
    model: tuple[States, Array, Array],
    sent: Float[Array, "6 *batch"],
) -> tuple[RunState, Tick]:
    """Complete a tick: move the hardware, and return the next state of the loop and the tick's record.

    In the next state, only the compensator's state is still that before the tick.

    Args:
        loop: structure of the loop.
        rig: constants of the run.
        state: state before the tick.
        sensed: real contact and readings of the tick.
        command: wrench command of the tick, which has moved the numerical model.
        model: the numerical model's states, coordinates and twist after the tick.
        sent: pose command to the motion simulator [m, rad].
    """
    states, position, twist = model
    controller = state.controller._replace(
        lag=sensed.lag,
        bias_walk=sensed.bias_walk,
        held=update_held_values(state.controller.held, sensed.reading, command, sensed.missed),
    )
    hardware = actuate(
        rig.axes, state.hardware, state.tick, rig.kinematics.command(sent), loop.hold, loop.latency
    )
    after = RunState(
        states=states,
        near=position,
        twist=twist,
        hardware=hardware,
        memories=sensed.memories,
        latch_states=sensed.latch_states,
        controller=controller,
        tick=state.tick + 1,
    )
    seen = Tick(
        states=state.states,
        pose=sensed.motion.pose,
        twist=sensed.motion.twist,
        contact=sensed.contact,
        forces=sensed.forces,
        latch_states=sensed.latch_states,
        signals=sensed.signals,
        command=command,
        sent=sent,
    )
    return after, seen
