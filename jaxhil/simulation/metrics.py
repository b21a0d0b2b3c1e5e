"""Figures of the contacts that are over: restitution, peaks, duration, energies, and how each ended."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxhil.simulation.loop import Loop
from jaxhil.simulation.probe import root_mean_square
from jaxhil.simulation.scenario import LONGEST_CONTACT, Scenario
from jaxhil.simulation.watch import RUNAWAY, Watch

NOT_REACHED, OK, TIMEOUT, DIVERGED, NON_FINITE = -1, 0, 1, 2, 3
STATUS_NAMES = {
    NOT_REACHED: "not reached",
    OK: "ok",
    TIMEOUT: "timeout",
    DIVERGED: "diverged",
    NON_FINITE: "non-finite",
}
# What a status says in a sentence, of those with which a run ends badly.
STATUS_REASONS = {
    "not reached": "the numerical model turned back without a measured force: the hardware did not touch, or "
    "the force sensor did not show it; or the contact before left faster than velocity_limit, and the drives "
    "cannot follow the next approach",
    "timeout": f"a contact was not over within {LONGEST_CONTACT:g} s, the limit of a contact",
    "diverged": f"the speed grew beyond {RUNAWAY:g} times that of the first approach",
    "non-finite": "a number was no longer finite",
}


class Metrics(NamedTuple):
    """Figures of every contact, (slots, *batch).

    excess_variation is V / 2 - (max F_c - min F_c), V the total variation sum |F_c(n+1) - F_c(n)| of the
    command, which counts as 0 before the contact and after it. The least V / 2 there is, max - min, is that
    of a command that swings but once: up to its maximum, down to its minimum and back to 0. What is beyond
    is chatter: max - min for every whole swing too many.

    position_shortfall is the largest |c - c'| at any tick of the contact, c the position command that the
    compensator asks for and c' the one that velocity and acceleration limits let through to the drives. It is
    0, to the bit, where neither limit binds or there is none.
    """

    restitution: Float[Array, "slots *batch"]  # rebound speed over approach speed [1]
    approach_velocity: Float[Array, "slots *batch"]  # of the numerical model before the contact [m/s]
    peak_force: Float[Array, "slots *batch"]  # largest real contact force [N]
    peak_command: Float[Array, "slots *batch"]  # largest |F_c| [N]
    excess_variation: Float[Array, "slots *batch"]  # of F_c [N], see above; 0 unless followed
    # how far the motion simulator's limits held the command back [m], see above
    position_shortfall: Float[Array, "slots *batch"]
    duration: Float[Array, "slots *batch"]  # time with a real force [s]
    # done on the mechanism by the real force along x_a [J]; 0 unless followed
    work_in: Float[Array, "slots *batch"]
    work_out: Float[Array, "slots *batch"]  # returned by it [J]; 0 unless followed
    # root mean square of x_d's depth off that of the same contact in space, as long as that lasts, each since
    # it touched [m]; 0 unless probed
    trajectory_error: Float[Array, "slots *batch"]
    # of the force measurement as the compensator estimates it by then [s]; 0 unless it does
    force_delay: Float[Array, "slots *batch"]
    status: Int[Array, "slots *batch"]  # one of `STATUS_NAMES`
    ticks: Int[Array, "slots *batch"]  # run by then, and skipped on approaches


def empty_metrics(loop: Loop, slots: int, like: Array) -> Metrics:
    """Before any contact."""
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


def judge(scenario: Scenario, watch: Watch, age: Array) -> Array:
    """Status of the contact under way, `age` ticks into its run: OK, also while it goes on."""
    period = scenario.control_period
    way = jnp.where(
        jnp.isfinite(scenario.clearance), scenario.clearance, -jnp.minimum(scenario.contact_plane, 0)
    )
    limit = scenario.time_limit / period
    patience = limit + 10 * way / scenario.velocity / period
    waiting = (watch.elapsed == 0) & (age.astype(period.dtype) > patience)
    late = (watch.elapsed > limit) | waiting
    # Without a measured force there is no contact, whatever made the numerical model turn back.
    ended = jnp.where(watch.measured, OK, NOT_REACHED)
    cut = jnp.where(watch.in_contact > 0, TIMEOUT, NOT_REACHED)
    status = jnp.where(watch.over, ended, jnp.where(late, cut, OK))
    status = jnp.where(watch.rebound > RUNAWAY * scenario.velocity, DIVERGED, status)
    finite = jnp.isfinite(watch.rebound) & jnp.isfinite(watch.peak_command)
    return jnp.where(finite, status, NON_FINITE).astype(jnp.int32)


def collect(
    scenario: Scenario,
    metrics: Metrics,
    watch: Watch,
    index: Array,
    over: Array,
    status: Array,
    ticks: Array,
    force_delay: Array | None = None,
) -> Metrics:
    """Enter the contacts that are `over`, and were reached, at their `index`; `ticks` have run by now, and
    the law estimates a `force_delay` [s], or does not."""
    period = scenario.control_period
    none = jnp.zeros_like(period)
    work_in, work_out = watch.works or (none, none)
    excess = none
    if watch.swings is not None:
        excess = watch.swings.variation / 2 - (watch.swings.highest - watch.swings.lowest)
    followed = {
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
        **{name: none if value is None else value for name, value in followed.items()},
    )
    slots = metrics.restitution.shape[0]
    slot = jnp.arange(slots, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
    here = (slot == index[None]) & (over & (status != NOT_REACHED))[None]
    entered = Metrics(*(jnp.where(here, v[None], m) for v, m in zip(values, metrics, strict=True)))
    # What is not followed still is what it was before any contact: no work in every turn-over.
    return entered._replace(
        **{name: getattr(metrics, name) for name, value in followed.items() if value is None}
    )
