"""Record of the current episode (a contact with all its touches) of a six-axis rig, and its end condition.

An episode ends at the first tick at which three conditions hold: the hardware and the ideal contact have both
paused (no touch for `required_pause`), the numerical model is free, and the wrench command has decayed. The
wait for this decay lasts at most `MAX_DECAY_WAIT`, because a noisy command never decays completely.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import select_lanes
from jaxhil.simulation.contact_tracking import COMMAND_DECAY_RATIO, MAX_DECAY_WAIT
from jaxhil.simulation.scenario import TimingBatch, add_jitter
from jaxhil.sixdof.forces import deepest
from jaxhil.sixdof.ideal_contact import IdealContactRecord, is_in_gap
from jaxhil.sixdof.loop_state import RigConstants, Tick
from jaxhil.sixdof.peaks import Peak, update_peak, zero_peak
from jaxhil.sixdof.relative import States, relative
from jaxhil.sixdof.sensor import Sensor
from jaxhil.sixdof.vectors import dot, norm

MIN_PAUSE = 0.06  # minimum time without any touch, after which an episode may end [s]


class EpisodeStart(NamedTuple):
    """Start of an episode (a contact with all its touches): start of the run, or end of the last episode."""

    states: States  # states of the numerical model at the start
    tick: Int[Array, "*batch"]  # index of the tick at the start
    energy: Float[Array, "*batch"]  # energy of the relative motion at the start, see `relative_energy`
    reference: IdealContactRecord  # ideal contact that starts from these states


class EpisodeTracker(NamedTuple):
    """Record of the current episode (a contact with all its touches) on the rig."""

    has_touched: Bool[Array, "*batch"]  # whether the hardware has touched or a latch has caught
    touching: tuple[Bool[Array, "candidates *batch"], ...]  # whether each pair of shapes touches, per group
    touches: Int[Array, "*batch"]  # number of touches of all pairs of shapes
    touch_ticks: Int[Array, "*batch"]  # number of ticks with a touch
    ticks_since_touch: Int[Array, "*batch"]  # number of ticks since the last touch
    caught: Bool[Array, "*batch"]  # whether a latch holds
    force: Peak  # peak force of the real contact [N]
    moment: Peak  # peak moment of the real contact, about the origin of target frame T [N m]
    highest: tuple[Array, Array]  # largest force [N] and largest moment [N m] of the wrench command
    ticks_since_decay: Int[Array, "*batch"]  # number of ticks since the wrench command decayed
    has_ended: Bool[Array, "*batch"]  # whether the episode has ended
    end: States  # states of the numerical model at the end of the episode
    end_tick: Int[Array, "*batch"]  # number of ticks from the start of the run to the end of the episode
    penetration: Float[Array, "*batch"]  # largest penetration, divided by the shapes' size [1]
    is_out_of_reach: Bool[Array, "*batch"]  # whether an axis was commanded beyond its workspace


def start_tracking(rig: RigConstants, states: States, now: Array) -> EpisodeTracker:
    """Return the record of an episode that starts at tick `now`, with nothing recorded yet.

    Args:
        rig: Constants of the run.
        states: States of the numerical model at the start of the episode.
        now: Number of ticks from the start of the run to the start of the episode.
    """
    zero, none = jnp.zeros_like(rig.period), jnp.zeros(rig.period.shape, jnp.int32)
    peak = zero_peak(zero)
    return EpisodeTracker(
        has_touched=none > 0,
        touching=tuple(group.parameters.damping > jnp.inf for group in rig.groups),
        touches=none,
        touch_ticks=none,
        ticks_since_touch=none,
        caught=none > 0,
        force=peak,
        moment=peak,
        highest=(zero, zero),
        ticks_since_decay=none,
        has_ended=none > 0,
        end=states,
        end_tick=now,
        penetration=zero,
        is_out_of_reach=none > 0,
    )


def track_tick(
    rig: RigConstants,
    episode_start: EpisodeStart,
    tracker: EpisodeTracker,
    seen: Tick,
    after: States,
    ticks: Array,
) -> EpisodeTracker:
    """Update an episode's record for a tick; end the episode if rig, ideal contact and model are free.

    Args:
        rig: Constants of the run.
        episode_start: Start of the episode.
        tracker: Record of the episode before the tick.
        seen: Record of the tick.
        after: States of the numerical model after the tick.
        ticks: Number of ticks from the start of the run, including this tick.
    """
    tracker = _updated(rig, tracker, seen)
    time = (ticks - episode_start.tick).astype(rig.period.dtype) * rig.period
    is_free = is_in_gap(episode_start.reference, time, required_pause(rig.sensor, rig.period, rig.timing))
    pauses = tracker.has_touched & has_rig_settled(rig, tracker) & is_free & ~tracker.has_ended

    def are_free() -> Array:
        return deepest(rig.groups, relative(rig.bodies, after)[0]) < 0

    # Few ticks need the model's penetrations: computing them only there saves time.
    ends = pauses & lax.cond(jnp.any(pauses), are_free, lambda: jnp.ones_like(pauses))
    return tracker._replace(
        has_ended=tracker.has_ended | ends,
        end=select_lanes(ends, after, tracker.end),
        end_tick=jnp.where(ends, ticks, tracker.end_tick),
    )


def required_pause(sensor: Sensor, period: Array, timing: TimingBatch | None) -> Array:
    """Return the pause [s] (time without a touch) after which an episode may end.

    The pause is the time that the force sensor needs to settle, but at least `MIN_PAUSE`. The sensor settles
    within the sum of its delay, its jitter, 20 of its time constants, and two control periods.
    """
    delay = add_jitter(sensor.delay + 20 * sensor.time_constant, timing)
    return jnp.maximum(MIN_PAUSE, delay + 2 * period)


def has_rig_settled(rig: RigConstants, tracker: EpisodeTracker) -> Array:
    """Return whether the rig's touches have paused and the command has decayed, or the wait is too long."""
    pause = required_pause_ticks(rig)
    max_wait = pause + jnp.ceil(MAX_DECAY_WAIT / rig.period).astype(jnp.int32)
    return ((tracker.ticks_since_touch >= pause) & (tracker.ticks_since_decay > 0)) | (
        tracker.ticks_since_touch >= max_wait
    )


