"""Rollout of a batch of runs on the rig, from the approach until the evaluated episodes are over.

An episode is a contact with all its touches (`jaxhil.sixdof.watch`). The ideal contact from the same start is
integrated before it. Ticks run in short segments ("stretches"), between which the runs are checked. The
program ends with its slowest lane.
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

STRETCH = 16  # ticks between checks of a run
SLOW = 1e-3  # m/s; least approach speed to which the growth of the speed is related
MISS, REBOUNDED, CAPTURED, JAMMED, TIMEOUT, DIVERGED, NON_FINITE, REACH = range(8)
STATUS_NAMES = ("miss", "rebounded", "captured", "jammed", "timeout", "diverged", "non-finite", "reach")


class Episode(NamedTuple):
    """Results of episodes, (episodes, *batch)."""

    start: States  # numerical model at its start
    end: States  # numerical model at its end
    lasted: Float[Array, "episodes *batch"]  # time from start to end [s]
    meeting: Meeting  # first touch of the ideal contact from the same start
    past: Past  # ideal contact at the begin of its gap in which the end lies; else at the end of the run
    touches: Int[Array, "episodes *batch"]  # number of onsets of touch, over all candidates
    duration: Float[Array, "episodes *batch"]  # time in touch [s]
    peak_force: Float[Array, "episodes *batch"]  # [N]
    peak_moment: Float[Array, "episodes *batch"]  # about T's origin [N m]
    penetration: Float[Array, "episodes *batch"]  # largest penetration, over the size of its shapes [1]
    status: Int[Array, "episodes *batch"]  # index of `STATUS_NAMES`


class EpisodeProgress(NamedTuple):
    """State of a batch of runs."""

    run: RunState
    beginning: Beginning  # start of the current episode
    watch: Watch
    episodes: Episode
    index: Int[Array, "*batch"]  # index of the current or next episode
    active: Bool[Array, "*batch"]
    lasted: Int[Array, "*batch"]  # number of ticks of each run so far


class Outcome(NamedTuple):
    """Results of runs."""

    episodes: Episode
    final: States  # numerical model at the end of the run
    final_time: Float[Array, "*batch"]  # [s]


def rollout(loop: Loop, gains: Gains, scenario: Scenario) -> Outcome:
    """Return the episodes of every lane; `gains` are those of `jaxhil.sixdof.loop.build_rig`."""
    rig = build_rig(loop, gains, scenario)
    last = jnp.round(scenario.duration / rig.period).astype(jnp.int32)
    # Each further episode has a start of its own, which must not be lost between two checks.
    stretch = STRETCH if loop.episodes == 1 else 1

    def one_tick(progress: EpisodeProgress, _) -> tuple[EpisodeProgress, None]:
        return _tick(loop, rig, last, progress), None

    def body(progress: EpisodeProgress) -> EpisodeProgress:
        after, _ = lax.scan(one_tick, progress, None, stretch)
        return _turn_over(loop, rig, last, after)

    start = _start(loop, rig, scenario.start, last)
    ended = lax.while_loop(lambda progress: jnp.any(progress.active), body, start)
    time = ended.lasted.astype(rig.period.dtype) * rig.period
    return Outcome(ended.episodes, ended.run.states, time)


def ideal_contact(rig: Rig, states: States, ticks: Int[Array, "*batch"]) -> Reference:
    """Return the ideal contact of free bodies for so many ticks."""
    space = Space(rig.bodies, rig.groups, rig.latches)
    until = ticks.astype(rig.period.dtype) * rig.period
    return follow_contact(space, states, quiet_time(rig.sensor, rig.period), until, rig.period)


def _start(loop: Loop, rig: Rig, states: States, last: Array) -> EpisodeProgress:
    """Return the state at the start of the runs."""
    none = jnp.zeros(rig.period.shape, jnp.int32)
    beginning = Beginning(states, none, relative_energy(rig, states), ideal_contact(rig, states, last))
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
    """Run one tick. In lanes whose run is over the bodies stand still."""
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
    """Return the current episode; where it is not `over`, it ends now, after so many ticks of the run."""
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
        peak_moment=watch.moment.largest,
        penetration=watch.penetration,
        status=jnp.where(over, REBOUNDED, MISS).astype(jnp.int32),
    )


def _turn_over(loop: Loop, rig: Rig, last: Array, progress: EpisodeProgress) -> EpisodeProgress:
    """Write finished episodes, and begin the next ones."""
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
    """Begin another episode on the lanes where one is over."""
    states, age, watch = progress.run.states, progress.lasted, progress.watch

    def follow(beginning: Beginning) -> Beginning:
        reference = ideal_contact(rig, states, jnp.where(begins, last - age, 0))
        following = Beginning(states, age, relative_energy(rig, states), reference)
        return select_lanes(begins, following, beginning)

    beginning = lax.cond(jnp.any(begins), follow, lambda beginning: beginning, progress.beginning)
    fresh = fresh_watch(rig, states, age)._replace(touching=watch.touching)
    return progress._replace(beginning=beginning, watch=select_lanes(begins, fresh, watch))


def _failure(rig: Rig, beginning: Beginning, watch: Watch, states: States) -> Array:
    """Return DIVERGED, NON_FINITE, REACH for an axis commanded beyond its workspace, or else MISS."""
    energy = relative_energy(rig, states)
    least = jnp.maximum(beginning.energy, SLOW**2 / mass_share(rig))
    status = jnp.where(energy > DIVERGENCE_SPEED_RATIO**2 * least, DIVERGED, MISS)
    status = jnp.where(watch.beyond, REACH, status)
    return jnp.where(jnp.isfinite(energy), status, NON_FINITE).astype(jnp.int32)
