"""Rollout: simulation of a batch of six-axis runs on the rig, until all evaluated episodes have ended.

An episode is a contact with all its touches (`jaxhil.sixdof.episode_tracking`). Before each episode, the
ideal contact from the same states is integrated. The ticks run in segments of `SEGMENT_TICKS` ticks. After
each segment, the program checks which runs have ended. The program ends when the longest run of the batch
ends.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import select_lanes
from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation.contact_tracking import DIVERGENCE_SPEED_RATIO
from jaxhil.sixdof.episode_tracking import (
    EpisodeStart,
    EpisodeTracker,
    mass_share,
    relative_energy,
    required_pause,
    required_pause_ticks,
    start_tracking,
    track_tick,
)
from jaxhil.sixdof.first_touch import FirstTouch
from jaxhil.sixdof.ideal_contact import (
    IdealContactRecord,
    IdealContactSummary,
    integrate_ideal_contact,
    summary_at,
)
from jaxhil.sixdof.ideal_contact_integration import IdealContactModel
from jaxhil.sixdof.loop import begin, build_rig_constants, tick
from jaxhil.sixdof.loop_state import Loop, RigConstants, RunState, Tick
from jaxhil.sixdof.relative import States
from jaxhil.sixdof.scenario import Scenario

SEGMENT_TICKS = 16  # number of ticks in a segment, after which the end of the runs is checked
MIN_APPROACH_SPEED = 1e-3  # lower bound of the approach speed in the test for divergence [m/s]
MISS, REBOUNDED, CAPTURED, JAMMED, TIMEOUT, DIVERGED, NON_FINITE, REACH = range(8)
STATUS_NAMES = ("miss", "rebounded", "captured", "jammed", "timeout", "diverged", "non-finite", "reach")


class EpisodeBatch(NamedTuple):
    """Results of episodes (contacts with all their touches) and their ideal contacts, (episodes, *batch)."""

    start: States  # states of the numerical model at the start of the episode
    end: States  # states of the numerical model at the end of the episode
    elapsed: Float[Array, "episodes *batch"]  # time from start to end [s]
    first_touch: FirstTouch  # first touch of the ideal contact from the same start
    # ideal contact up to the gap (period without a touch) in which the episode ends; else up to the run's end
    summary: IdealContactSummary
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
    episode_start: EpisodeStart  # start of the current episode
    tracker: EpisodeTracker  # record of the current episode
    episodes: EpisodeBatch  # results of the finished episodes
    index: Int[Array, "*batch"]  # index of the current or next episode
    active: Bool[Array, "*batch"]  # whether each run continues
    elapsed: Int[Array, "*batch"]  # number of ticks of each run so far


class RolloutResult(NamedTuple):
    """Results of a rollout: episodes, and final states of the numerical model."""

    episodes: EpisodeBatch
    final: States  # states of the numerical model at the end of each run
    final_time: Float[Array, "*batch"]  # duration of each run [s]


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> RolloutResult:
    """Simulate a batch of scenarios on the rig; each of the `gains` is a scalar or has the batch shape."""
    rig = build_rig_constants(loop, gains, scenario)
    last = jnp.round(scenario.duration / rig.period).astype(jnp.int32)
    # With several episodes, the next episode must begin at the tick after the end of the last episode.
    segment_ticks = SEGMENT_TICKS if loop.episodes == 1 else 1

    def one_tick(progress: EpisodeProgress, _) -> tuple[EpisodeProgress, None]:
        return follow_tick(rig, last, progress, *tick(loop, rig, progress.run)), None

    def body(progress: EpisodeProgress) -> EpisodeProgress:
        after, _ = lax.scan(one_tick, progress, None, segment_ticks)
        return turn_over(loop, rig, last, after)

    start = start_scenario(loop, rig, scenario)
    ended = lax.while_loop(lambda progress: jnp.any(progress.active), body, start)
    time = ended.elapsed.astype(rig.period.dtype) * rig.period
    return RolloutResult(ended.episodes, ended.run.states, time)


def compute_ideal_contact(scenario: Scenario) -> IdealContactRecord:
    """Compute the ideal contact from the start of each scenario. It does not depend on gains."""
    period = scenario.control_period
    until = jnp.round(scenario.duration / period) * period
    contact_model = IdealContactModel(scenario.bodies, scenario.groups, scenario.latches)
    return integrate_ideal_contact(
        contact_model, scenario.start, required_pause(scenario.sensor, period, scenario.timing), until, period
    )


def start_scenario(loop: Loop, rig: RigConstants, scenario: Scenario) -> EpisodeProgress:
    """Return the state of the rollout before tick 0; compute the ideal contacts if they are missing."""
    reference = scenario.ideal_contact
    if reference is None:
        reference = compute_ideal_contact(scenario)
    return start_rollout(loop, rig, begin(loop, rig, scenario.start), reference)


def start_rollout(
    loop: Loop, rig: RigConstants, run: RunState, reference: IdealContactRecord
) -> EpisodeProgress:
    """Return the state of the rollout before tick 0.

    `run` is the state of the loop before tick 0, `reference` the ideal contact from the same start.
    """
    states = run.states
    none = jnp.zeros(rig.period.shape, jnp.int32)
    episode_start = EpisodeStart(states, none, relative_energy(rig, states), reference)
    tracker = start_tracking(rig, states, none)
    episode = _episode(rig, episode_start, tracker, none > 0, none, states)
    episodes: Any = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (loop.episodes, *leaf.shape)),
        episode._replace(status=none + MISS),
    )
    return EpisodeProgress(
        run=run,
        episode_start=episode_start,
        tracker=tracker,
        episodes=episodes,
        index=none,
        active=none == 0,
        elapsed=none,
    )


def follow_tick(
    rig: RigConstants, last: Array, progress: EpisodeProgress, after: RunState, seen: Tick
) -> EpisodeProgress:
    """Update the state of the rollout with a tick.

    In lanes whose run has ended, the states of the bodies do not change.

    Args:
        rig: constants of the runs.
        last: largest number of ticks of each run, (*batch).
        progress: state of the rollout before the tick.
        after: state of the loop after the tick.
        seen: record of the tick.
    """
    run, tracker = progress.run, progress.tracker
    runs = progress.active & (progress.elapsed < last) & ~tracker.is_out_of_reach
    elapsed = progress.elapsed + runs.astype(jnp.int32)
    watched = track_tick(rig, progress.episode_start, tracker, seen, after.states, elapsed)
    watched = select_lanes(runs & ~tracker.has_ended, watched, tracker)
    is_out_of_reach = tracker.is_out_of_reach | (runs & ~rig.kinematics.reaches(after.hardware.commands[0]))
    return progress._replace(
        run=after._replace(states=select_lanes(runs, after.states, run.states)),
        tracker=watched._replace(is_out_of_reach=is_out_of_reach),
        elapsed=elapsed,
    )


def _episode(
    rig: RigConstants,
    episode_start: EpisodeStart,
    tracker: EpisodeTracker,
    has_ended: Array,
    ticks: Array,
    states: States,
) -> EpisodeBatch:
    """Return the results of the current episode.

    In lanes where `has_ended` is false, the results are those up to now: `states` are the current states of
    the bodies, and `ticks` is the number of ticks since the start of the run.
    """
    period = rig.period
    elapsed = (jnp.where(has_ended, tracker.end_tick, ticks) - episode_start.tick).astype(
        period.dtype
    ) * period
    return EpisodeBatch(
        start=episode_start.states,
        end=select_lanes(has_ended, tracker.end, states),
        elapsed=elapsed,
        first_touch=episode_start.reference.first_touch,
        summary=summary_at(episode_start.reference, elapsed, has_ended),
        touches=tracker.touches,
        duration=tracker.touch_ticks.astype(period.dtype) * period,
        peak_force=tracker.force.largest,
        peak_command=tracker.highest[0],
        peak_moment=tracker.moment.largest,
        penetration=tracker.penetration,
        status=jnp.where(has_ended, REBOUNDED, MISS).astype(jnp.int32),
    )


def turn_over(loop: Loop, rig: RigConstants, last: Array, progress: EpisodeProgress) -> EpisodeProgress:
    """Store the results of finished episodes, and begin the next episodes."""
    tracker, run, episode_start, age = (
        progress.tracker,
        progress.run,
        progress.episode_start,
        progress.elapsed,
    )
    has_ended = tracker.has_ended & progress.active
    status = _failure(rig, episode_start, tracker, run.states)
    out = (age >= last) | (status != MISS)
    cut = jnp.where(
        tracker.caught,
        CAPTURED,
        jnp.where(tracker.ticks_since_touch < required_pause_ticks(rig), JAMMED, TIMEOUT),
    )
    status = jnp.where(
        status != MISS, status, jnp.where(has_ended, REBOUNDED, jnp.where(tracker.has_touched, cut, MISS))
    )
    ended = progress.active & (has_ended | out) & (status != MISS)
    episode = _episode(rig, episode_start, tracker, has_ended, age, run.states)._replace(status=status)
    slot = jnp.arange(loop.episodes, dtype=jnp.int32).reshape(-1, *[1] * age.ndim)
    mask = (slot == progress.index[None]) & ended[None]
    episodes = jax.tree.map(lambda new, old: jnp.where(mask, new[None], old), episode, progress.episodes)
    index = progress.index + ended.astype(jnp.int32)
    active = progress.active & ~out
    if not loop.whole:
        active = active & (index < loop.episodes)
    progress = progress._replace(episodes=episodes, index=index, active=active)
    return progress if loop.episodes == 1 else _begin_next(rig, last, progress, has_ended & active)


def _begin_next(rig: RigConstants, last: Array, progress: EpisodeProgress, begins: Array) -> EpisodeProgress:
    """Begin the next episode in the lanes where `begins` is true."""
    states, age, tracker = progress.run.states, progress.elapsed, progress.tracker

    def sample_ideal_contact(episode_start: EpisodeStart) -> EpisodeStart:
        contact_model = IdealContactModel(rig.bodies, rig.groups, rig.latches)
        until = jnp.where(begins, last - age, 0).astype(rig.period.dtype) * rig.period
        reference = integrate_ideal_contact(
            contact_model, states, required_pause(rig.sensor, rig.period, rig.timing), until, rig.period
        )
        following = EpisodeStart(states, age, relative_energy(rig, states), reference)
        return select_lanes(begins, following, episode_start)

    episode_start = lax.cond(
        jnp.any(begins), sample_ideal_contact, lambda episode_start: episode_start, progress.episode_start
    )
    fresh = start_tracking(rig, states, age)._replace(touching=tracker.touching)
    return progress._replace(episode_start=episode_start, tracker=select_lanes(begins, fresh, tracker))


def _failure(
    rig: RigConstants, episode_start: EpisodeStart, tracker: EpisodeTracker, states: States
) -> Array:
    """Return DIVERGED, NON_FINITE or REACH for runs that have failed and must end, MISS for all other runs.

    REACH means that an axis was commanded beyond its workspace.
    """
    energy = relative_energy(rig, states)
    least = jnp.maximum(episode_start.energy, MIN_APPROACH_SPEED**2 / mass_share(rig))
    status = jnp.where(energy > DIVERGENCE_SPEED_RATIO**2 * least, DIVERGED, MISS)
    status = jnp.where(tracker.is_out_of_reach, REACH, status)
    return jnp.where(jnp.isfinite(energy), status, NON_FINITE).astype(jnp.int32)
