"""Rollout: simulation of a batch of scenarios, from the first approach to the end of the last contact.

The simulation runs segments of a few ticks. Between two segments, the metrics of finished contacts are
stored, the next contacts begin, and free flight without events is skipped. The simulation ends when the
slowest scenario has ended; there is no fixed horizon. Results are differentiable in forward mode with respect
to every input array.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxhil.lanes import select_lanes
from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.cells import IntervalInputs
from jaxhil.simulation.contact_force import MotionSample, PlantSignals, SamplingInterval, no_contact
from jaxhil.simulation.contact_tracking import COMMAND_DECAY_RATIO, build_end_conditions, start_tracking
from jaxhil.simulation.free_flight import advance_to_surface, begin_approach
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.loop_state import LoopState, PlantState, Rings, SensorState
from jaxhil.simulation.metrics import OK, Metrics, determine_status, empty_metrics, store_metrics
from jaxhil.simulation.probe import initial_first_contact
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.sensors import SensorNoise, draw_noise
from jaxhil.simulation.tick import RunState, SegmentConstants, Tick, tick
from jaxhil.simulation.timing import TimingDraws, draw_timing, no_held_values


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Metrics:
    """Simulate all contacts of all scenarios and return their metrics, (contacts, *batch).

    To compare several gains, repeat the scenarios in the batch. Do not use `jax.vmap`: the loop over ticks
    and the positions in the delay lines would no longer be common to all lanes, which is slower.

    Args:
        loop: Loop that runs the scenarios.
        gains: Gains by name [SI units], scalars or arrays of the batch shape.
        scenario: Scenarios to be simulated.
    """
    rig = build_rig_constants(loop, scenario, measured=loop.compensator.reads_position)
    return run_contacts(loop, gains, rig)


def run_contacts(loop: Loop, gains: Gains, rig: RigConstants) -> Metrics:
    """Simulate all contacts as `rollout` does, with the rig's constants computed in advance."""
    return run_until_done(loop, gains, rig).metrics


def run_until_done(loop: Loop, gains: Gains, rig: RigConstants) -> RunState:
    """Simulate until the last contact of every lane has ended, and return the final state."""

    def body(run):
        run, _ = run_segment(loop, rig, gains, run, record=False)
        if loop.is_two_sided:
            return begin_next_contacts(loop, rig, gains, run)
        # All contacts end at about the same time: in most segments no contact ends, and the call of
        # `begin_next_contacts` is skipped. This call does not change the delay lines. They stay outside the
        # branch and are therefore not copied.
        rings = run.state.sensed.rings
        run_without_rings = run._replace(
            state=run.state._replace(sensed=run.state.sensed._replace(rings=None))
        )
        run_without_rings = lax.cond(
            jnp.any(_finished_lanes(rig, run)),
            lambda run: begin_next_contacts(loop, rig, gains, run),
            lambda run: run,
            run_without_rings,
        )
        return run_without_rings._replace(
            state=run_without_rings.state._replace(
                sensed=run_without_rings.state.sensed._replace(rings=rings)
            )
        )

    run = start_rollout(loop, rig, gains)
    return lax.while_loop(lambda run: jnp.any(run.active), body, run)


def segment_length(loop: Loop) -> int:
    """Return the number of ticks in a segment (the ticks between two checks for ended contacts).

    The number is 1 with two surfaces, because the next contact may begin in the next tick.
    """
    return 1 if loop.is_two_sided else 16


def start_rollout(loop: Loop, rig: RigConstants, gains: Gains, skip_flight: bool = True) -> RunState:
    """Return the state at the start of the first approach; `skip_flight` omits uneventful free flight."""
    scenario, like = rig.scenario, rig.scenario.velocity
    zeros = jnp.zeros_like(like)
    index = jnp.zeros(like.shape, jnp.int32)
    ring = jnp.zeros((loop.ring, *like.shape), like.dtype)
    order = rig.propagation.steady_command.shape[0]
    measured = rig.propagation.measured_position is not None
    state = LoopState(
        position=zeros,
        velocity=zeros,
        plant=PlantState(
            (zeros,) * (loop.latency + 1),
            zeros,
            (zeros,) * order,
            zeros if loop.has_limits else None,
            None if rig.propagation.window is None else zeros,
        ),
        sensed=SensorState(
            rings=_build_rings(loop, rig, ring, measured, order),
            last=no_contact(like),
            contact_time=zeros if loop.has_cells else None,
            lagged=zeros,
            first_position=zeros if measured else None,
        ),
        law=loop.law.init(zeros),
        controller=loop.compensator.init(gains, rig.constants, loop.controller_ring),
        parameters=_select_entry(scenario.contact, index),
        onset_velocity=zeros,
        onset_tick=index,
        first_contact=initial_first_contact(zeros) if loop.probed else None,
        held=None if scenario.timing is None else no_held_values(zeros),
        bias_walk=None if scenario.force_sensor.bias_walk is None else zeros,
    )
    # Delay lines are read as far back as they are long. Ticks are counted from a number at which no index
    # is negative.
    tick = jnp.array(loop.first_tick, jnp.int32)
    phase = _select_entry(scenario.phase, _select_slot(rig, index))
    state, skipped = begin_approach(loop, rig, gains, state, phase, like, tick, skip_flight)
    slots = scenario.phase.shape[0]
    return RunState(
        state=state,
        tracker=start_tracking(loop, like),
        metrics=empty_metrics(loop, slots, like),
        index=index,
        active=scenario.contacts > 0,
        tick=tick,
        skipped=skipped,
    )


