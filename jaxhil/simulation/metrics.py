"""Metrics of finished contacts: restitution, peaks, duration, energies, and status."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.simulation.loop import Loop
from jaxhil.simulation.probe import root_mean_square
from jaxhil.simulation.scenario import MAX_CONTACT_DURATION, Scenario
from jaxhil.simulation.watch import DIVERGENCE_SPEED_RATIO, Watch

NOT_REACHED, OK, TIMEOUT, DIVERGED, NON_FINITE = -1, 0, 1, 2, 3
CONTACT_STATUS_NAMES = {
    NOT_REACHED: "not reached",
    OK: "ok",
    TIMEOUT: "timeout",
    DIVERGED: "diverged",
    NON_FINITE: "non-finite",
}
# Explanations of the statuses other than `OK`.
CONTACT_STATUS_REASONS = {
    "not reached": "the numerical model turned back without a measured force: the hardware did not touch, or "
    "the force sensor did not show it; or the contact before left faster than velocity_limit, and the drives "
    "cannot follow the next approach",
    "timeout": f"a contact was not over within {MAX_CONTACT_DURATION:g} s, the limit of a contact",
    "diverged": f"the speed grew beyond {DIVERGENCE_SPEED_RATIO:g} times that of the first approach",
    "non-finite": "a number was no longer finite",
}


class Metrics(NamedTuple):
    """Metrics of every contact, (slots, *batch).

    excess_variation is V / 2 - (max F_c - min F_c), where V = sum |F_c(n+1) - F_c(n)| is the total variation
    of the command, which counts as 0 before and after the contact. A command that rises to its maximum, falls
    to its minimum and returns to 0 has the least V / 2, which is max - min. The excess is chatter: max - min
    for each additional full swing.

    position_shortfall is the largest |c - c'| at any tick of the contact, where c is the compensator's
    position command and c' the command after the velocity and acceleration limits. It is exactly 0 if no
    limit is active.
    """

    restitution: Float[Array, "slots *batch"]  # rebound speed over approach speed [1]
    approach_velocity: Float[Array, "slots *batch"]  # of the numerical model before the contact [m/s]
    peak_force: Float[Array, "slots *batch"]  # largest real contact force [N]
    peak_command: Float[Array, "slots *batch"]  # largest |F_c| [N]
    excess_variation: Float[Array, "slots *batch"]  # of F_c [N], see above; 0 unless recorded
    # greatest change of the position command by the limits [m], see above
    position_shortfall: Float[Array, "slots *batch"]
    duration: Float[Array, "slots *batch"]  # time with a real force [s]
    # work done on the mechanism by the real force along x_a [J]; 0 unless recorded
    work_in: Float[Array, "slots *batch"]
    work_out: Float[Array, "slots *batch"]  # work returned by the mechanism [J]; 0 unless recorded
    # root mean square difference of the penetrations of x_d and of the ideal contact, each since its touch,
    # for the ideal contact's duration [m]; 0 unless probed
    trajectory_error: Float[Array, "slots *batch"]
    # compensator's estimate of the force measurement's delay [s]; 0 unless it has one
    force_delay: Float[Array, "slots *batch"]
    status: Int[Array, "slots *batch"]  # one of `CONTACT_STATUS_NAMES`
    ticks: Int[Array, "slots *batch"]  # ticks until then, including the skipped ticks of approaches


def empty_metrics(loop: Loop, slots: int, like: Array) -> Metrics:
    """Return the metrics before any contact."""
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


def determine_status(scenario: Scenario, watch: Watch, age: Array) -> Array:
    """Return the status of the current contact, `age` ticks into its run.

    It is OK also while the contact continues.
    """
    period = scenario.control_period
    way = jnp.where(
        jnp.isfinite(scenario.clearance), scenario.clearance, -jnp.minimum(scenario.contact_plane, 0)
    )
    limit = scenario.time_limit / period
    patience = limit + 10 * way / scenario.velocity / period
    waiting = (watch.elapsed == 0) & (age.astype(period.dtype) > patience)
    late = (watch.elapsed > limit) | waiting
    # Without a measured force there was no contact, whatever reversed the numerical model.
    ended = jnp.where(watch.measured, OK, NOT_REACHED)
    cut = jnp.where(watch.in_contact > 0, TIMEOUT, NOT_REACHED)
    status = jnp.where(watch.over, ended, jnp.where(late, cut, OK))
    status = jnp.where(watch.rebound > DIVERGENCE_SPEED_RATIO * scenario.velocity, DIVERGED, status)
    finite = jnp.isfinite(watch.rebound) & jnp.isfinite(watch.peak_command)
    return jnp.where(finite, status, NON_FINITE).astype(jnp.int32)


def store_metrics(
    scenario: Scenario,
    metrics: Metrics,
    watch: Watch,
    index: Array,
    over: Array,
    status: Array,
    ticks: Array,
    force_delay: Array | None = None,
) -> Metrics:
    """Write the metrics of contacts that are `over` and were reached, at their `index`.

    Args:
        scenario: Scenarios.
        metrics: Metrics so far.
        watch: Records of the current contacts.
        index: Slot of each lane's contact.
        over: Whether a lane's contact is over.
        status: Status of the contact.
        ticks: Number of ticks so far.
        force_delay: Compensator's estimate of the force measurement's delay [s]; None without one.
    """
    period = scenario.control_period
    zeros = jnp.zeros_like(period)
    work_in, work_out = watch.works or (zeros, zeros)
    excess = zeros
    if watch.swings is not None:
        excess = watch.swings.variation / 2 - (watch.swings.highest - watch.swings.lowest)
    optional = {
        "position_shortfall": watch.shortfall,
        "trajectory_error": None if watch.deviation is None else root_mean_square(watch.deviation),
        "force_delay": force_delay,
    }
    values = Metrics(
        restitution=watch.rebound / jnp.where(watch.approach > 0, watch.approach, jnp.nan),
        approach_velocity=watch.approach,
        peak_force=watch.peak_force,
        peak_command=watch.peak_command,
        excess_variation=excess,
        duration=watch.in_contact * period,
        work_in=work_in,
        work_out=work_out,
        status=status,
        ticks=ticks,
        **{name: zeros if value is None else value for name, value in optional.items()},
    )
    slots = metrics.restitution.shape[0]
    slot = jnp.arange(slots, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
    mask = (slot == index[None]) & (over & (status != NOT_REACHED))[None]
    updated = Metrics(*(jnp.where(mask, v[None], m) for v, m in zip(values, metrics, strict=True)))
    # Values that are not recorded keep their initial value, which saves time.
    return updated._replace(
        **{name: getattr(metrics, name) for name, value in optional.items() if value is None}
    )
