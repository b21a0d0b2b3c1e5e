"""Rollout of a batch of scenarios through the loop, from the first approach until the last contact is over.

Ticks run in short segments ("stretches"). Between segments, finished contacts are written to the metrics, the
next ones begin, and uneventful free flight is skipped. The program ends with its slowest lane; there is no
fixed horizon. Forward-mode derivatives pass through to every array leaf.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.cells import IntervalInputs
from jaxhil.simulation.contact_force import MotionSample, PlantSignals, SamplingInterval, no_contact
from jaxhil.simulation.free_flight import advance_to_surface, begin_approach
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.loop_state import LoopState, PlantState, Rings, SensorState
from jaxhil.simulation.metrics import OK, Metrics, determine_status, empty_metrics, store_metrics
from jaxhil.simulation.probe import initial_first_contact
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.sensors import SensorNoise, draw_noise
from jaxhil.simulation.tick import RunState, SegmentConstants, Tick, tick
from jaxhil.simulation.watch import COMMAND_DECAY_RATIO, build_end_conditions, fresh_watch


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Metrics:
    """Return the metrics (slots, *batch) of every contact of every lane.

    `gains` are scalars or of the batch shape. Use lanes for several gains, not `jax.vmap`, which would give
    each lane its own loop condition and ring pointer.
    """
    rig = build_rig_constants(loop, scenario, measured=loop.compensator.reads_position)
    return run_contacts(loop, gains, rig)


def run_contacts(loop: Loop, gains: Gains, rig: RigConstants) -> Metrics:
    """Return the metrics as `rollout` does, with constants computed before, for many gains."""
    return run_until_done(loop, gains, rig).metrics


def run_until_done(loop: Loop, gains: Gains, rig: RigConstants) -> RunState:
    """Return the state after all lanes are done."""

    def body(run):
        run, _ = run_segment(loop, rig, gains, run, record=False)
        if loop.is_two_sided:
            return begin_next_contacts(loop, rig, gains, run)
        # Most segments end no contact, since lanes of a tile end theirs at about the same time. The rings,
        # which `begin_next_contacts` does not change, stay outside the branch and are not copied.
        rings = run.state.sensed.rings
        light = run._replace(state=run.state._replace(sensed=run.state.sensed._replace(rings=None)))
        light = lax.cond(
            jnp.any(_finished_lanes(rig, run)),
            lambda run: begin_next_contacts(loop, rig, gains, run),
            lambda run: run,
            light,
        )
        return light._replace(state=light.state._replace(sensed=light.state.sensed._replace(rings=rings)))

    run = start_rollout(loop, rig, gains)
    return lax.while_loop(lambda run: jnp.any(run.active), body, run)


def segment_length(loop: Loop) -> int:
    """Return the ticks per segment: 1 between two surfaces, where the next contact may begin at once."""
    return 1 if loop.is_two_sided else 16


def start_rollout(loop: Loop, rig: RigConstants, gains: Gains, skip_flight: bool = True) -> RunState:
    """Return all lanes on their first approach, or at its end if nothing happens on it."""
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
            (zeros,) * (loop.latency + 1), zeros, (zeros,) * order, zeros if loop.has_limits else None
        ),
        sensed=SensorState(
            rings=_build_rings(loop, ring, measured, order),
            last=no_contact(like),
            touched=zeros if loop.has_cells else None,
            lagged=zeros,
            first_position=zeros if measured else None,
        ),
        law=loop.law.init(zeros),
        controller=loop.compensator.init(gains, rig.constants, loop.controller_ring),
        parameters=_select_entry(scenario.contact, index),
        onset_velocity=zeros,
        onset_tick=index,
        first_contact=initial_first_contact(zeros) if loop.probed else None,
    )
    # Rings are read up to one ring back: with this first tick no index is negative.
    tick = jnp.array(loop.first_tick, jnp.int32)
    phase = _select_entry(scenario.phase, _select_slot(rig, index))
    state, skipped = begin_approach(loop, rig, gains, state, phase, like, tick, skip_flight)
    slots = scenario.phase.shape[0]
    return RunState(
        state=state,
        watch=fresh_watch(loop, like),
        metrics=empty_metrics(loop, slots, like),
        index=index,
        active=scenario.contacts > 0,
        tick=tick,
        skipped=skipped,
    )


def run_segment(
    loop: Loop, rig: RigConstants, gains: Gains, run: RunState, record: bool
) -> tuple[RunState, Tick | None]:
    """Run one segment of ticks; `record` returns the ticks too."""
    prepared = prepare_segment(loop, rig, gains, run)

    def body(carry, noise):
        now, seen = tick(loop, rig, prepared, _replace_changing_parts(run, carry), noise)
        return _changing_parts(now), seen if record else None

    length = segment_length(loop)
    carry, seen = lax.scan(
        body, _changing_parts(run), draw_segment_noise(loop, rig, run, length), length=length
    )
    return _replace_changing_parts(run, carry), seen


def prepare_segment(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> SegmentConstants:
    """Return the values that the ticks of a segment share."""
    return SegmentConstants(
        gains=gains,
        rules=build_end_conditions(rig.scenario),
        controller=loop.compensator.prepare(gains, rig.constants),
        probe=_select_entry(rig.scenario.probe, _select_slot(rig, run.index)) if loop.probed else None,
    )


def draw_segment_noise(loop: Loop, rig: RigConstants, run: RunState, ticks: int) -> SensorNoise:
    """Return the sensors' noise, (ticks, *batch), of the next ticks of a segment."""
    ahead = jnp.arange(ticks, dtype=jnp.int32).reshape(-1, *[1] * run.index.ndim)
    age = run.tick + ahead - run.state.onset_tick[None]
    return draw_noise(loop.has_force_noise, loop.has_position_noise, rig.scenario, run.index, age)