def run_segment(
    loop: Loop, rig: RigConstants, gains: Gains, run: RunState, record: bool
) -> tuple[RunState, Tick | None]:
    """Simulate one segment (a few ticks); return the new state and, with `record`, every tick's record."""
    prepared = prepare_segment(loop, rig, gains, run)

    def body(carry, noise):
        now, seen = tick(loop, rig, prepared, _replace_changing_parts(run, carry), *noise)
        return _changing_parts(now), seen if record else None

    length = segment_length(loop)
    carry, seen = lax.scan(
        body, _changing_parts(run), draw_segment_noise(loop, rig, run, length), length=length
    )
    return _replace_changing_parts(run, carry), seen


def prepare_segment(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> SegmentConstants:
    """Compute the values that stay constant during a segment (a few successive ticks)."""
    return SegmentConstants(
        gains=gains,
        rules=build_end_conditions(rig.scenario),
        controller=loop.compensator.prepare(gains, rig.constants),
        probe=_select_entry(rig.scenario.probe, _select_slot(rig, run.index)) if loop.probed else None,
    )


def draw_segment_noise(
    loop: Loop, rig: RigConstants, run: RunState, ticks: int
) -> tuple[SensorNoise, TimingDraws | None]:
    """Return the sensors' noise and the timing effects at the next `ticks` ticks, (ticks, *batch)."""
    ahead = jnp.arange(ticks, dtype=jnp.int32).reshape(-1, *[1] * run.index.ndim)
    age = run.tick + ahead - run.state.onset_tick[None]
    noise = draw_noise(loop.has_force_noise, loop.has_position_noise, rig.scenario, run.index, age)
    return noise, draw_timing(rig.scenario.timing, rig.scenario.key, run.index, age)


def begin_next_contacts(
    loop: Loop, rig: RigConstants, gains: Gains, run: RunState, skip_flight: bool = True
) -> RunState:
    """Store the metrics of finished contacts, begin the next contacts, and skip free flight."""
    tracker, state, scenario = run.tracker, run.state, rig.scenario
    status = determine_status(scenario, tracker, run.tick - state.onset_tick)
    has_ended = _finished_lanes(rig, run)
    ticks = run.tick - loop.first_tick + run.skipped
    law = loop.compensator
    delay = law.force_delay(gains, state.controller) if law.estimates_delay else None
    metrics = store_metrics(scenario, run.metrics, tracker, run.index, has_ended, status, ticks, delay)
    index = run.index + has_ended.astype(jnp.int32)
    ends = (status != OK) | (index >= scenario.contacts)
    if loop.has_limits and not loop.is_two_sided:
        # End a scenario whose drives cannot follow the rebound speed, with which the next run would begin.
        ends = ends | (tracker.rebound > scenario.simulator.velocity_limit)
    active = run.active & ~(has_ended & ends)
    blank = start_tracking(loop, tracker.approach)
    entry = _select_entry(scenario.contact, _select_slot(rig, index))
    if tracker.command is not None:
        remaining_command = jnp.maximum(COMMAND_DECAY_RATIO * tracker.peak_command, tracker.command)
        # If a force still acts, the next contact begins at once. Its approach speed is the rebound speed of
        # the contact that has just ended.
        unchanged = {
            "approach": tracker.rebound,
            "force_free_ticks": tracker.force_free_ticks,
            "recent_forces": tracker.recent_forces,
            "command": tracker.command,
        }
        tracker = select_lanes(
            has_ended, blank._replace(remaining_command=remaining_command, **unchanged), tracker
        )
        # A damped contact may end before the penetration does. The parameters of this contact apply until the
        # mechanism has left the surface.
        free = state.sensed.last.distance <= 0
        state = state._replace(parameters=select_lanes(free, entry, state.parameters))
        if state.first_contact is not None:
            state = state._replace(
                first_contact=select_lanes(
                    has_ended, initial_first_contact(tracker.approach), state.first_contact
                )
            )
        # A flight with a random walk of the bias is not uniform.
        if skip_flight and state.bias_walk is None:
            arrived, skipped = advance_to_surface(loop, rig, gains, state, tracker, tracker.command, run.tick)
            state = _restart(loop, gains, state, arrived, skipped, jnp.zeros_like(skipped))
    else:
        state = state._replace(parameters=select_lanes(has_ended, entry, state.parameters))
        phase = _select_entry(scenario.phase, _select_slot(rig, index))
        entered, skipped = begin_approach(
            loop, rig, gains, state, phase, tracker.rebound, run.tick, skip_flight
        )
        run = run._replace(skipped=run.skipped + jnp.where(has_ended, skipped, 0))
        state = _restart(loop, gains, state, entered, has_ended, has_ended)
        tracker = select_lanes(has_ended, blank, tracker)
    return run._replace(state=state, tracker=tracker, metrics=metrics, index=index, active=active)


def _changing_parts(run):
    """Return the parts of the simulation's state that change during the ticks of a segment."""
    return run.state, run.tracker, run.tick


def _replace_changing_parts(run, parts):
    """Return the state `run` with new `parts`, in the form that `_changing_parts` returns."""
    state, tracker, now = parts
    return run._replace(state=state, tracker=tracker, tick=now)


def _build_rings(loop, rig, ring, measured, order):
    """Return an initial delay line (`ring`, an array of zeros) for each signal that the loop uses."""
    interval = None
    if loop.is_two_sided:
        motion = MotionSample(ring, ring)
        ends = motion if loop.follows_intervals and not loop.has_cells else None
        inputs = IntervalInputs((ring,) * order, ring, ring, ring) if loop.has_cells else None
        interval = SamplingInterval(motion, ends, ends, inputs)
    plant_signals = PlantSignals(
        force=ring,
        work=(ring, ring) if loop.energies else None,
        peak=ring if loop.has_corners or loop.has_cells else None,
        contact_time=ring if loop.has_cells else None,
    )
    reading = ring if loop.has_lag else None
    position = ring if measured else None
    command = None if rig.propagation.window is None else ring
    inputs = None if rig.series is None else IntervalInputs((ring,) * order, ring, ring, None)
    return Rings(plant_signals, reading, position, interval, command, inputs)


def _finished_lanes(rig, run):
    """Return whether the current contact of each lane has ended, normally or with an error status."""
    status = determine_status(rig.scenario, run.tracker, run.tick - run.state.onset_tick)
    return (run.tracker.has_ended | (status != OK)) & run.active


def _restart(loop, gains, state, entered, begins, fresh):
    """Replace the state by `entered`, the state at a run's start, in the lanes in which a run `begins`.

    The delay lines and the parameters of the contact law do not change.
    """
    sensed_at_entry = state.sensed._replace(
        last=entered.sensed.last,
        contact_time=entered.sensed.contact_time,
        lagged=entered.sensed.lagged,
        first_position=entered.sensed.first_position,
    )
    chosen = select_lanes(
        begins,
        entered._replace(sensed=None, controller=None, parameters=None),
        state._replace(sensed=None, controller=None, parameters=None),
    )
    sensed = sensed_at_entry._replace(
        last=select_lanes(begins, sensed_at_entry.last, state.sensed.last),
        contact_time=select_lanes(begins, sensed_at_entry.contact_time, state.sensed.contact_time),
        lagged=select_lanes(begins, sensed_at_entry.lagged, state.sensed.lagged),
        first_position=select_lanes(begins, sensed_at_entry.first_position, state.sensed.first_position),
    )
    return chosen._replace(
        sensed=sensed,
        controller=loop.compensator.restart(gains, state.controller, begins, fresh),
        parameters=state.parameters,
    )


def _select_slot(rig, index):
    """Clip the index of a contact to the valid range of arrays with one entry per contact."""
    return jnp.minimum(index, rig.scenario.phase.shape[0] - 1)


def _select_entry(table, index):
    """Select one entry of the leading axis of every array; `index` has one value per lane."""

    def pick(leaf):
        indices = jnp.broadcast_to(index, leaf.shape[1:])[None]
        return jnp.take_along_axis(leaf, indices, axis=0, mode="promise_in_bounds")[0]

    return jax.tree.map(pick, table)
