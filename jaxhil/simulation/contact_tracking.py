"""Record of the current contact, updated at every tick: beginning, end, speeds, forces and work.

The record follows from the real contact (`PlantSignals`) and from the force command. Section 2 of
notebooks/guide/model.md defines when a contact begins and when it ends.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxhil.contact.laws import deflection
from jaxhil.laws.simulation_base import Signals
from jaxhil.simulation.contact_force import PlantSignals
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.probe import Deviation, initial_deviation
from jaxhil.simulation.scenario import Scenario, add_jitter

MAX_DECAY_WAIT = 0.1  # longest wait for the force command to decay, because a noisy command never decays [s]
COMMAND_DECAY_RATIO = 1e-6  # fraction of its peak below which a force command has decayed [1]
DIVERGENCE_SPEED_RATIO = 1e3  # multiple of the first approach speed above which a run has diverged [1]


class CommandVariation(NamedTuple):
    """Range and total variation of the force command F_c since the contact's start, where F_c is 0."""

    last: Float[Array, "*batch"]  # last value [N]
    highest: Float[Array, "*batch"]  # highest value so far [N]
    lowest: Float[Array, "*batch"]  # lowest value so far [N]
    variation: Float[Array, "*batch"]  # total variation so far [N]


class ContactTracker(NamedTuple):
    """Record of the current contact, from the end of the previous contact to the current tick."""

    elapsed: Float[Array, "*batch"]  # number of ticks since the contact began; 0 before
    has_ended: Bool[Array, "*batch"]  # whether the contact has ended normally or by divergence
    approach: Float[Array, "*batch"]  # speed of the numerical model before the contact [m/s]
    rebound: Float[Array, "*batch"]  # speed of the numerical model at the current tick [m/s]
    peak_force: Float[Array, "*batch"]  # largest real force so far [N]
    peak_command: Float[Array, "*batch"]  # largest |force command| so far [N]
    recent_forces: tuple[Array, Array]  # real force at the last two ticks [N]
    in_contact: Float[Array, "*batch"]  # duration of the real force so far [control periods]
    has_reading: Bool[Array, "*batch"]  # whether the force sensor has read a force
    # number of ticks since the last real force or, without one in this contact, since the contact's beginning
    force_free_ticks: Float[Array, "*batch"]
    work: tuple[Array, ...]  # work done on the mechanism and work returned by it [J]; empty unless recorded
    command_variation: CommandVariation | None  # variation of the force command; None unless recorded
    # largest change of the position command by the motion simulator's limits so far [m]; None without limits
    shortfall: Float[Array, "*batch"] | None
    side: Float[Array, "*batch"] | None  # side of the touched surface, 1 or -1; None with one surface
    command: Float[Array, "*batch"] | None  # |force command| at the last tick [N]; None with one surface
    # |force command| at the end of the previous contact [N]; None with one surface
    remaining_command: Float[Array, "*batch"] | None
    deviation: Deviation | None  # deviation of the model from the ideal contact; None without a probe


class ContactEndConditions(NamedTuple):
    """Conditions for the end of a contact."""

    force_free_ticks: Float[Array, "*batch"]  # minimum number of ticks without a real force
    # number of ticks without a real force after which the contact ends even if the command has not decayed
    max_force_free_ticks: Float[Array, "*batch"]
    divergence_speed: Float[Array, "*batch"]  # speed above which the run has diverged [m/s]
    clearance: Float[Array, "*batch"]  # distance between two surfaces [m]; infinite for one surface


def build_end_conditions(scenario: Scenario) -> ContactEndConditions:
    """Compute the conditions for the end of a contact from the delays of the rig.

    After the last real force, the contact lasts for the delay of the force sensor, plus 20 time constants of
    the sensor's lag, plus two control periods. If the force command has not decayed by then, the contact ends
    when the force command has decayed, but at most 0.1 s later.
    """
    sensor, period = scenario.force_sensor, scenario.control_period
    delay = add_jitter(sensor.delay + 20 * sensor.time_constant, scenario.timing)
    force_free_ticks = jnp.floor(delay / period + (2 + 1e-9)) + 1
    return ContactEndConditions(
        force_free_ticks=force_free_ticks,
        max_force_free_ticks=force_free_ticks + jnp.ceil(MAX_DECAY_WAIT / period),
        divergence_speed=DIVERGENCE_SPEED_RATIO * scenario.velocity,
        clearance=scenario.clearance,
    )


