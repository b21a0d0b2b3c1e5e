"""Simulation of one tick of the rig, in six stages (notebooks/guide/model.md, section 1).

    sense            read the force sensor and the position sensor
    compensate       compute the force command F_c from the readings and the numerical model's motion
    integrate        integrate the numerical model for one control period, under the force -F_c
    actuate          apply limits, latency, hold and motion simulator to the position command
    compute_contact  compute the real contact in the sampling interval
    record_contact   record beginning, end, restitution, peaks and work of the current contact

`RunState` contains what changes from tick to tick. `Tick` is the record of one tick.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import select_lanes
from jaxhil.laws.shared.ring_buffer import depend_on, look_back, write_sample, write_samples
from jaxhil.laws.simulation_base import Gains, Signals
from jaxhil.simulation.cells import MIN_LAG, IntervalInputs, power_series
from jaxhil.simulation.contact_force import (
    IntervalContact,
    PlantSignals,
    SamplingInterval,
    Surfaces,
    apply_sensor_lag,
    compute_interval_motion,
    compute_work_along,
    compute_work_between,
    largest_force,
    read_current_interval,
)
from jaxhil.simulation.contact_in_cells import ContactSurfaces, compute_jump_work, contact_in_cells
from jaxhil.simulation.contact_tracking import ContactEndConditions, ContactTracker, record_contact
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.loop import Loop, RigConstants
from jaxhil.simulation.loop_state import LoopState, PlantState, Rings
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.motion_simulator import advance_state, read_measured_position
from jaxhil.simulation.moving_average import UniformCommand, read_leaving_commands
from jaxhil.simulation.probe import Probe
from jaxhil.simulation.probed_tick import apply_probe
from jaxhil.simulation.rate_limits import apply_limits
from jaxhil.simulation.sensors import SensorNoise, quantise, sample_force
from jaxhil.simulation.timing import TimingDraws, hold_compensator, read_force, update_held_values


class RunState(NamedTuple):
    """State of the simulation, which changes from tick to tick."""

    state: LoopState  # state of the loop
    tracker: ContactTracker  # record of the current contact
    metrics: Metrics  # metrics of finished contacts
    index: Int[Array, "*batch"]  # index of the current contact, from 0
    active: Bool[Array, "*batch"]  # whether the last contact of the lane has not yet ended
    tick: Int[Array, ""]  # number of the next tick, common to all lanes
    skipped: Int[Array, "*batch"]  # number of ticks of approaches that were skipped


class Tick(NamedTuple):
    """Record of one tick: sensor readings, commands and real forces."""

    signals: Signals  # inputs of the compensator
    command: Float[Array, "*batch"]  # force command F_c [N], output of the compensator
    plant_signals: PlantSignals  # real forces, without the effects of the sensors
    active: Bool[Array, "*batch"]  # whether the current contact of the lane has not yet ended
    contact: Int[Array, "*batch"]  # index of the current or next contact, from 0
    # estimates of stiffness [N/m] and damping [N s/m]; None if the compensator identifies neither
    identified: tuple[Array, Array] | None
    sent: Float[Array, "*batch"]  # unlimited position command at the end of the tick [m]


class SegmentConstants(NamedTuple):
    """Values that are computed once for all ticks of a segment (a few successive ticks)."""

    gains: Gains  # gains of the compensator
    controller: Any  # values that the compensator has computed from its gains
    rules: ContactEndConditions  # conditions for the end of a contact
    probe: Probe | None  # probe of the current contact; None without a probe


class ModelState(NamedTuple):
    """State of the numerical model at the end of a control period."""

    position: Float[Array, "*batch"]  # position x_d [m]
    velocity: Float[Array, "*batch"]  # velocity v_d [m/s]
    acceleration: Float[Array, "*batch"]  # constant acceleration a_d during the period [m/s^2]


class ActuationResult(NamedTuple):
    """Motion of the rig that results from a position command."""

    plant: PlantState  # state of drives and motion simulator at the end of the control period
    controller: Any  # state of the compensator
    # position of the mechanism at the position sensor's sampling instant [m]; None if unused
    position: Float[Array, "*batch"] | None
    interval: SamplingInterval  # sampling interval in which the contact is computed at this tick
    # delay line of intervals in which the contact is not yet computed; None with one surface
    pending: SamplingInterval | None
    # delay line of drive commands; None unless the motion simulator is a moving average
    commands: Float[Array, "samples *batch"] | None
    inputs: IntervalInputs | None  # inputs of the motion in the current interval; None without jitter


def tick(
    loop: Loop,
    rig: RigConstants,
    prepared: SegmentConstants,
    run: RunState,
    noise: SensorNoise,
    timing: TimingDraws | None = None,
) -> tuple[RunState, Tick]:
    """Simulate one control period; return the next state and the record of the tick."""
    state, now = advance_bias(run.state, noise), run.tick
    missed = None if timing is None else timing.is_missed
    signals, plant_signals = sense(loop, rig, state, now, noise, timing, prepared.probe)
    force, controller = compensate(loop, prepared, state, signals, now)
    if missed is not None and state.held is not None:
        force = jnp.where(missed, state.held.command, force)
    model = integrate(loop, rig, state, force)
    if missed is not None:
        model = select_lanes(missed, model._replace(position=state.position, velocity=state.velocity), model)
    actuated = actuate(loop, rig, prepared.gains, state, now, model, controller, missed)
    contact = compute_contact(loop, rig, state, actuated.interval)
    tracker = record_contact(
        loop, prepared.rules, run.tracker, signals, plant_signals, force, state.plant.shortfall
    )
    if prepared.probe is not None:
        state, contact, tracker = apply_probe(
            rig,
            prepared.probe,
            state,
            run.tracker.has_ended,
            signals,
            actuated.interval.sample,
            contact,
            tracker,
            loop.sensor_filter,
        )
    state = update_state(state, now, plant_signals, model, actuated, contact)
    state = state._replace(held=update_held_values(state.held, signals.force_measured, force, missed))
    record = Tick(
        signals,
        force,
        plant_signals,
        active=run.active & ~tracker.has_ended,
        contact=run.index,
        identified=loop.compensator.identified(controller),
        sent=state.plant.sent,
    )
    return run._replace(state=state, tracker=tracker, tick=now + 1), record


def advance_bias(state: LoopState, noise: SensorNoise) -> LoopState:
    """Return the state with the force sensor's bias at the current tick, of which `noise` has the step."""
    if noise.bias_step is None or state.bias_walk is None:
        return state
    return state._replace(bias_walk=state.bias_walk + noise.bias_step)


