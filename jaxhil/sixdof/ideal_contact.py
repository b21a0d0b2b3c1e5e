"""Ideal contact as the reference of a run on the rig.

The ideal contact is integrated once, for the whole duration of the run. An episode of the rig ends when both
the rig and the ideal contact are free. Therefore this module records the gaps between touches of the ideal
contact (periods in which nothing touches), with the motion of the bodies at the start of each gap.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import select_lanes
from jaxhil.sixdof.first_touch import FirstTouch, find_first_touch
from jaxhil.sixdof.ideal_contact_integration import (
    IdealContactModel,
    Instant,
    IntegrationState,
    advance_integration,
    error_speed,
    integrate_until,
    start_integration,
)
from jaxhil.sixdof.peaks import Peak, update_peak, zero_peak
from jaxhil.sixdof.relative import Pair, States, Twist, mass_matrix, relative
from jaxhil.sixdof.vectors import norm

FIRST_STEP = 1e-4  # length of the first integration step [s]
MAX_STEP_PERIODS = 2.0  # maximum length of an integration step near a touch [control periods]
MAX_GAPS = 4  # maximum number of recorded gaps between touches
# Minimum change of the twist after which an episode may end, divided by the twist before the contact [1].
MIN_CHANGE = 0.05


class IdealContactSummary(NamedTuple):
    """Metrics of the ideal contact up to a time, and states of the bodies at this time."""

    time: Float[Array, "*batch"]  # time since the start [s]
    states: States  # states of the bodies at the instants in `time`
    touches: Int[Array, "*batch"]  # number of touches of all pairs of shapes
    touch_duration: Float[Array, "*batch"]  # time during which shapes touched [s]
    peak_force: Float[Array, "*batch"]  # peak force [N]
    peak_moment: Float[Array, "*batch"]  # peak moment about the origin of target frame T [N m]
    captured: Bool[Array, "*batch"]  # whether a latch holds


class Gaps(NamedTuple):
    """Gaps of the ideal contact: periods without a touch that follow a noticeable change of the twist.

    Arrays are (MAX_GAPS, *batch). After more than MAX_GAPS gaps, the latest gap overwrites the last entry. An
    unused entry begins at infinity.
    """

    begin: IdealContactSummary  # ideal contact up to the start of the gap
    end: Float[Array, "gaps *batch"]  # time of the next touch [s]; infinite if nothing touches again


class IdealContactRecord(NamedTuple):
    """Ideal contact for the whole duration of a run: first touch, gaps between touches, and final summary."""

    first_touch: FirstTouch  # first touch
    gaps: Gaps
    # summary up to the end of the run; the time is infinite if the contact was too stiff to be integrated
    last: IdealContactSummary


class IdealContactProgress(NamedTuple):
    """State of the integration of an ideal contact, with the metrics so far."""

    integration: IntegrationState  # motion of the bodies, with the state of the integrator
    touching: tuple[Bool[Array, "candidates *batch"], ...]  # whether each pair of shapes touches, per group
    touches: Int[Array, "*batch"]  # number of touches of all pairs of shapes
    touch_duration: Float[Array, "*batch"]  # time during which shapes touched [s]
    before: States  # states at the start of the step in which the first touch begins
    depths: tuple[Float[Array, "candidates *batch"], ...]  # penetrations at the end of the same step [m]
    force: Peak  # peak force [N]
    moment: Peak  # peak moment about the origin of target frame T [N m]
    gaps: Gaps
    slot: Int[Array, "*batch"]  # index of the current or next gap
    active: Bool[Array, "*batch"]  # whether the integration of each lane continues


class IntegrationConstants(NamedTuple):
    """Quantities that stay constant during the integration of the ideal contact."""

    twist: Twist  # twist of chaser frame C relative to target frame T at the start
    mass: Float[Array, "6 6 *batch"]  # relative mass matrix
    # speed that scales the integration error, see `ideal_contact_integration.error_speed` [m/s]
    speed: Float[Array, "*batch"]
    min_gap: Float[Array, "*batch"]  # minimum duration of a recorded gap between touches [s]


def integrate_ideal_contact(
    contact_model: IdealContactModel, states: States, min_gap: Array, until: Array, period: Array
) -> IdealContactRecord:
    """Integrate the ideal contact of two bodies that start apart.

    Args:
        contact_model: Constants of the ideal contact.
        states: States of the bodies at the start, without contact.
        min_gap: Minimum duration of a recorded gap between touches [s].
        until: Duration of the integration [s].
        period: Control period [s]; integration steps near a touch last at most two control periods.
    """
    _, twist = relative(contact_model.bodies, states)
    constants = IntegrationConstants(
        twist, mass_matrix(contact_model.bodies, states), error_speed(contact_model, states), min_gap
    )
    longest = MAX_STEP_PERIODS * period

    def body(progress: IdealContactProgress) -> IdealContactProgress:
        left = until - progress.integration.time
        after, step = advance_integration(contact_model, progress.integration, left, longest, constants.speed)
        # A rejected step changes nothing but the length of the next step.
        going = select_lanes(step.accepted, _update(progress, constants, after, step.now), progress)
        going = going._replace(integration=after)
        done = (until - after.time <= 1e-13 * until) | ~jnp.isfinite(after.time)
        return select_lanes(progress.active, going._replace(active=~done), progress)

    start = _start(contact_model, states, jnp.minimum(FIRST_STEP, until))._replace(active=until > 0)
    progress = lax.while_loop(lambda progress: jnp.any(progress.active), body, start)
    return IdealContactRecord(
        find_first_touch(contact_model, progress.before, progress.depths), progress.gaps, _summarise(progress)
    )


def is_in_gap(reference: IdealContactRecord, time: Array, min_gap: Array) -> Bool[Array, "*batch"]:
    """Return whether the ideal contact, at a `time` [s], has had no touch for at least `min_gap` [s]."""
    begin, end = reference.gaps.begin.time, reference.gaps.end
    return jnp.any((begin + min_gap[None] <= time[None]) & (time[None] < end), axis=0)


def summary_at(
    reference: IdealContactRecord, time: Array, common: Bool[Array, "*batch"]
) -> IdealContactSummary:
    """Return the summary of the ideal contact up to the start of the gap that contains a `time` [s].

    A gap is a period without a touch. `common` states in which lanes the gap ends an episode; in all other
    lanes, return the summary of the whole run.
    """
    summary = reference.last
    for slot in range(MAX_GAPS):
        begin = jax.tree.map(lambda leaf, slot=slot: leaf[slot], reference.gaps.begin)
        summary = select_lanes(
            common & (begin.time <= time) & (time < reference.gaps.end[slot]), begin, summary
        )
    return summary


def states_at(bodies: Pair, summary: IdealContactSummary, time: Float[Array, "*batch"]) -> States:
    """Return the bodies' states at a `time` [s], after free flight since the time of the `summary`."""
    free = IdealContactModel(bodies, (), ())
    left = jnp.where(time > summary.time, time - summary.time, 0)
    integration = start_integration(free, summary.states, left)
    return integrate_until(free, integration, left, left, error_speed(free, summary.states)).states