def required_pause_ticks(rig: RigConstants) -> Array:
    """Return the pause after which an episode may end (`required_pause`) as a number of ticks."""
    pause = required_pause(rig.sensor, rig.period, rig.timing)
    return jnp.floor(pause / rig.period + 1e-9).astype(jnp.int32) + 1


def relative_energy(rig: RigConstants, states: States) -> Array:
    """Return twice the relative kinetic energy [J]; the coupling of translation and rotation is neglected."""
    _, (linear, angular) = relative(rig.bodies, states)
    return dot(linear, linear) / mass_share(rig) + dot(angular, rig.bodies.chaser.inertia @ angular)


def mass_share(rig: RigConstants) -> Array:
    """Return the inverse of the bodies' reduced mass, 1/m_target + 1/m_chaser [1/kg]."""
    return 1 / rig.bodies.target.mass + 1 / rig.bodies.chaser.mass


def _updated(rig: RigConstants, tracker: EpisodeTracker, seen: Tick) -> EpisodeTracker:
    """Return `tracker` after the tick `seen`, with updated touches, peaks, penetration and command decay."""
    touching = tuple(forces.touch.depth > 0 for forces in seen.forces)
    caught = tracker.caught
    for latch in seen.latch_states:
        caught = caught | jnp.any(latch.caught, axis=0)
    now, touches = caught, tracker.touches
    for flags, before in zip(touching, tracker.touching, strict=True):
        now = now | jnp.any(flags, axis=0)
        touches = touches + jnp.sum(flags & ~before, axis=0, dtype=touches.dtype)
    penetration = tracker.penetration
    for group, forces in zip(rig.groups, seen.forces, strict=True):
        share = jnp.max(forces.touch.depth / group.candidates.size, axis=0)
        penetration = jnp.maximum(penetration, share)
    command = norm(seen.command.force), norm(seen.command.moment)
    highest = tuple(jnp.maximum(a, b) for a, b in zip(tracker.highest, command, strict=True))
    # The threshold does not depend on the noise; `jaxhil.simulation.contact_tracking` states the reason.
    ticks_since_decay = (command[0] <= COMMAND_DECAY_RATIO * highest[0]) & (
        command[1] <= COMMAND_DECAY_RATIO * highest[1]
    )
    return tracker._replace(
        has_touched=tracker.has_touched | now,
        touching=touching,
        touches=touches,
        touch_ticks=tracker.touch_ticks + now.astype(touches.dtype),
        ticks_since_touch=jnp.where(now, 0, tracker.ticks_since_touch + 1),
        caught=caught,
        force=update_peak(tracker.force, norm(seen.contact.force), rig.period),
        moment=update_peak(tracker.moment, norm(seen.contact.moment), rig.period),
        highest=(highest[0], highest[1]),
        ticks_since_decay=jnp.where(ticks_since_decay, tracker.ticks_since_decay + 1, 0),
        penetration=penetration,
    )