def sense(
    loop: Loop,
    rig: RigConstants,
    state: LoopState,
    now: Array,
    noise: SensorNoise,
    timing: TimingDraws | None = None,
    probe: Probe | None = None,
) -> tuple[Signals, PlantSignals]:
    """Return the sensor readings at tick `now` and the last interval's real forces (stage 1 of a tick)."""
    scenario, sensed = rig.scenario, state.sensed
    age = now - state.onset_tick
    rings, delays, sensor = sensed.rings, rig.delays, scenario.force_sensor
    # With jitter, the derivative leaves out the jumps of a cut dead zone.
    step = jnp.zeros_like(sensor.dead_zone) if loop.cuts_dead_zone else None
    if timing is not None and timing.jitter is not None:
        force = read_force(loop, rig, state, now, age, timing.jitter, probe)
    else:
        force_ring = rings.plant_signals.force if rings.reading is None else rings.reading
        force = _delayed_sample(force_ring, now, age, delays.force.intervals)
        if loop.cuts_dead_zone:
            step = force - _delayed_sample(force_ring, now, age, delays.force.intervals + 1)
    plant_signals = jax.tree.map(
        lambda ring: _delayed_sample(ring, now, age, delays.real), rings.plant_signals
    )
    if loop.has_force_bias:
        force = force + sensor.bias
    if state.bias_walk is not None:
        force = force + state.bias_walk
    if noise.force is not None:
        force = force + noise.force
    if loop.has_sample_effects:
        force = sample_force(force, sensor.quantum, sensor.dead_zone, sensor.range, step)
    if timing is not None and timing.is_lost is not None and state.held is not None:
        force = jnp.where(timing.is_lost, state.held.reading, force)

    position = _delayed_position(rig, state, now, age)
    if noise.position is not None:
        position = position + noise.position
    if loop.has_sample_effects:
        position = quantise(position, scenario.position_sensor.quantum)
    return Signals(force, state.position, state.velocity, position, age), plant_signals


