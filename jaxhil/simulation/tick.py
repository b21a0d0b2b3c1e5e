"""One tick of the hardware-in-the-loop contact rig, in the six stages of notebooks/guide/model.md, section 1.

    sense           read the force sensor and the position sensor
    compensate      F_c from (F, x_d, v_d, x_a)
    integrate       M x_d'' = -F_c over one control period
    actuate         command -> limits, latency, hold -> motion simulator
    contact_force   force of the real contact at the force sensor's sampling instant
    record_contact  beginning, end, restitution, peaks and energies of the current contact

`RunState` is the state from tick to tick, `Tick` the record of one tick.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.shared.ring_buffer import depend_on, look_back, write_samples
from jaxhil.laws.simulation_base import Gains, Signals
from jaxhil.simulation.cells import MIN_LAG, IntervalInputs, power_series
from jaxhil.simulation.contact_force import (
    IntervalContact,
    MotionSample,
    PlantSignals,
    SamplingInterval,
    Surfaces,
    apply_sensor_lag,
    compute_work_along,
    compute_work_between,
    largest_force,
)
from jaxhil.simulation.contact_in_cells import ContactSurfaces, compute_jump_work, contact_in_cells
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.loop import Loop, RigConstants
from jaxhil.simulation.loop_state import LoopState, PlantState, Rings
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.motion_simulator import advance_state, apply_row, read_measured_position
from jaxhil.simulation.probe import Probe
from jaxhil.simulation.probed_tick import apply_probe
from jaxhil.simulation.rate_limits import limit_command
from jaxhil.simulation.sensors import SensorNoise, quantise, sample_force
from jaxhil.simulation.watch import ContactEndConditions, Watch, record_contact


class RunState(NamedTuple):
    """State from tick to tick."""

    state: LoopState  # state of the loop
    watch: Watch  # record of the current contact
    metrics: Metrics  # metrics of finished contacts
    index: Int[Array, "*batch"]  # index of the current contact, from 0
    active: Bool[Array, "*batch"]  # whether the lane is still running
    tick: Int[Array, ""]  # number of the next tick, common to all lanes
    skipped: Int[Array, "*batch"]  # skipped ticks of approaches


class Tick(NamedTuple):
    """Record of a tick."""

    signals: Signals  # readings of the controller
    command: Float[Array, "*batch"]  # F_c [N], output of the compensator
    plant_signals: PlantSignals  # contact without the effects of the sensors
    active: Bool[Array, "*batch"]  # whether the lane was still running
    contact: Int[Array, "*batch"]  # index of the contact, from 0
    # stiffness [N/m] and damping [N s/m], if the compensator identifies them
    identified: tuple[Array, Array] | None
    sent: Float[Array, "*batch"]  # position command at the tick's end [m], before any limits of the drives


class SegmentConstants(NamedTuple):
    """Values computed once for many ticks of a contact."""

    gains: Gains  # gains of the compensator
    controller: Any  # values that the compensator computed from them
    rules: ContactEndConditions  # conditions for the end of a contact
    probe: Probe | None  # probe of the current contact; None without one


class ModelState(NamedTuple):
    """Numerical model after a control period."""

    position: Float[Array, "*batch"]  # x_d [m]
    velocity: Float[Array, "*batch"]  # v_d [m/s]
    acceleration: Float[Array, "*batch"]  # a_d during the period [m/s^2]


class ActuationResult(NamedTuple):
    """Effect of a position command on the rig."""

    plant: PlantState  # drives and motion simulator after the control period
    controller: Any  # state of the compensator
    # position of the mechanism at its sampling instant [m]; None if unused
    position: Float[Array, "*batch"] | None
    interval: SamplingInterval  # motion whose contact is computed now
    # ring of the motions whose contact is not yet computed; None with one surface
    under_way: SamplingInterval | None


def tick(
    loop: Loop, rig: RigConstants, prepared: SegmentConstants, run: RunState, noise: SensorNoise
) -> tuple[RunState, Tick]:
    """Run one control period; return the next state and the tick's record."""
    state, now = run.state, run.tick
    signals, plant_signals = sense(loop, rig, state, now, noise)
    force, controller = compensate(loop, prepared, state, signals, now)
    model = integrate(loop, rig, state, force)
    actuated = actuate(loop, rig, prepared.gains, state, now, model, controller)
    contact = compute_contact(loop, rig, state, actuated.interval)
    watch = record_contact(
        loop, prepared.rules, run.watch, signals, plant_signals, force, state.plant.shortfall
    )
    if prepared.probe is not None:
        state, contact, watch = apply_probe(
            rig, prepared.probe, state, run.watch.over, signals, actuated.interval.sample, contact, watch
        )
    state = update_state(state, now, plant_signals, model, actuated, contact)
    seen = Tick(
        signals,
        force,
        plant_signals,
        active=run.active & ~watch.over,
        contact=run.index,
        identified=loop.compensator.identified(controller),
        sent=state.plant.sent,
    )
    return run._replace(state=state, watch=watch, tick=now + 1), seen