def begin_next_contacts(
    loop: Loop, rig: RigConstants, gains: Gains, run: RunState, skip_flight: bool = True
) -> RunState:
    """Write finished contacts to the metrics, begin the next ones, and skip free flight."""
    watch, state, scenario = run.watch, run.state, rig.scenario
    status = determine_status(scenario, watch, run.tick - state.onset_tick)
    over = _finished_lanes(rig, run)
    ticks = run.tick - loop.first_tick + run.skipped
    law = loop.compensator
    delay = law.force_delay(gains, state.controller) if law.estimates_delay else None
    metrics = store_metrics(scenario, run.metrics, watch, run.index, over, status, ticks, delay)
    index = run.index + over.astype(jnp.int32)
    ends = (status != OK) | (index >= scenario.contacts)
    if loop.has_limits and not loop.is_two_sided:
        # A run cannot begin with a motion that the drives cannot follow.
        ends = ends | (watch.rebound > scenario.simulator.velocity_limit)
    active = run.active & ~(over & ends)
    blank = fresh_watch(loop, watch.approach)
    entry = _select_entry(scenario.contact, _select_slot(rig, index))
    if watch.command is not None:
        left = jnp.maximum(COMMAND_DECAY_RATIO * watch.peak_command, watch.command)
        # A force that acts already begins the next contact at once; it approaches at the rebound's speed.
        unchanged = {
            "approach": watch.rebound,
            "quiet": watch.quiet,
            "recent": watch.recent,
            "command": watch.command,
        }
        watch = _select_lanes(over, blank._replace(left=left, **unchanged), watch)
        # A damped contact may end during penetration; its law's parameters apply until the mechanism is free.
        free = state.sensed.last.distance <= 0
        state = state._replace(parameters=_select_lanes(free, entry, state.parameters))
        if state.first_contact is not None:
            state = state._replace(
                first_contact=_select_lanes(over, initial_first_contact(watch.approach), state.first_contact)
            )
        if skip_flight:
            arrived, skipped = advance_to_surface(loop, rig, gains, state, watch, watch.command, run.tick)
            state = _restart(loop, gains, state, arrived, skipped, jnp.zeros_like(skipped))
    else:
        state = state._replace(parameters=_select_lanes(over, entry, state.parameters))
        phase = _select_entry(scenario.phase, _select_slot(rig, index))
        entered, skipped = begin_approach(
            loop, rig, gains, state, phase, watch.rebound, run.tick, skip_flight
        )
        run = run._replace(skipped=run.skipped + jnp.where(over, skipped, 0))
        state = _restart(loop, gains, state, entered, over, over)
        watch = _select_lanes(over, blank, watch)
    return run._replace(state=state, watch=watch, metrics=metrics, index=index, active=active)


