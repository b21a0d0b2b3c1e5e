"""Rollout: a batch of scenarios through the loop, from the first approach until the last contact is over.

Ticks run in short stretches; between stretches, contacts that are over are entered into the metrics, the next
ones begin, and free flight is skipped where nothing happens in it. The program ends with its slowest lane:
nothing is computed for a fixed horizon. Forward-mode derivatives pass through to every array leaf.
"""

import jax
import jax.numpy as jnp
from jax import lax

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.cells import Course
from jaxhil.simulation.contact_force import Motion, PlantSignals, SamplingInterval, no_contact
from jaxhil.simulation.free_flight import arrival, begin_approach
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.loop_state import LoopState, Plant, Rings, Sensed
from jaxhil.simulation.metrics import OK, Metrics, collect, empty_metrics, judge
from jaxhil.simulation.probe import before_contact
from jaxhil.simulation.scenario import Scenario
from jaxhil.simulation.sensors import Noise, draw_noise
from jaxhil.simulation.tick import Prepared, RunState, Tick, tick
from jaxhil.simulation.watch import FADED, build_rules, fresh_watch


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Metrics:
    """Metrics (slots, *batch) of every contact of every lane: `build_rig_constants`, then `run_contacts`.

    `gains` are scalars or of the batch shape: many gains at once are many lanes, not a `jax.vmap`, under
    which the loop's condition and the rings' pointer would be the lanes' own.
    """
    rig = build_rig_constants(loop, scenario, measured=loop.compensator.reads_position)
    return run_contacts(loop, gains, rig)


def run_contacts(loop: Loop, gains: Gains, rig: RigConstants) -> Metrics:
    """`rollout` on a rig built before, for when many gains are tried on it."""
    return run_to_its_end(loop, gains, rig).metrics


def run_to_its_end(loop: Loop, gains: Gains, rig: RigConstants) -> RunState:
    """The run when all its lanes are done."""

    def body(run):
        run, _ = stretch(loop, rig, gains, run, record=False)
        if loop.is_two_sided:
            return turn_over(loop, rig, gains, run)
        # Most stretches end no contact: lanes of a tile end theirs at about the same time. The rings, which
        # a turn-over leaves alone, stay outside the branch, where they need not be copied.
        rings = run.state.sensed.rings
        light = run._replace(state=run.state._replace(sensed=run.state.sensed._replace(rings=None)))
        light = lax.cond(
            jnp.any(_pending(rig, run)), lambda run: turn_over(loop, rig, gains, run), lambda run: run, light
        )
        return light._replace(state=light.state._replace(sensed=light.state.sensed._replace(rings=rings)))

    run = start(loop, rig, gains)
    return lax.while_loop(lambda run: jnp.any(run.active), body, run)


def stretch_length(loop: Loop) -> int:
    """Ticks between turn-overs. Between two surfaces the next contact may begin at once."""
    return 1 if loop.is_two_sided else 16


def start(loop: Loop, rig: RigConstants, gains: Gains, skip_flight: bool = True) -> RunState:
    """All lanes on their first approach, or at its end where nothing happens on it."""
    scenario, like = rig.scenario, rig.scenario.velocity
    zeros = jnp.zeros_like(like)
    index = jnp.zeros(like.shape, jnp.int32)
    ring = jnp.zeros((loop.ring, *like.shape), like.dtype)
    order = rig.propagation.steady_command.shape[0]
    measured = rig.propagation.measured_position is not None
    state = LoopState(
        position=zeros,
        velocity=zeros,
        plant=Plant(
            (zeros,) * (loop.latency + 1), zeros, (zeros,) * order, zeros if loop.has_limits else None
        ),
        sensed=Sensed(
            rings=_rings(loop, ring, measured, order),
            last=no_contact(like),
            touched=zeros if loop.has_cells else None,
            lagged=zeros,
            first_position=zeros if measured else None,
        ),
        law=loop.law.init(zeros),
        controller=loop.compensator.init(gains, rig.constants, loop.controller_ring),
        parameters=_entry(scenario.contact, index),
        entry_velocity=zeros,
        entry_tick=index,
        first_contact=before_contact(zeros) if loop.probed else None,
    )
    # Rings are read up to one ring behind: start there, so that no index is negative.
    tick = jnp.array(loop.first_tick, jnp.int32)
    phase = _entry(scenario.phase, _slot(rig, index))
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


def stretch(
    loop: Loop, rig: RigConstants, gains: Gains, run: RunState, record: bool
) -> tuple[RunState, Tick | None]:
    """A few ticks of the loop."""
    prepared = prepare(loop, rig, gains, run)

    def body(carry, noise):
        now, seen = tick(loop, rig, prepared, _resumed(run, carry), noise)
        return _evolving(now), seen if record else None

    length = stretch_length(loop)
    carry, seen = lax.scan(body, _evolving(run), noise_ahead(loop, rig, run, length), length=length)
    return _resumed(run, carry), seen


def prepare(loop: Loop, rig: RigConstants, gains: Gains, run: RunState) -> Prepared:
    """What the ticks of a stretch share."""
    return Prepared(
        gains=gains,
        rules=build_rules(rig.scenario),
        controller=loop.compensator.prepare(gains, rig.constants),
        probe=_entry(rig.scenario.probe, _slot(rig, run.index)) if loop.probed else None,
    )


def noise_ahead(loop: Loop, rig: RigConstants, run: RunState, ticks: int) -> Noise:
    """The sensors' noise, (ticks, *batch), at this tick and those that follow within a stretch."""
    ahead = jnp.arange(ticks, dtype=jnp.int32).reshape(-1, *[1] * run.index.ndim)
    age = run.tick + ahead - run.state.entry_tick[None]
    return draw_noise(loop.has_force_noise, loop.has_position_noise, rig.scenario, run.index, age)