def sense(
    loop: Loop, rig: RigConstants, state: LoopState, now: Array, noise: SensorNoise
) -> tuple[Signals, PlantSignals]:
    """Return the sensor readings at tick `now`, noise included, and the plant's own signals (stage 1)."""
    scenario, sensed = rig.scenario, state.sensed
    age = now - state.onset_tick
    rings, delays = sensed.rings, rig.delays
    force_ring = rings.plant_signals.force if rings.reading is None else rings.reading
    force = _delayed_sample(force_ring, now, age, delays.force.intervals)
    plant_signals = jax.tree.map(
        lambda ring: _delayed_sample(ring, now, age, delays.real), rings.plant_signals
    )
    sensor = scenario.force_sensor
    if loop.has_force_bias:
        force = force + sensor.bias
    if noise.force is not None:
        force = force + noise.force
    if loop.has_sample_effects:
        force = sample_force(force, sensor.quantum, sensor.dead_zone, sensor.range)

    position = _delayed_position(rig, state, now, age)
    if noise.position is not None:
        position = position + noise.position
    if loop.has_sample_effects:
        position = quantise(position, scenario.position_sensor.quantum)
    return Signals(force, state.position, state.velocity, position, age), plant_signals


def compensate(
    loop: Loop, prepared: SegmentConstants, state: LoopState, signals: Signals, now: Array
) -> tuple[Array, Any]:
    """Return the force command F_c [N] and the compensator's next state (stage 2)."""
    force, controller = loop.compensator.step(prepared.controller, state.controller, signals, now)
    if loop.reads_always:
        force = jnp.where(signals.age == 0, 0, force)
    return force, controller


def integrate(loop: Loop, rig: RigConstants, state: LoopState, force: Array) -> ModelState:
    """Integrate M x_d'' = -F_c over one control period, with F_c = `force` [N] (stage 3)."""
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
) -> ActuationResult:
    """Send the position command through limits, latency, hold and motion simulator (stage 4)."""
    command, controller = loop.compensator.position_command(gains, controller, *model)
    command, step, wanted = _apply_limits(rig, state.plant, command)
    commands = (command, *state.plant.commands)
    end = commands[loop.latency]
    start = commands[loop.latency + 1] if loop.hold == "linear" else end
    rows, simulator = rig.propagation, state.plant.state
    course = IntervalInputs(simulator, start, end, rig.scenario.contact_plane) if loop.has_cells else None
    interval = _interval_motion(rows, simulator, start, end, rig.scenario.contact_plane)._replace(
        interval_inputs=course
    )
    under_way = state.sensed.rings.interval
    if under_way is not None:
        under_way = write_samples(under_way, now, interval)
        interval = _current_interval(rig, under_way, now, now - state.onset_tick)
    simulator = advance_state(rows.transition, simulator, start, end)
    return ActuationResult(
        plant=PlantState(commands[: loop.latency + 1], step, simulator, wanted),
        controller=controller,
        position=read_measured_position(rows, state.plant.state, start, end),
        interval=interval,
        under_way=under_way,
    )


def compute_contact(
    loop: Loop, rig: RigConstants, state: LoopState, interval: SamplingInterval
) -> IntervalContact:
    """Return the real contact during the sampling interval that takes place now (stage 5)."""
    if rig.cells is not None:
        return _compute_contact_in_cells(loop, rig, state, interval)
    scenario, period = rig.scenario, rig.constants.control_period
    clearance = scenario.clearance if loop.is_two_sided else None
    surfaces = Surfaces(loop.law, state.parameters, state.law, clearance)
    until = rig.delays.force.fraction * period
    if loop.law.remembers:
        loaded = surfaces.after(interval.start, interval.sample, until)
        force, _ = loaded.force(interval.sample)
        law = loaded.after(interval.sample, interval.end, period - until).state
    else:
        force, law = surfaces.force(interval.sample)
    last, lagged, reading = state.sensed.last, state.sensed.lagged, None
    if loop.is_two_sided or loop.energies:
        last = surfaces.sample(interval.sample, force)
    if loop.has_lag:
        time_constant = scenario.force_sensor.time_constant
        reading, lagged = apply_sensor_lag(surfaces, lagged, interval, until, period, time_constant)
    works = peak = None
    if loop.energies and loop.discontinuity_order == 0:
        works = compute_work_between(state.sensed.last, last)
    elif loop.energies:
        works = compute_work_along(surfaces, interval.start, interval.end, period)
    if loop.has_corners:
        peak = largest_force(surfaces, interval.start, interval.end, period)
    return IntervalContact(PlantSignals(force, works, peak, None), reading, lagged, last, None, law)