def compensate(
    loop: Loop, prepared: SegmentConstants, state: LoopState, signals: Signals, now: Array
) -> tuple[Array, Any]:
    """Return the force command F_c [N] and the compensator's next state (stage 2 of a tick).

    As on the rig, the compensator counts only the ticks at which it runs, not the missed ticks.
    """
    if state.held is not None:
        signals = signals._replace(age=signals.age - state.held.missed)
    force, controller = loop.compensator.step(prepared.controller, state.controller, signals, now)
    if loop.reads_always:
        force = jnp.where(signals.age == 0, 0, force)
    return force, controller


def integrate(loop: Loop, rig: RigConstants, state: LoopState, force: Array) -> ModelState:
    """Integrate the numerical model under the force -`force` [N] for a control period (stage 3 of a tick)."""
    acceleration = -force * rig.inverse_mass
    step = INTEGRATORS[loop.integrator]
    position, velocity = step(state.position, state.velocity, acceleration, rig.constants.control_period)
    return ModelState(position, velocity, acceleration)


def actuate(
    loop: Loop,
    rig: RigConstants,
    gains: Gains,
    state: LoopState,
    now: Array,
    model: ModelState,
    controller: Any,
    missed: Array | None = None,
) -> ActuationResult:
    """Apply limits, latency, hold and motion simulator to the position command (stage 4 of a tick).

    In lanes that `missed` the tick, the drives receive the last command again, and the compensator keeps its
    state.
    """
    command, controller = loop.compensator.position_command(gains, controller, *model)
    if missed is not None:
        command = jnp.where(missed, state.plant.sent, command)
        controller = hold_compensator(missed, state.controller, controller, loop.controller_ring)
    command, step, unlimited_command = apply_limits(rig, state.plant, command)
    commands = (command, *state.plant.commands)
    end = commands[loop.latency]
    start = commands[loop.latency + 1] if loop.hold == "linear" else end
    rows, simulator, past = rig.propagation, state.plant.state, state.sensed.rings.command
    first = state.plant.first_command
    if past is not None and rows.window is not None and first is not None:
        past = write_sample(past, now, end)
        stride = rig.constants.control_period * state.onset_velocity
        before_run = UniformCommand(first, stride, now - state.onset_tick)
        simulator = read_leaving_commands(past, now, rows.window, simulator, before_run)
    inputs = IntervalInputs(simulator, start, end, rig.scenario.contact_plane)
    interval = compute_interval_motion(rows, simulator, start, end, rig.scenario.contact_plane)._replace(
        interval_inputs=inputs if loop.has_cells else None
    )
    pending = state.sensed.rings.interval
    if pending is not None:
        pending = write_samples(pending, now, interval)
        interval = read_current_interval(rig, pending, now, now - state.onset_tick)
    next_state = advance_state(rows.transition, simulator, start, end)
    return ActuationResult(
        plant=state.plant._replace(
            commands=commands[: loop.latency + 1],
            step=step,
            state=next_state,
            unlimited_command=unlimited_command,
        ),
        controller=controller,
        position=read_measured_position(rows, simulator, start, end),
        interval=interval,
        pending=pending,
        commands=past,
        inputs=None if rig.series is None else inputs._replace(surface=None),
    )


def compute_contact(
    loop: Loop, rig: RigConstants, state: LoopState, interval: SamplingInterval
) -> IntervalContact:
    """Return the real contact in a sampling interval (stage 5 of a tick)."""
    if rig.cells is not None:
        return _compute_contact_in_cells(loop, rig, state, interval)
    scenario, period = rig.scenario, rig.constants.control_period
    clearance = scenario.clearance if loop.is_two_sided else None
    surfaces = Surfaces(loop.law, state.parameters, state.law, clearance)
    sample_time = rig.delays.force.fraction * period
    if loop.law.has_memory:
        at_sample = surfaces.advance(interval.start, interval.sample, sample_time)
        force, _ = at_sample.force(interval.sample)
        law = at_sample.advance(interval.sample, interval.end, period - sample_time).state
    else:
        force, law = surfaces.force(interval.sample)
    last, lagged, reading = state.sensed.last, state.sensed.lagged, None
    if loop.is_two_sided or loop.energies:
        last = surfaces.sample(interval.sample, force)
    if loop.has_lag:
        time_constant = scenario.force_sensor.time_constant
        reading, lagged = apply_sensor_lag(surfaces, lagged, interval, sample_time, period, time_constant)
    work = peak = None
    if loop.energies and loop.discontinuity_order == 0:
        work = compute_work_between(state.sensed.last, last)
    elif loop.energies:
        work = compute_work_along(surfaces, interval.start, interval.end, period)
    if loop.has_corners:
        peak = largest_force(surfaces, interval.start, interval.end, period)
    return IntervalContact(PlantSignals(force, work, peak, None), reading, lagged, last, None, law)