def turn_over(
    loop: Loop, rig: RigConstants, gains: Gains, run: RunState, skip_flight: bool = True
) -> RunState:
    """Enter contacts that are over, begin the next, skip free flight."""
    watch, state, scenario = run.watch, run.state, rig.scenario
    status = judge(scenario, watch, run.tick - state.entry_tick)
    over = _pending(rig, run)
    ticks = run.tick - loop.first_tick + run.skipped
    law = loop.compensator
    delay = law.force_delay(gains, state.controller) if law.estimates_delay else None
    metrics = collect(scenario, run.metrics, watch, run.index, over, status, ticks, delay)
    index = run.index + over.astype(jnp.int32)
    ends = (status != OK) | (index >= scenario.contacts)
    if loop.has_limits and not loop.is_two_sided:
        # No run begins in a uniform motion that the drives cannot follow.
        ends = ends | (watch.rebound > scenario.simulator.velocity_limit)
    active = run.active & ~(over & ends)
    blank = fresh_watch(loop, watch.approach)
    entry = _entry(scenario.contact, _slot(rig, index))
    if watch.command is not None:
        left = jnp.maximum(FADED * watch.peak_command, watch.command)
        # A force before the turn-over begins the next contact at once, at the speed of the rebound.
        kept = {
            "approach": watch.rebound,
            "quiet": watch.quiet,
            "recent": watch.recent,
            "command": watch.command,
        }
        watch = _choose(over, blank._replace(left=left, **kept), watch)
        # A damped contact is over while the mechanism is still pressed in: its law holds until it is free.
        free = state.sensed.last.distance <= 0
        state = state._replace(parameters=_choose(free, entry, state.parameters))
        if state.first_contact is not None:
            state = state._replace(
                first_contact=_choose(over, before_contact(watch.approach), state.first_contact)
            )
        if skip_flight:
            arrived, skipped = arrival(loop, rig, gains, state, watch, watch.command, run.tick)
            state = _restart(loop, gains, state, arrived, skipped, jnp.zeros_like(skipped))
    else:
        state = state._replace(parameters=_choose(over, entry, state.parameters))
        phase = _entry(scenario.phase, _slot(rig, index))
        entered, skipped = begin_approach(
            loop, rig, gains, state, phase, watch.rebound, run.tick, skip_flight
        )
        run = run._replace(skipped=run.skipped + jnp.where(over, skipped, 0))
        state = _restart(loop, gains, state, entered, over, over)
        watch = _choose(over, blank, watch)
    return run._replace(state=state, watch=watch, metrics=metrics, index=index, active=active)


def _evolving(run):
    """What changes from tick to tick."""
    return run.state, run.watch, run.tick


def _resumed(run, evolving):
    state, watch, now = evolving
    return run._replace(state=state, watch=watch, tick=now)


def _rings(loop, ring, measured, order):
    """Empty delay lines of what the loop has."""
    interval = None
    if loop.is_two_sided:
        motion = Motion(ring, ring)
        ends = motion if loop.follows_intervals and not loop.has_cells else None
        course = Course((ring,) * order, ring, ring, ring) if loop.has_cells else None
        interval = SamplingInterval(motion, ends, ends, course)
    plant_signals = PlantSignals(
        force=ring,
        works=(ring, ring) if loop.energies else None,
        peak=ring if loop.has_corners or loop.has_cells else None,
        touched=ring if loop.has_cells else None,
    )
    reading = ring if loop.has_lag else None
    return Rings(plant_signals, reading, ring if measured else None, interval)


def _pending(rig, run):
    """Lanes whose contact is over, or has failed."""
    status = judge(rig.scenario, run.watch, run.tick - run.state.entry_tick)
    return (run.watch.over | (status != OK)) & run.active


def _restart(loop, gains, state, entered, begins, fresh):
    """Take over the entered run on the lanes where it `begins`; rings and the law's parameters stay."""
    rings = state.sensed._replace(
        last=entered.sensed.last,
        touched=entered.sensed.touched,
        lagged=entered.sensed.lagged,
        first_position=entered.sensed.first_position,
    )
    chosen = _choose(
        begins,
        entered._replace(sensed=None, controller=None, parameters=None),
        state._replace(sensed=None, controller=None, parameters=None),
    )
    sensed = rings._replace(
        last=_choose(begins, rings.last, state.sensed.last),
        touched=_choose(begins, rings.touched, state.sensed.touched),
        lagged=jnp.where(begins, rings.lagged, state.sensed.lagged),
        first_position=_choose(begins, rings.first_position, state.sensed.first_position),
    )
    return chosen._replace(
        sensed=sensed,
        controller=loop.compensator.restart(gains, state.controller, begins, fresh),
        parameters=state.parameters,
    )


def _slot(rig, index):
    """The slot of a contact; of one beyond them all, the last."""
    return jnp.minimum(index, rig.scenario.phase.shape[0] - 1)


def _entry(table, index):
    """Entry `index` (per lane) of the leading axis of every leaf."""

    def pick(leaf):
        indices = jnp.broadcast_to(index, leaf.shape[1:])[None]
        return jnp.take_along_axis(leaf, indices, axis=0, mode="promise_in_bounds")[0]

    return jax.tree.map(pick, table)


def _choose(condition, when_true, when_false):
    """Leaf by leaf `where`; the condition is of the batch shape."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), when_true, when_false)