def start_tracking(loop: Loop, like: Array) -> ContactTracker:
    """Return the record before a contact, for a rig on which no force has acted for a long time."""
    zeros = jnp.zeros_like(like)
    return ContactTracker(
        elapsed=zeros,
        has_ended=jnp.zeros(like.shape, bool),
        approach=zeros,
        rebound=zeros,
        peak_force=zeros,
        peak_command=zeros,
        recent_forces=(zeros, zeros),
        in_contact=zeros,
        has_reading=jnp.zeros(like.shape, bool),
        force_free_ticks=zeros + 1e6,
        work=(zeros, zeros) if loop.energies else (),
        command_variation=CommandVariation(zeros, zeros, zeros, zeros) if loop.chatter else None,
        shortfall=zeros if loop.has_limits else None,
        side=zeros + 1 if loop.is_two_sided else None,
        command=zeros if loop.is_two_sided else None,
        remaining_command=zeros if loop.is_two_sided else None,
        deviation=initial_deviation(like) if loop.probed else None,
    )


def record_contact(
    loop: Loop,
    rules: ContactEndConditions,
    tracker: ContactTracker,
    signals: Signals,
    plant_signals: PlantSignals,
    command: Array,
    shortfall: Array | None,
) -> ContactTracker:
    """Return the record of the current contact, updated with the current tick.

    Args:
        loop: Structure of the loop.
        rules: Conditions for the end of a contact.
        tracker: Record up to the previous tick.
        signals: Inputs of the compensator.
        plant_signals: Real forces in the last sampling interval.
        command: Force command F_c [N].
        shortfall: Change of the position command by the motion simulator's limits [m]; None without limits.
    """
    speed, magnitude = jnp.abs(signals.velocity_desired), jnp.abs(command)
    force = jnp.abs(plant_signals.force)
    touching = force > 0
    if plant_signals.contact_time is not None:
        # A contact may begin and end between two samples, so that no sample has a force.
        touching = touching | ((tracker.recent_forces[1] == 0) & (plant_signals.contact_time > 0))
    begun = _has_begun(loop, rules, tracker, signals, touching, magnitude)
    side = _choose_side(rules, tracker, signals)
    peak_command = jnp.maximum(tracker.peak_command, magnitude)
    # A contact may begin at the numerical model, before the delayed hardware touches. The count of ticks
    # without a force then starts when the contact begins.
    force_free_ticks = jnp.where(touching | (begun & (tracker.elapsed == 0)), 0, tracker.force_free_ticks + 1)
    contact_time = plant_signals.contact_time
    in_contact = jnp.where(touching, tracker.in_contact + 1, tracker.in_contact)
    in_contact = in_contact if contact_time is None else tracker.in_contact + contact_time
    ends = begun & _has_ended(rules, signals, side, force_free_ticks, magnitude, peak_command)
    lasts = begun & ~tracker.has_ended
    variation = tracker.command_variation
    return ContactTracker(
        elapsed=jnp.where(begun, tracker.elapsed + 1, tracker.elapsed),
        # A run that has diverged ends at this tick, even if the speed would decrease again.
        has_ended=tracker.has_ended | ends | (speed > rules.divergence_speed),
        # The approach speed is taken at the tick before the contact, the rebound speed at the contact's end.
        approach=jnp.where(begun | tracker.has_ended, tracker.approach, speed),
        rebound=jnp.where(tracker.has_ended, tracker.rebound, speed),
        peak_force=jnp.maximum(tracker.peak_force, _peak_force(loop, tracker, plant_signals, force)),
        peak_command=peak_command,
        recent_forces=(tracker.recent_forces[1], force),
        in_contact=in_contact,
        has_reading=tracker.has_reading | ((in_contact > 0) & (signals.force_measured != 0)),
        force_free_ticks=force_free_ticks,
        work=tuple(total + work for total, work in zip(tracker.work, plant_signals.work or (), strict=True)),
        command_variation=variation and _update_variation(variation, command, lasts, ends),
        shortfall=_largest_shortfall(tracker, shortfall, lasts),
        side=side,
        command=magnitude if loop.is_two_sided else None,
        remaining_command=tracker.remaining_command,
        deviation=tracker.deviation,
    )


