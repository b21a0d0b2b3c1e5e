"""Record of the current contact from tick to tick: begin, end, speeds, forces and energies.

It follows the real contact (`PlantSignals`) and the force command; notebooks/guide/model.md, section 2, says
when a contact begins and when it is over.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.contact.laws import deflection
from jaxhil.laws.simulation_base import Signals
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.probe import Deviation, initial_deviation
from jaxhil.simulation.scenario import Scenario

MAX_DECAY_WAIT = 0.1  # s; longest wait for the command to decay, which a noisy command never does
COMMAND_DECAY_RATIO = 1e-6  # of the command's peak; below it the command has decayed
DIVERGENCE_SPEED_RATIO = 1e3  # times the first approach speed; above it the run has diverged


class CommandVariation(NamedTuple):
    """F_c in the current contact; all values begin with the 0 before the contact."""

    last: Float[Array, "*batch"]  # last value [N]
    highest: Float[Array, "*batch"]  # highest value so far [N]
    lowest: Float[Array, "*batch"]  # lowest value so far [N]
    variation: Float[Array, "*batch"]  # total variation so far [N]


class Watch(NamedTuple):
    """Record of the current contact."""

    elapsed: Float[Array, "*batch"]  # ticks since the contact began; 0 before
    over: Bool[Array, "*batch"]  # whether the contact is over, or the run has diverged
    approach: Float[Array, "*batch"]  # speed of the numerical model before the contact [m/s]
    rebound: Float[Array, "*batch"]  # speed of the numerical model now [m/s]
    peak_force: Float[Array, "*batch"]  # largest real force [N]
    peak_command: Float[Array, "*batch"]  # largest |F_c| [N]
    recent: tuple[Array, Array]  # real force at the last two ticks [N]
    in_contact: Float[Array, "*batch"]  # ticks with a real force
    measured: Bool[Array, "*batch"]  # whether the force sensor has read a force
    quiet: Float[Array, "*batch"]  # ticks since the last real force, or since a contact began without one
    works: tuple[Array, ...]  # work done on the mechanism and work returned by it [J]; empty unless recorded
    swings: CommandVariation | None  # swings of the command; None unless recorded
    shortfall: (
        Float[Array, "*batch"] | None
    )  # largest change of the position command by limits [m]; None without limits
    side: Float[Array, "*batch"] | None  # side of the surface, 1 or -1; None with one surface
    command: Float[Array, "*batch"] | None  # |F_c| of the last tick [N]; None with one surface
    # |F_c| that remained at the end of the last contact [N]; None with one surface
    left: Float[Array, "*batch"] | None
    deviation: Deviation | None  # deviation of x_d from the ideal contact; None without a probe


class ContactEndConditions(NamedTuple):
    """Conditions for the end of a contact."""

    quiet: Float[Array, "*batch"]  # least ticks without a real force
    # ticks without a real force after which the command need not have decayed
    max_quiet: Float[Array, "*batch"]
    fastest: Float[Array, "*batch"]  # speed beyond which the run has diverged [m/s]
    clearance: Float[Array, "*batch"]  # distance between two surfaces [m]; infinite for one surface


def build_end_conditions(scenario: Scenario) -> ContactEndConditions:
    """Return the conditions for the end of a contact.

    A contact ends tau_f + 20 sensor time constants + 2 T after the last real force, or up to 0.1 s later,
    until the command has decayed.
    """
    sensor, period = scenario.force_sensor, scenario.control_period
    quiet = jnp.floor((sensor.delay + 20 * sensor.time_constant) / period + (2 + 1e-9)) + 1
    patience = quiet + jnp.ceil(MAX_DECAY_WAIT / period)
    return ContactEndConditions(
        quiet, patience, DIVERGENCE_SPEED_RATIO * scenario.velocity, scenario.clearance
    )


def fresh_watch(loop: Loop, like: Array) -> Watch:
    """Return the record before a contact, long after any force."""
    zeros = jnp.zeros_like(like)
    return Watch(
        elapsed=zeros,
        over=jnp.zeros(like.shape, bool),
        approach=zeros,
        rebound=zeros,
        peak_force=zeros,
        peak_command=zeros,
        recent=(zeros, zeros),
        in_contact=zeros,
        measured=jnp.zeros(like.shape, bool),
        quiet=zeros + 1e6,
        works=(zeros, zeros) if loop.energies else (),
        swings=CommandVariation(zeros, zeros, zeros, zeros) if loop.chatter else None,
        shortfall=zeros if loop.has_limits else None,
        side=zeros + 1 if loop.is_two_sided else None,
        command=zeros if loop.is_two_sided else None,
        left=zeros if loop.is_two_sided else None,
        deviation=initial_deviation(like) if loop.probed else None,
    )


def record_contact(
    loop: Loop,
    rules: ContactEndConditions,
    watch: Watch,
    signals: Signals,
    plant_signals: PlantSignals,
    command: Array,
    shortfall: Array | None,
) -> Watch:
    """Update the record of the contact; `command` is F_c [N], `shortfall` that of `Plant` (stage 6)."""
    speed, magnitude = jnp.abs(signals.velocity_desired), jnp.abs(command)
    force = jnp.abs(plant_signals.force)
    touching = force > 0
    if plant_signals.touched is not None:
        # A touch may begin and end between two samples.
        touching = touching | ((watch.recent[1] == 0) & (plant_signals.touched > 0))
    begun = _has_begun(loop, rules, watch, signals, touching, magnitude)
    side = _choose_side(rules, watch, signals)
    peak_command = jnp.maximum(watch.peak_command, magnitude)
    # The hardware follows the numerical model with a delay.
    quiet = jnp.where(touching | (begun & (watch.elapsed == 0)), 0, watch.quiet + 1)
    touched = plant_signals.touched
    in_contact = jnp.where(touching, watch.in_contact + 1, watch.in_contact)
    in_contact = in_contact if touched is None else watch.in_contact + touched
    ends = begun & _has_ended(rules, signals, side, quiet, magnitude, peak_command)
    lasts = begun & ~watch.over
    return Watch(
        elapsed=jnp.where(begun, watch.elapsed + 1, watch.elapsed),
        # A diverged run is over at once, even if its speed decreases again.
        over=watch.over | ends | (speed > rules.fastest),
        # The approach speed is that of the tick before the onset, the rebound speed that at the end.
        approach=jnp.where(begun | watch.over, watch.approach, speed),
        rebound=jnp.where(watch.over, watch.rebound, speed),
        peak_force=jnp.maximum(watch.peak_force, _peak_force(loop, watch, plant_signals, force)),
        peak_command=peak_command,
        recent=(watch.recent[1], force),
        in_contact=in_contact,
        measured=watch.measured | ((in_contact > 0) & (signals.force_measured != 0)),
        quiet=quiet,
        works=tuple(total + work for total, work in zip(watch.works, plant_signals.works or (), strict=True)),
        swings=watch.swings and _update_variation(watch.swings, command, lasts, ends),
        shortfall=_largest_shortfall(watch, shortfall, lasts),
        side=side,
        command=magnitude if loop.is_two_sided else None,
        left=watch.left,
        deviation=watch.deviation,
    )


def _has_begun(loop, rules, watch, signals, touching, magnitude):
    """Return whether the contact has begun: by a force or, with a noisy or biased sensor, a penetration."""
    if loop.reads_always:
        starts = touching | (deflection(signals.position_desired, rules.clearance) != 0)
    elif watch.left is not None:
        # A command that remains from the last contact does not begin the next one.
        starts = touching | (magnitude > watch.left)
    else:
        starts = touching | (magnitude > 0)
    fresh = watch.elapsed == 0
    begun = ~fresh | starts
    return begun if watch.side is None else begun & ~watch.over


def _choose_side(rules, watch, signals):
    """Return the nearer of two surfaces, constant after the contact begins; None with one surface."""
    if watch.side is None:
        return None
    position = signals.position_desired
    return jnp.where(watch.elapsed == 0, _nearer_side(rules, position), watch.side)


def _nearer_side(rules, position):
    """Return the side of the nearer of two surfaces, 1 or -1."""
    return jnp.where(position > -rules.clearance / 2, 1, -1).astype(position.dtype)


def _has_ended(rules, signals, side, quiet, magnitude, peak_command):
    """Return whether a contact ends.

    It ends if the model moves away, there was no force for long enough, and the command has decayed. No
    threshold depends on the noise: a command that is small by chance while its mean is not would end the
    contact before its whole impulse has acted.
    """
    velocity = signals.velocity_desired
    faded = (magnitude <= COMMAND_DECAY_RATIO * peak_command) | (quiet >= rules.max_quiet)
    if side is None:
        return (velocity < 0) & (quiet >= rules.quiet) & faded
    faded |= _nearer_side(rules, signals.position_desired) != side
    return (side * velocity < 0) & (quiet >= rules.quiet) & faded


def _peak_force(loop, watch, plant_signals, force):
    """Return the largest real force [N] since the last tick."""
    if plant_signals.peak is not None:
        return plant_signals.peak
    # If the position itself jumps at the ticks, the force is constant between them.
    return force if loop.discontinuity_order == 0 else _parabola_peak(watch.recent[0], watch.recent[1], force)


def _largest_shortfall(watch, shortfall, lasts):
    """Return the largest change of the position command by limits [m]; None without limits."""
    if watch.shortfall is None or shortfall is None:
        return watch.shortfall
    return jnp.where(lasts, jnp.maximum(watch.shortfall, shortfall), watch.shortfall)


def _update_variation(
    swings: CommandVariation, command: Array, lasts: Array, ends: Array
) -> CommandVariation:
    """Update the swings of the command.

    Lanes whose contact `lasts` are updated. The command counts as 0 after the tick at which the contact
    `ends`.
    """
    step = jnp.abs(command - swings.last) + jnp.where(ends, jnp.abs(command), 0)
    return CommandVariation(
        last=jnp.where(lasts, command, swings.last),
        highest=jnp.where(lasts & (command > swings.highest), command, swings.highest),
        lowest=jnp.where(lasts & (command < swings.lowest), command, swings.lowest),
        variation=swings.variation + jnp.where(lasts, step, 0),
    )


def _parabola_peak(before, middle, now):
    """Return the largest force of the last period, at the peak of the parabola through three samples."""
    bend = 2 * middle - before - now
    peaks = (middle >= before) & (middle >= now) & (bend > 0) & (before > 0) & (now > 0)
    vertex = middle + (now - before) ** 2 / (8 * jnp.where(peaks, bend, 1))
    return jnp.where(peaks, vertex, now)