def _compute_contact_in_cells(
    loop: Loop, rig: RigConstants, state: LoopState, interval: SamplingInterval
) -> IntervalContact:
    """Return the real contact along the exact motion between samples (stage 5)."""
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
    )
    surfaces = Surfaces(loop.law, state.parameters, result.at_sample, clearance)
    force, _ = surfaces.force(interval.sample)
    last, works = state.sensed.last, result.works if loop.energies else None
    if loop.is_two_sided or loop.energies:
        last = surfaces.sample(interval.sample, force)
    if loop.energies and loop.discontinuity_order == 0:
        before = state.sensed.last.position(clearance)
        works = compute_jump_work(touch, state.law, before, interval.sample.position)
    reading = None
    if loop.has_lag:
        # Cells cannot resolve the zero lag of a lane in a batch whose other lanes have one.
        lag = scenario.force_sensor.time_constant
        reading = jnp.where(lag > MIN_LAG * period, result.reading, force)
    before, after = result.touched
    assert state.sensed.touched is not None
    signals = PlantSignals(force, works, result.peak, state.sensed.touched + before)
    return IntervalContact(signals, reading, result.lagged, last, after, result.at_end)


def update_state(
    state: LoopState,
    now: Array,
    before: PlantSignals,
    model: ModelState,
    actuated: ActuationResult,
    contact: IntervalContact,
) -> LoopState:
    """Return the state after the tick.

    The contact is written to the delay lines, after `before` was read from them.
    """
    plant_signals = jax.tree.map(depend_on, contact.plant_signals, before)
    samples = Rings(plant_signals, contact.reading, actuated.position, None)
    rings = write_samples(state.sensed.rings._replace(interval=None), now, samples)
    return state._replace(
        position=model.position,
        velocity=model.velocity,
        plant=actuated.plant,
        sensed=state.sensed._replace(
            rings=rings._replace(interval=actuated.under_way),
            last=contact.last,
            touched=contact.touched,
            lagged=contact.lagged,
        ),
        law=contact.law,
        controller=actuated.controller,
    )


def _delayed_sample(ring, now, age, intervals):
    """Return a sample `intervals` before the newest one; before the run there was no force."""
    return look_back(ring, now - 1, intervals, age > intervals)


def _delayed_position(rig, state, now, age):
    """Return the delayed position [m], from uniform motion before the run; NaN if unused."""
    ring, intervals = state.sensed.rings.position, rig.delays.position.intervals
    if ring is None:
        return jnp.full_like(state.position, jnp.nan)
    stride = rig.constants.control_period * state.onset_velocity
    before = state.sensed.first_position + (age - intervals).astype(stride.dtype) * stride
    return look_back(ring, now - 1, intervals, age > intervals, before)


def _apply_limits(rig, plant, command):
    """Return the limited command, its step [m], and the command before limits (None without limits)."""
    if plant.wanted is None:
        return command, plant.step, None
    simulator = rig.scenario.simulator
    limited, step = limit_command(
        command, plant.wanted, plant.commands[0], plant.step, rig.constants.control_period,
        simulator.velocity_limit, simulator.acceleration_limit,
    )  # fmt: skip
    return limited, step, command


def _interval_motion(rows, state, start, end, plane):
    """Return the mechanism's motion over the current interval, relative to the surface at `plane` [m]."""

    def motion(position, velocity):
        return MotionSample(
            apply_row(position, state, start, end) - plane, apply_row(velocity, state, start, end)
        )

    sample = motion(rows.position, rows.velocity)
    if rows.start is None:
        return SamplingInterval(sample, None, None, None)
    return SamplingInterval(sample, motion(*rows.start), motion(*rows.end), None)


def _current_interval(rig, under_way, now, age):
    """Return the interval that takes place now.

    Before the run it is at rest at the surface, without force.
    """
    intervals = rig.delays.contact
    return jax.tree.map(lambda ring: look_back(ring, now, intervals, age >= intervals), under_way)