def _has_begun(loop, rules, tracker, signals, touching, magnitude):
    """Return whether the contact has begun.

    A contact begins with a real force or with a force command. If the sensor has noise or bias, there is
    always a force command; then the penetration of the numerical model is used instead.
    """
    if loop.reads_always:
        starts = touching | (deflection(signals.position_desired, rules.clearance) != 0)
    elif tracker.remaining_command is not None:
        # A force command that remains from the previous contact does not begin the next contact.
        starts = touching | (magnitude > tracker.remaining_command)
    else:
        starts = touching | (magnitude > 0)
    fresh = tracker.elapsed == 0
    begun = ~fresh | starts
    return begun if tracker.side is None else begun & ~tracker.has_ended


def _choose_side(rules, tracker, signals):
    """Return the side of the surface nearer to the model, fixed during a contact; None with one surface."""
    if tracker.side is None:
        return None
    position = signals.position_desired
    return jnp.where(tracker.elapsed == 0, _nearer_side(rules, position), tracker.side)


def _nearer_side(rules, position):
    """Return the side of the surface that is nearer to a position, 1 or -1."""
    return jnp.where(position > -rules.clearance / 2, 1, -1).astype(position.dtype)


def _has_ended(rules, signals, side, force_free_ticks, magnitude, peak_command):
    """Return whether the contact ends at this tick.

    The contact ends if the numerical model moves away from the surface, the last real force was long enough
    ago, and the force command has decayed. The threshold of the decay does not depend on the sensor noise.
    Otherwise, a noisy command that is small by chance could end the contact before its whole impulse has
    acted.
    """
    velocity = signals.velocity_desired
    faded = (magnitude <= COMMAND_DECAY_RATIO * peak_command) | (
        force_free_ticks >= rules.max_force_free_ticks
    )
    if side is None:
        return (velocity < 0) & (force_free_ticks >= rules.force_free_ticks) & faded
    faded |= _nearer_side(rules, signals.position_desired) != side
    return (side * velocity < 0) & (force_free_ticks >= rules.force_free_ticks) & faded


def _peak_force(loop, tracker, plant_signals, force):
    """Return the largest real force [N] since the previous tick."""
    if plant_signals.peak is not None:
        return plant_signals.peak
    # If the position jumps at the ticks, the force is constant between two ticks.
    return force if loop.discontinuity_order == 0 else _parabola_peak(tracker.recent_forces, force)


def _largest_shortfall(tracker, shortfall, lasts):
    """Return the largest shortfall [m], updated in lanes whose contact `lasts`; None without limits."""
    if tracker.shortfall is None or shortfall is None:
        return tracker.shortfall
    return jnp.where(lasts, jnp.maximum(tracker.shortfall, shortfall), tracker.shortfall)


def _update_variation(
    before: CommandVariation, command: Array, lasts: Array, ends: Array
) -> CommandVariation:
    """Add the current tick to the variation of the force command in lanes whose contact `lasts`.

    If a contact `ends` at this tick, add the step of the command from its last value to 0 as well.
    """
    step = jnp.abs(command - before.last) + jnp.where(ends, jnp.abs(command), 0)
    return CommandVariation(
        last=jnp.where(lasts, command, before.last),
        highest=jnp.where(lasts & (command > before.highest), command, before.highest),
        lowest=jnp.where(lasts & (command < before.lowest), command, before.lowest),
        variation=before.variation + jnp.where(lasts, step, 0),
    )


def _parabola_peak(recent_forces, now):
    """Return the largest force [N] of the last period, from a parabola through the last three samples."""
    before, middle = recent_forces
    bend = 2 * middle - before - now
    peaks = (middle >= before) & (middle >= now) & (bend > 0) & (before > 0) & (now > 0)
    vertex = middle + (now - before) ** 2 / (8 * jnp.where(peaks, bend, 1))
    return jnp.where(peaks, vertex, now)