def _compute_contact_in_cells(
    loop: Loop, rig: RigConstants, state: LoopState, interval: SamplingInterval
) -> IntervalContact:
    """Return the real contact in a sampling interval, from the exact motion in its parts (cells)."""
    scenario, period, cells = rig.scenario, rig.constants.control_period, rig.cells
    assert cells is not None and interval.interval_inputs is not None
    clearance = scenario.clearance if loop.is_two_sided else None
    touch = ContactSurfaces(loop.law, state.parameters, clearance)
    result = contact_in_cells(
        touch,
        state.law,
        cells,
        power_series(cells, interval.interval_inputs),
        period,
        state.sensed.lagged,
        scenario.force_sensor.time_constant if loop.has_lag else None,
        None if loop.sensor_filter is None else (loop.sensor_filter, scenario.force_sensor.cutoff),
    )
    surfaces = Surfaces(loop.law, state.parameters, result.at_sample, clearance)
    force, _ = surfaces.force(interval.sample)
    last, work = state.sensed.last, result.work if loop.energies else None
    if loop.is_two_sided or loop.energies:
        last = surfaces.sample(interval.sample, force)
    if loop.energies and loop.discontinuity_order == 0:
        before = state.sensed.last.position(clearance)
        work = compute_jump_work(touch, state.law, before, interval.sample.position)
    reading = None
    if loop.sensor_filter is not None:
        reading = result.reading
    elif loop.has_lag:
        # Cells cannot resolve a lag of 0, which one lane may have while other lanes of the batch have a lag.
        lag = scenario.force_sensor.time_constant
        reading = jnp.where(lag > MIN_LAG * period, result.reading, force)
    before, after = result.contact_time
    assert state.sensed.contact_time is not None
    signals = PlantSignals(force, work, result.peak, state.sensed.contact_time + before)
    return IntervalContact(signals, reading, result.lagged, last, after, result.at_end)


def update_state(
    state: LoopState,
    now: Array,
    before: PlantSignals,
    model: ModelState,
    actuated: ActuationResult,
    contact: IntervalContact,
) -> LoopState:
    """Return the state of the loop after the tick.

    The forces and the motion of this tick are written to the delay lines. `before` contains the forces that
    were read from the delay lines at this tick: because the result depends on it, XLA reads before it writes.
    """
    plant_signals = jax.tree.map(depend_on, contact.plant_signals, before)
    samples = Rings(plant_signals, contact.reading, actuated.position, None, None, actuated.inputs)
    rings = write_samples(state.sensed.rings._replace(interval=None, command=None), now, samples)
    return state._replace(
        position=model.position,
        velocity=model.velocity,
        plant=actuated.plant,
        sensed=state.sensed._replace(
            rings=rings._replace(interval=actuated.pending, command=actuated.commands),
            last=contact.last,
            contact_time=contact.contact_time,
            lagged=contact.lagged,
        ),
        law=contact.law,
        controller=actuated.controller,
    )


def _delayed_sample(ring, now, age, intervals):
    """Return the sample `intervals` control periods before the newest sample; 0 before the run."""
    return look_back(ring, now - 1, intervals, age > intervals)


def _delayed_position(rig, state, now, age):
    """Return the delayed position [m], uniform before the run; NaN if the loop measures no position."""
    ring, intervals = state.sensed.rings.position, rig.delays.position.intervals
    if ring is None:
        return jnp.full_like(state.position, jnp.nan)
    stride = rig.constants.control_period * state.onset_velocity
    before = state.sensed.first_position + (age - intervals).astype(stride.dtype) * stride
    return look_back(ring, now - 1, intervals, age > intervals, before)
