"""What is said of each contact: begin, end and restitution, peaks and energies (model.md, conventions).

`Watch` follows the contact under way, tick by tick, from what really happens (`PlantSignals`) and from the
command; `Metrics` collects the contacts that are over.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxhil.compensators.base import Constants, Signals
from jaxhil.contact.laws import deflection
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.probe import Deviation, Probe, follow, no_deviation, root_mean_square
from jaxhil.simulation.scenario import Scenario

NOT_REACHED, OK, TIMEOUT, DIVERGED, NON_FINITE = -1, 0, 1, 2, 3
STATUS_NAMES = {
    NOT_REACHED: "not reached",
    OK: "ok",
    TIMEOUT: "timeout",
    DIVERGED: "diverged",
    NON_FINITE: "non-finite",
}
LONGEST_FADING = 0.1  # s, waited for the compensator's command to die out
FADED = 1e-6  # of the command's peak
RUNAWAY = 1e3  # of the first approach speed: no rig survives it


class Metrics(NamedTuple):
    """Per contact, (slots, *batch): restitution [1]; approach_velocity [m/s]; peak_force, the real contact
    force's, and peak_command, |F_c|'s [N]; excess_variation of F_c [N] (0 unless followed);
    position_shortfall, how far the motion simulator's limits bound [m]; duration, the time in touch [s];
    work_in and work_out, by the real force along x_a [J] (0 unless audited); trajectory_error, the root mean
    square of x_d's depth off that of the same contact in space, as long as that lasts, each since it touched
    [m] (0 unless probed); force_delay, the delay of the force measurement as the law estimates it by then
    [s] (0 unless it does); status, one of `STATUS_NAMES`; ticks run by then.

    excess_variation is V / 2 - (max F_c - min F_c), V the total variation sum |F_c(n+1) - F_c(n)| of the
    command, which counts as 0 before the contact and after it. The least V / 2 there is, max - min, is that
    of a command that swings but once: up to its maximum, down to its minimum and back to 0. What is beyond
    is chatter: max - min for every whole swing too many.

    position_shortfall is the largest |c - c'| at any tick of the contact, c the position command that the
    compensator asks for and c' the one that velocity and acceleration limits let through to the drives: 0, to
    the bit, where neither bound. Where a loop has none, it is 0 from the start.
    """

    restitution: Float[Array, "slots *batch"]
    approach_velocity: Float[Array, "slots *batch"]
    peak_force: Float[Array, "slots *batch"]
    peak_command: Float[Array, "slots *batch"]
    excess_variation: Float[Array, "slots *batch"]
    position_shortfall: Float[Array, "slots *batch"]
    duration: Float[Array, "slots *batch"]
    work_in: Float[Array, "slots *batch"]
    work_out: Float[Array, "slots *batch"]
    trajectory_error: Float[Array, "slots *batch"]
    force_delay: Float[Array, "slots *batch"]
    status: Int[Array, "slots *batch"]
    ticks: Int[Array, "slots *batch"]


class Swings(NamedTuple):
    """F_c of the contact under way [N]: its last value, the highest and the lowest so far, and its total
    variation; all of them begin with the 0 before the contact."""

    last: Float[Array, "*batch"]
    highest: Float[Array, "*batch"]
    lowest: Float[Array, "*batch"]
    variation: Float[Array, "*batch"]


class Watch(NamedTuple):
    """The contact under way. `elapsed` [ticks] since it began, 0 before; whether it is `over`; approach and
    rebound speed [m/s]; peaks [N]; the real force at the last two ticks [N]; ticks with and since a touch;
    works [J] and the command's swings, where followed; the largest shortfall of the position command [m],
    where it has limits; between two surfaces also the side (1 or -1), |F_c| of the last tick and what was
    left of it when the last contact was over [N]; where the run is probed, x_d beside the reference."""

    elapsed: Float[Array, "*batch"]
    over: Bool[Array, "*batch"]
    approach: Float[Array, "*batch"]
    rebound: Float[Array, "*batch"]
    peak_force: Float[Array, "*batch"]
    peak_command: Float[Array, "*batch"]
    recent: tuple[Array, Array]
    touched: Float[Array, "*batch"]
    quiet: Float[Array, "*batch"]
    works: tuple[Array, ...]
    swings: Swings | None
    shortfall: Float[Array, "*batch"] | None
    side: Float[Array, "*batch"] | None
    command: Float[Array, "*batch"] | None
    left: Float[Array, "*batch"] | None
    deviation: Deviation | None


class Rules(NamedTuple):
    """When a contact is over, per lane: `quiet` ticks without force, the command faded below `level` [N] or
    `patience` ticks without force waited."""

    quiet: Float[Array, "*batch"]
    patience: Float[Array, "*batch"]
    level: Float[Array, "*batch"]


def build_rules(scenario: Scenario) -> Rules:
    """h = tau_f + 20 sensor time constants + 2 T without force; 0.1 s more for the command to fade."""
    sensor, period = scenario.force_sensor, scenario.control_period
    quiet = jnp.floor((sensor.delay + 20 * sensor.time_constant) / period + (2 + 1e-9)) + 1
    level = 3 * sensor.noise_std + jnp.abs(sensor.bias) + sensor.quantum
    return Rules(quiet, quiet + jnp.ceil(LONGEST_FADING / period), level)


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


def fresh_watch(loop: Loop, like: Array) -> Watch:
    """Nothing has touched yet, nor for long."""
    zeros = jnp.zeros_like(like)
    return Watch(
        elapsed=zeros,
        over=jnp.zeros(like.shape, bool),
        approach=zeros,
        rebound=zeros,
        peak_force=zeros,
        peak_command=zeros,
        recent=(zeros, zeros),
        touched=zeros,
        quiet=zeros + 1e6,
        works=(zeros, zeros) if loop.energies else (),
        swings=Swings(zeros, zeros, zeros, zeros) if loop.chatter else None,
        shortfall=zeros if loop.has_limits else None,
        side=zeros + 1 if loop.is_two_sided else None,
        command=zeros if loop.is_two_sided else None,
        left=zeros if loop.is_two_sided else None,
        deviation=no_deviation(like) if loop.probed else None,
    )


def observe(
    loop: Loop,
    constants: Constants,
    rules: Rules,
    watch: Watch,
    signals: Signals,
    plant_signals: PlantSignals,
    command: Array,
    shortfall: Array | None,
    probe: Probe | None = None,
) -> Watch:
    """Follow the contact through one tick; `command` is F_c, `shortfall` that of `Plant`, `probe` that of
    this contact."""
    clearance = constants.clearance
    velocity, position = signals.velocity_desired, signals.position_desired
    speed, force, magnitude = jnp.abs(velocity), jnp.abs(plant_signals.force), jnp.abs(command)
    touching = force > 0
    if loop.has_force_noise or loop.has_force_bias:
        starts = touching | (deflection(position, clearance) != 0)
    elif watch.left is not None:
        # What is left of the last contact's command does not begin the next one.
        starts = touching | (magnitude > watch.left)
    else:
        starts = touching | (magnitude > 0)
    fresh = watch.elapsed == 0
    begun = ~fresh | starts
    if watch.side is not None:
        begun = begun & ~watch.over
        near = jnp.where(position > -clearance / 2, 1, -1).astype(velocity.dtype)
        side = jnp.where(fresh, near, watch.side)
        away = side * velocity < 0
    else:
        side, away = None, velocity < 0
    peak_command = jnp.maximum(watch.peak_command, magnitude)
    quiet = jnp.where(touching, 0, watch.quiet + 1)
    faded = magnitude <= jnp.maximum(FADED * peak_command, rules.level)
    ends = begun & away & (quiet >= rules.quiet) & (faded | (quiet >= rules.patience))
    if plant_signals.peak is not None:
        peak_force = plant_signals.peak
    else:
        # The force of a motion in jumps is constant between them.
        peak_force = force if loop.first_break == 0 else _peak(*watch.recent, force)
    works = watch.works
    if plant_signals.works is not None:
        works = works[0] + plant_signals.works[0], works[1] + plant_signals.works[1]
    lasts = begun & ~watch.over
    largest = watch.shortfall
    if largest is not None and shortfall is not None:
        largest = jnp.where(lasts, jnp.maximum(largest, shortfall), largest)
    deviation = watch.deviation
    if deviation is not None and probe is not None:
        depth, rate = position, velocity
        if side is not None:
            depth, rate = jnp.where(side > 0, position, -clearance - position), side * velocity
        now = signals.age.astype(velocity.dtype)
        deviation = follow(
            deviation, probe.depth, probe.span, depth, rate, now, constants.control_period, ~watch.over
        )
    return Watch(
        elapsed=jnp.where(begun, watch.elapsed + 1, watch.elapsed),
        over=watch.over | ends,
        # Each speed stops being followed at its event; the approach's is that of the tick before.
        approach=jnp.where(begun | watch.over, watch.approach, speed),
        rebound=jnp.where(watch.over, watch.rebound, speed),
        peak_force=jnp.maximum(watch.peak_force, peak_force),
        peak_command=peak_command,
        recent=(watch.recent[1], force),
        touched=jnp.where(touching, watch.touched + 1, watch.touched),
        quiet=quiet,
        works=works,
        swings=watch.swings and _swing(watch.swings, command, lasts, ends),
        shortfall=largest,
        side=side,
        command=magnitude if loop.is_two_sided else None,
        left=watch.left,
        deviation=deviation,
    )


def judge(scenario: Scenario, watch: Watch, age: Array) -> Array:
    """Status of the contact under way, `age` ticks into its run: OK, also while it goes on."""
    period = scenario.control_period
    crossing = jnp.where(jnp.isfinite(scenario.clearance), 10 * scenario.clearance / scenario.velocity, 0)
    limit = scenario.time_limit / period
    waiting = (watch.elapsed == 0) & (age.astype(period.dtype) > limit + crossing / period)
    late = (watch.elapsed > limit) | waiting
    status = jnp.where(late & ~watch.over, TIMEOUT, OK)
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
    """Enter the contacts that are `over` at their `index`; `ticks` have run by now, and the law estimates a
    `force_delay` [s], or none."""
    period = scenario.control_period
    none = jnp.zeros_like(period)
    work_in, work_out = watch.works or (none, none)
    excess = none
    if watch.swings is not None:
        excess = watch.swings.variation / 2 - (watch.swings.highest - watch.swings.lowest)
    values = Metrics(
        restitution=watch.rebound / jnp.where(watch.approach > 0, watch.approach, jnp.nan),
        approach_velocity=watch.approach,
        peak_force=watch.peak_force,
        peak_command=watch.peak_command,
        excess_variation=excess,
        position_shortfall=none if watch.shortfall is None else watch.shortfall,
        duration=watch.touched * period,
        work_in=work_in,
        work_out=work_out,
        trajectory_error=none if watch.deviation is None else root_mean_square(watch.deviation),
        force_delay=none if force_delay is None else force_delay,
        status=status,
        ticks=ticks,
    )
    slots = metrics.restitution.shape[0]
    slot = jnp.arange(slots, dtype=index.dtype).reshape(-1, *[1] * index.ndim)
    here = (slot == index[None]) & over[None]
    entered = Metrics(*(jnp.where(here, v[None], m) for v, m in zip(values, metrics, strict=True)))
    # What is not followed still is what it was before any contact: no work in every turn-over.
    if watch.shortfall is None:
        entered = entered._replace(position_shortfall=metrics.position_shortfall)
    if watch.deviation is None:
        entered = entered._replace(trajectory_error=metrics.trajectory_error)
    if force_delay is None:
        entered = entered._replace(force_delay=metrics.force_delay)
    return entered


def _swing(swings: Swings, command: Array, lasts: Array, ends: Array) -> Swings:
    """One tick further, where the contact `lasts`; where it `ends` with this tick, the command is 0 next."""
    step = jnp.abs(command - swings.last) + jnp.where(ends, jnp.abs(command), 0)
    return Swings(
        last=jnp.where(lasts, command, swings.last),
        highest=jnp.where(lasts & (command > swings.highest), command, swings.highest),
        lowest=jnp.where(lasts & (command < swings.lowest), command, swings.lowest),
        variation=swings.variation + jnp.where(lasts, step, 0),
    )


def _peak(before, middle, now):
    """Largest force of the last period: the vertex of the parabola through three samples, if there is one."""
    bend = 2 * middle - before - now
    peaks = (middle >= before) & (middle >= now) & (bend > 0) & (before > 0) & (now > 0)
    vertex = middle + (now - before) ** 2 / (8 * jnp.where(peaks, bend, 1))
    return jnp.where(peaks, vertex, now)