def _start(
    contact_model: IdealContactModel, states: States, first: Float[Array, "*batch"]
) -> IdealContactProgress:
    """Return the initial state of the integration; its first step has the length `first` [s]."""
    zero, none = jnp.zeros_like(first), jnp.zeros(first.shape, jnp.int32)
    depths = tuple(jnp.zeros_like(group.parameters.damping) for group in contact_model.groups)
    touching = tuple(depth > 0 for depth in depths)
    progress = IdealContactProgress(
        integration=start_integration(contact_model, states, first),
        touching=touching,
        touches=none,
        touch_duration=zero,
        before=states,
        depths=depths,
        force=zero_peak(zero),
        moment=zero_peak(zero),
        gaps=Gaps(None, zero),  # type: ignore[arg-type]
        slot=none,
        active=none == 0,
    )
    summary: Any = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (MAX_GAPS, *leaf.shape)), _summarise(progress)
    )
    never = jnp.full((MAX_GAPS, *first.shape), jnp.inf, first.dtype)
    return progress._replace(gaps=Gaps(summary._replace(time=never), never))


def _summarise(progress: IdealContactProgress) -> IdealContactSummary:
    """Return the metrics of the ideal contact so far."""
    captured = progress.touches < 0
    for latch in progress.integration.memories.latch_states:
        captured = captured | jnp.any(latch.caught, axis=0)
    return IdealContactSummary(
        time=progress.integration.time,
        states=progress.integration.states,
        touches=progress.touches,
        touch_duration=progress.touch_duration,
        peak_force=progress.force.largest,
        peak_moment=progress.moment.largest,
        captured=captured,
    )


