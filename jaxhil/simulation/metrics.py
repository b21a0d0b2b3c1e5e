"""Metrics of each contact on the rig: restitution, peaks, duration, work and status."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.simulation.contact_tracking import DIVERGENCE_SPEED_RATIO, ContactTracker
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.probe import root_mean_square
from jaxhil.simulation.scenario import MAX_CONTACT_DURATION, Scenario

NOT_REACHED, OK, TIMEOUT, DIVERGED, NON_FINITE = -1, 0, 1, 2, 3
CONTACT_STATUS_NAMES = {
    NOT_REACHED: "not reached",
    OK: "ok",
    TIMEOUT: "timeout",
    DIVERGED: "diverged",
    NON_FINITE: "non-finite",
}
# Explanation of every status except `OK`.
CONTACT_STATUS_REASONS = {
    "not reached": "the numerical model turned back without a measured force: the hardware did not touch, or "
    "the force sensor did not show the contact; or the rebound of the contact before was faster than "
    "velocity_limit, and the drives cannot follow the next approach",
    "timeout": f"a contact was not over within {MAX_CONTACT_DURATION:g} s, the limit of a contact",
    "diverged": f"the speed grew beyond {DIVERGENCE_SPEED_RATIO:g} times the speed of the first approach",
    "non-finite": "a number was no longer finite",
}


class Metrics(NamedTuple):
    """Metrics of every contact; arrays of shape (contacts, *batch).

    `excess_variation` measures the chatter of the force command F_c. The excess variation is V/2 - R, where V
    = sum |F_c(n+1) - F_c(n)| is the total variation of F_c, and R is its range max F_c - min F_c. Before and
    after the contact, F_c counts as 0. The excess variation is 0 for a command that rises to its maximum,
    falls to its minimum and returns to 0. Each further swing of the command adds the height of the swing.

    `position_shortfall` is the largest |c - c'| at any tick of the contact. Here c is the compensator's
    position command, and c' is the command after the velocity and acceleration limits. The shortfall is
    exactly 0 if no limit is active.

    `trajectory_error` compares the penetration of the numerical model with the penetration of the ideal
    contact. The time of each penetration counts from its own onset of contact. The error is the root mean
    square of the difference during the ideal contact.
    """

    restitution: Float[Array, "slots *batch"]  # rebound speed divided by approach speed [1]
    approach_velocity: Float[Array, "slots *batch"]  # speed of the numerical model before the contact [m/s]
    peak_force: Float[Array, "slots *batch"]  # largest real contact force [N]
    peak_command: Float[Array, "slots *batch"]  # largest |force command| [N]
    excess_variation: Float[Array, "slots *batch"]  # chatter of the force command [N]; 0 unless recorded
    # largest change of the position command by the motion simulator's limits [m]
    position_shortfall: Float[Array, "slots *batch"]
    duration: Float[Array, "slots *batch"]  # time during which a real force acts [s]
    # work done on the mechanism by the real force [J]; 0 unless recorded
    work_in: Float[Array, "slots *batch"]
    work_out: Float[Array, "slots *batch"]  # work returned by the mechanism [J]; 0 unless recorded
    # rms difference of the penetration from the ideal contact's [m]; 0 without a probe
    trajectory_error: Float[Array, "slots *batch"]
    # delay of the force measurement as estimated by the compensator [s]; 0 without an estimate
    force_delay: Float[Array, "slots *batch"]
    status: Int[Array, "slots *batch"]  # key of `CONTACT_STATUS_NAMES`
    # ticks from the start of the first run to the end of this contact, with the skipped ticks of approaches
    ticks: Int[Array, "slots *batch"]


def empty_metrics(loop: Loop, slots: int, like: Array) -> Metrics:
    """Return the initial metrics, before any contact: NaN, or 0 for metrics that are not recorded."""
    numbers = jnp.full((slots, *like.shape), jnp.nan, like.dtype)
    counts = jnp.zeros((slots, *like.shape), jnp.int32)
    return Metrics(
        restitution=numbers,
        approach_velocity=numbers,
        peak_force=numbers,
        peak_command=numbers,
        excess_variation=numbers,
        position_shortfall=numbers if loop.has_limits else jnp.zeros_like(numbers),
        duration=numbers,
        work_in=numbers,
        work_out=numbers,
        trajectory_error=numbers if loop.probed else jnp.zeros_like(numbers),
        force_delay=numbers if loop.compensator.estimates_delay else jnp.zeros_like(numbers),
        status=counts + NOT_REACHED,
        ticks=counts,
    )


def determine_status(scenario: Scenario, tracker: ContactTracker, age: Array) -> Array:
    """Return the status of the current contact; the status is `OK` while the contact continues.

    `age` is the number of ticks since the run began.
    """
    period = scenario.control_period
    distance = jnp.where(
        jnp.isfinite(scenario.clearance), scenario.clearance, -jnp.minimum(scenario.contact_plane, 0)
    )
    limit = scenario.time_limit / period
    max_flight = limit + 10 * distance / scenario.velocity / period
    is_missing = (tracker.elapsed == 0) & (age.astype(period.dtype) > max_flight)
    late = (tracker.elapsed > limit) | is_missing
    # If the numerical model turned back without a measured force, there was no contact.
    ended = jnp.where(tracker.has_reading, OK, NOT_REACHED)
    timed_out = jnp.where(tracker.in_contact > 0, TIMEOUT, NOT_REACHED)
    status = jnp.where(tracker.has_ended, ended, jnp.where(late, timed_out, OK))
    status = jnp.where(tracker.rebound > DIVERGENCE_SPEED_RATIO * scenario.velocity, DIVERGED, status)
    finite = jnp.isfinite(tracker.rebound) & jnp.isfinite(tracker.peak_command)
    return jnp.where(finite, status, NON_FINITE).astype(jnp.int32)


def store_metrics(
    scenario: Scenario,
    metrics: Metrics,
    tracker: ContactTracker,
    index: Array,
    has_ended: Array,
    status: Array,
    ticks: Array,
    force_delay: Array | None = None,
) -> Metrics:
    """Return the metrics, updated with the contacts that have ended.

    Nothing is stored for a contact that was not reached.

    Args:
        scenario: Scenarios that are simulated.
        metrics: Metrics of earlier contacts.
        tracker: Record of the current contact of each lane.
        index: Index of the current contact of each lane.
        has_ended: Whether the current contact of each lane has ended.
        status: Status of the current contact.
        ticks: Number of ticks since the first run began.
        force_delay: Delay of the force measurement as estimated by the compensator [s]; None if the
            compensator estimates no delay.
    """
    period = scenario.control_period
    zeros = jnp.zeros_like(period)
    work_in, work_out = tracker.work or (zeros, zeros)
    excess = zeros
    if tracker.command_variation is not None:
        command = tracker.command_variation
        excess = command.variation / 2 - (command.highest - command.lowest)
    optional = {
        "position_shortfall": tracker.shortfall,
        "trajectory_error": None if tracker.deviation is None else root_mean_square(tracker.deviation),
        "force_delay": force_delay,
    }
    values = Metrics(
        restitution=tracker.rebound / jnp.where(tracker.approach > 0, tracker.approach, jnp.nan),
        approach_velocity=tracker.approach,
        peak_force=tracker.peak_force,
        peak_command=tracker.peak_command,
        excess_variation=excess,
        duration=tracker.in_contact * period,
        work_in=work_in,
        work_out=work_out,
        status=status,
        ticks=ticks,
        **{name: zeros if value is None else value for name, value in optional.items()},
    )
    slots = metrics.restitution.shape[0]
    slot = jnp.arange(slots, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
    mask = (slot == index[None]) & (has_ended & (status != NOT_REACHED))[None]
    updated = Metrics(*(jnp.where(mask, v[None], m) for v, m in zip(values, metrics, strict=True)))
    # Metrics that are not recorded keep their initial arrays, which saves time.
    return updated._replace(
        **{name: getattr(metrics, name) for name, value in optional.items() if value is None}
    )
