"""Rollout: simulation of a batch of six-axis runs on the rig, until all evaluated episodes have ended.

An episode is a contact with all its touches (`jaxhil.sixdof.watch`). Before each episode, the ideal contact
from the same states is integrated. The ticks run in segments of `STRETCH` ticks. After each segment, the
program checks which runs have ended. The program ends when the longest run of the batch ends.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import select_lanes
from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.watch import DIVERGENCE_SPEED_RATIO
from jaxhil.sixdof.first_touch import Meeting
from jaxhil.sixdof.loop import Loop, Rig, RunState, begin, build_rig, tick
from jaxhil.sixdof.reference import Past, Reference, follow_contact, past_at
from jaxhil.sixdof.relative import States
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.space import Space
from jaxhil.sixdof.watch import (
    Beginning,
    Watch,
    fresh_watch,
    mass_share,
    quiet_ticks,
    quiet_time,
    relative_energy,
    watch_tick,
)

STRETCH = 16  # number of ticks in a segment, after which the end of the runs is checked
SLOW = 1e-3  # m/s; a slower approach counts as this speed in the test for divergence
MISS, REBOUNDED, CAPTURED, JAMMED, TIMEOUT, DIVERGED, NON_FINITE, REACH = range(8)
STATUS_NAMES = ("miss", "rebounded", "captured", "jammed", "timeout", "diverged", "non-finite", "reach")


class Episode(NamedTuple):
    """Results of episodes (contacts with all their touches) and their ideal contacts, (episodes, *batch)."""

    start: States  # states of the numerical model at the start of the episode
    end: States  # states of the numerical model at the end of the episode
    lasted: Float[Array, "episodes *batch"]  # time from start to end [s]
    meeting: Meeting  # first touch of the ideal contact from the same start
    # ideal contact up to the gap (period without a touch) in which the episode ends; else up to the run's end
    past: Past
    touches: Int[Array, "episodes *batch"]  # number of touches of the hardware's shapes
    duration: Float[Array, "episodes *batch"]  # time during which the hardware touches [s]
    peak_force: Float[Array, "episodes *batch"]  # peak force of the real contact [N]
    peak_command: Float[Array, "episodes *batch"]  # largest force on the numerical model [N]
    peak_moment: Float[Array, "episodes *batch"]  # largest moment about T's origin in the real contact [N m]
    penetration: Float[Array, "episodes *batch"]  # largest penetration, divided by the shapes' size [1]
    status: Int[Array, "episodes *batch"]  # index of `STATUS_NAMES`


class EpisodeProgress(NamedTuple):
    """State of a rollout: loop, current episode, and finished episodes."""

    run: RunState
    beginning: Beginning  # start of the current episode
    watch: Watch  # record of the current episode
    episodes: Episode  # results of the finished episodes
    index: Int[Array, "*batch"]  # index of the current or next episode
    active: Bool[Array, "*batch"]  # whether each run continues
    lasted: Int[Array, "*batch"]  # number of ticks of each run so far


class Outcome(NamedTuple):
    """Results of a rollout: episodes, and final states of the numerical model."""

    episodes: Episode
    final: States  # states of the numerical model at the end of each run
    final_time: Float[Array, "*batch"]  # duration of each run [s]


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
    """Simulate a batch of scenarios on the rig; each of the `gains` is a scalar or has the batch shape."""
    rig = build_rig(loop, gains, scenario)
    last = jnp.round(scenario.duration / rig.period).astype(jnp.int32)
    # With several episodes, the next episode must begin at the tick after the end of the last episode.
    stretch = STRETCH if loop.episodes == 1 else 1

    def one_tick(progress: EpisodeProgress, _) -> tuple[EpisodeProgress, None]:
        return _tick(loop, rig, last, progress), None

    def body(progress: EpisodeProgress) -> EpisodeProgress:
        after, _ = lax.scan(one_tick, progress, None, stretch)
        return _turn_over(loop, rig, last, after)

    reference = scenario.ideal_contact
    if reference is None:
        reference = compute_ideal_contact(scenario)
    start = _start(loop, rig, scenario.start, reference)
    ended = lax.while_loop(lambda progress: jnp.any(progress.active), body, start)
    time = ended.lasted.astype(rig.period.dtype) * rig.period
    return Outcome(ended.episodes, ended.run.states, time)


def compute_ideal_contact(scenario: Scenario) -> Reference:
    """Return the ideal contact from the start of a batch of scenarios; it does not depend on the gains."""
    period = scenario.control_period
    until = jnp.round(scenario.duration / period) * period
    space = Space(scenario.bodies, scenario.groups, scenario.latches)
    return follow_contact(space, scenario.start, quiet_time(scenario.sensor, period), until, period)


def _start(loop: Loop, rig: Rig, states: States, reference: Reference) -> EpisodeProgress:
    """Return the state of the rollout at the start of the runs."""
    none = jnp.zeros(rig.period.shape, jnp.int32)
    beginning = Beginning(states, none, relative_energy(rig, states), reference)
    watch = fresh_watch(rig, states, none)
    episode = _episode(rig, beginning, watch, none > 0, none, states)
    episodes: Any = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (loop.episodes, *leaf.shape)),
        episode._replace(status=none + MISS),
    )
    return EpisodeProgress(
        run=begin(loop, rig, states),
        beginning=beginning,
        watch=watch,
        episodes=episodes,
        index=none,
        active=none == 0,
        lasted=none,
    )


def _tick(loop: Loop, rig: Rig, last: Array, progress: EpisodeProgress) -> EpisodeProgress:
    """Simulate one tick. In lanes whose run has ended, the states of the bodies do not change."""
    run, watch = progress.run, progress.watch
    after, seen = tick(loop, rig, run)
    runs = progress.active & (progress.lasted < last) & ~watch.beyond
    lasted = progress.lasted + runs.astype(jnp.int32)
    watched = watch_tick(rig, progress.beginning, watch, seen, after.states, lasted)
    watched = select_lanes(runs & ~watch.over, watched, watch)
    beyond = watch.beyond | (runs & ~rig.kinematics.reaches(after.hardware.commands[0]))
    return progress._replace(
        run=after._replace(states=select_lanes(runs, after.states, run.states)),
        watch=watched._replace(beyond=beyond),
        lasted=lasted,
    )


def _episode(
    rig: Rig, beginning: Beginning, watch: Watch, over: Array, ticks: Array, states: States
) -> Episode:
    """Return the results of the current episode.

    In lanes where the episode is not `over`, it ends now, with the given `states` after `ticks` ticks.
    """
    period = rig.period
    lasted = (jnp.where(over, watch.end_tick, ticks) - beginning.tick).astype(period.dtype) * period
    return Episode(
        start=beginning.states,
        end=select_lanes(over, watch.end, states),
        lasted=lasted,
        meeting=beginning.reference.meeting,
        past=past_at(beginning.reference, lasted, over),
        touches=watch.touches,
        duration=watch.touched.astype(period.dtype) * period,
        peak_force=watch.force.largest,
        peak_command=watch.highest[0],
        peak_moment=watch.moment.largest,
        penetration=watch.penetration,
        status=jnp.where(over, REBOUNDED, MISS).astype(jnp.int32),
    )


def _turn_over(loop: Loop, rig: Rig, last: Array, progress: EpisodeProgress) -> EpisodeProgress:
    """Store the results of finished episodes, and begin the next episodes."""
    watch, run, beginning, age = progress.watch, progress.run, progress.beginning, progress.lasted
    over = watch.over & progress.active
    status = _failure(rig, beginning, watch, run.states)
    out = (age >= last) | (status != MISS)
    cut = jnp.where(watch.caught, CAPTURED, jnp.where(watch.quiet < quiet_ticks(rig), JAMMED, TIMEOUT))
    status = jnp.where(status != MISS, status, jnp.where(over, REBOUNDED, jnp.where(watch.begun, cut, MISS)))
    ended = progress.active & (over | out) & (status != MISS)
    episode = _episode(rig, beginning, watch, over, age, run.states)._replace(status=status)
    slot = jnp.arange(loop.episodes, dtype=jnp.int32).reshape(-1, *[1] * age.ndim)
    mask = (slot == progress.index[None]) & ended[None]
    episodes = jax.tree.map(lambda new, old: jnp.where(mask, new[None], old), episode, progress.episodes)
    index = progress.index + ended.astype(jnp.int32)
    active = progress.active & ~out
    if not loop.whole:
        active = active & (index < loop.episodes)
    progress = progress._replace(episodes=episodes, index=index, active=active)
    return progress if loop.episodes == 1 else _begin_next(rig, last, progress, over & active)


def _begin_next(rig: Rig, last: Array, progress: EpisodeProgress, begins: Array) -> EpisodeProgress:
    """Begin the next episode in the lanes where `begins` is true."""
    states, age, watch = progress.run.states, progress.lasted, progress.watch

    def follow(beginning: Beginning) -> Beginning:
        space = Space(rig.bodies, rig.groups, rig.latches)
        until = jnp.where(begins, last - age, 0).astype(rig.period.dtype) * rig.period
        reference = follow_contact(space, states, quiet_time(rig.sensor, rig.period), until, rig.period)
        following = Beginning(states, age, relative_energy(rig, states), reference)
        return select_lanes(begins, following, beginning)

    beginning = lax.cond(jnp.any(begins), follow, lambda beginning: beginning, progress.beginning)
    fresh = fresh_watch(rig, states, age)._replace(touching=watch.touching)
    return progress._replace(beginning=beginning, watch=select_lanes(begins, fresh, watch))


def _failure(rig: Rig, beginning: Beginning, watch: Watch, states: States) -> Array:
    """Return the status of runs that must end: DIVERGED, NON_FINITE or REACH; MISS for the other runs.

    REACH means that an axis was commanded beyond its workspace.
    """
    energy = relative_energy(rig, states)
    least = jnp.maximum(beginning.energy, SLOW**2 / mass_share(rig))
    status = jnp.where(energy > DIVERGENCE_SPEED_RATIO**2 * least, DIVERGED, MISS)
    status = jnp.where(watch.beyond, REACH, status)
    return jnp.where(jnp.isfinite(energy), status, NON_FINITE).astype(jnp.int32)