def _record_gap(
    progress: IdealContactProgress, constants: IntegrationConstants, ahead: IdealContactProgress, now: Instant
) -> IdealContactProgress:
    """Add to `ahead` any gap (time without a touch) that begins or ends in the step from `progress`."""
    was, touches = _touches(progress), _touches(ahead)
    slot = jnp.arange(MAX_GAPS, dtype=jnp.int32).reshape(-1, *[1] * was.ndim) == progress.slot[None]
    change = jnp.stack(jax.tree.leaves(jax.tree.map(jnp.subtract, now.twist, constants.twist)))
    twist = jnp.stack(jax.tree.leaves(constants.twist))
    is_noticeable = _square(constants.mass, change) >= MIN_CHANGE**2 * _square(constants.mass, twist)
    begins = slot & (was & ~touches & is_noticeable)[None]
    summary = jax.tree.map(
        lambda new, old: jnp.where(begins, new[None], old), _summarise(ahead), ahead.gaps.begin
    )
    # A gap ends at the last time without a touch.
    start = jnp.min(jnp.where(slot, ahead.gaps.begin.time, jnp.inf), axis=0)
    ends = ~was & touches & jnp.isfinite(start)
    end = jnp.where(begins, jnp.inf, ahead.gaps.end)
    end = jnp.where(slot & ends[None], progress.integration.time[None], end)
    is_long = ends & (progress.integration.time - start >= constants.min_gap)
    summary = summary._replace(time=jnp.where(slot & (ends & ~is_long)[None], jnp.inf, summary.time))
    next_slot = jnp.minimum(progress.slot + is_long.astype(jnp.int32), MAX_GAPS - 1)
    return ahead._replace(gaps=Gaps(summary, end), slot=next_slot)


def _square(matrix: Array, vector: Array) -> Array:
    """Return the quadratic form vector^T matrix vector."""
    return jnp.sum(vector[:, None] * matrix * vector[None], axis=(0, 1))


def _update(
    progress: IdealContactProgress, constants: IntegrationConstants, after: IntegrationState, now: Instant
) -> IdealContactProgress:
    """Update the metrics of the ideal contact with a step; `after` is the state after the step."""
    depths = tuple(forces.touch.depth for forces in now.forces)
    touching = tuple(depth > 0 for depth in depths)
    touches = progress.touches
    for now_touching, before in zip(touching, progress.touching, strict=True):
        touches = touches + jnp.sum(now_touching & ~before, axis=0, dtype=touches.dtype)
    ahead = progress._replace(integration=after, touching=touching, touches=touches)
    first = (progress.touches == 0) & (touches > 0)
    step = after.time - progress.integration.time
    # The force has a jump or a kink where a touch begins or ends.
    bends = jnp.zeros(step.shape, bool)
    for now_touching, before in zip(touching, progress.touching, strict=True):
        bends = bends | jnp.any(now_touching != before, axis=0)
    touch_duration = progress.touch_duration + jnp.where(_touches(progress), step, 0)
    ahead = ahead._replace(
        touch_duration=touch_duration,
        before=select_lanes(touches == 0, now.states, progress.before),
        depths=select_lanes(first, depths, progress.depths),
        force=update_peak(progress.force, norm(now.wrench.force), step, bends),
        moment=update_peak(progress.moment, norm(now.wrench.moment), step, bends),
    )
    return _record_gap(progress, constants, ahead, now)


def _touches(progress: IdealContactProgress) -> Array:
    """Return whether any pair of shapes touches or any latch holds."""
    result = jnp.zeros(progress.touch_duration.shape, bool)
    for flags in (
        *progress.touching,
        *(latch.caught for latch in progress.integration.memories.latch_states),
    ):
        result = result | jnp.any(flags, axis=0)
    return result