def _changing_parts(run):
    """Return the parts of the state that change from tick to tick."""
    return run.state, run.watch, run.tick


def _replace_changing_parts(run, evolving):
    """Return the state with these parts replaced."""
    state, watch, now = evolving
    return run._replace(state=state, watch=watch, tick=now)


def _build_rings(loop, ring, measured, order):
    """Return empty delay lines of the signals that the loop has."""
    interval = None
    if loop.is_two_sided:
        motion = MotionSample(ring, ring)
        ends = motion if loop.follows_intervals and not loop.has_cells else None
        course = IntervalInputs((ring,) * order, ring, ring, ring) if loop.has_cells else None
        interval = SamplingInterval(motion, ends, ends, course)
    plant_signals = PlantSignals(
        force=ring,
        works=(ring, ring) if loop.energies else None,
        peak=ring if loop.has_corners or loop.has_cells else None,
        touched=ring if loop.has_cells else None,
    )
    reading = ring if loop.has_lag else None
    return Rings(plant_signals, reading, ring if measured else None, interval)


def _finished_lanes(rig, run):
    """Return the lanes whose contact is over or has failed."""
    status = determine_status(rig.scenario, run.watch, run.tick - run.state.onset_tick)
    return (run.watch.over | (status != OK)) & run.active


def _restart(loop, gains, state, entered, begins, fresh):
    """Replace the state by the entered run where it `begins`; rings and the law's parameters stay."""
    sensed_at_entry = state.sensed._replace(
        last=entered.sensed.last,
        touched=entered.sensed.touched,
        lagged=entered.sensed.lagged,
        first_position=entered.sensed.first_position,
    )
    chosen = _select_lanes(
        begins,
        entered._replace(sensed=None, controller=None, parameters=None),
        state._replace(sensed=None, controller=None, parameters=None),
    )
    sensed = sensed_at_entry._replace(
        last=_select_lanes(begins, sensed_at_entry.last, state.sensed.last),
        touched=_select_lanes(begins, sensed_at_entry.touched, state.sensed.touched),
        lagged=jnp.where(begins, sensed_at_entry.lagged, state.sensed.lagged),
        first_position=_select_lanes(begins, sensed_at_entry.first_position, state.sensed.first_position),
    )
    return chosen._replace(
        sensed=sensed,
        controller=loop.compensator.restart(gains, state.controller, begins, fresh),
        parameters=state.parameters,
    )


def _select_slot(rig, index):
    """Return the slot of a contact; the last slot for contacts beyond the last one."""
    return jnp.minimum(index, rig.scenario.phase.shape[0] - 1)


def _select_entry(table, index):
    """Return entry `index` (per lane) of the leading axis of every leaf."""

    def pick(leaf):
        indices = jnp.broadcast_to(index, leaf.shape[1:])[None]
        return jnp.take_along_axis(leaf, indices, axis=0, mode="promise_in_bounds")[0]

    return jax.tree.map(pick, table)


def _select_lanes(condition, when_true, when_false):
    """Select leaf by leaf; the condition is of the batch shape."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), when_true, when_false)
