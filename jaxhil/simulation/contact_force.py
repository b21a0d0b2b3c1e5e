"""Real contact in one sampling interval, for slow motion: force, peak force, work, and the sensor's lag.

A sampling interval lasts from one tick to the next. Within an interval, the motion simulator moves smoothly
(`jaxhil.simulation.motion_simulator`). The instant at which the force sensor samples divides the interval
into two sections.

The force at the sampling instant is computed from the exact motion. Peak force, work and sensor lag depend on
the motion between samples. In each section, this motion is approximated by the cubic Hermite polynomial
through the exact positions and velocities at both ends. The module `jaxhil.simulation.contact_in_cells` uses
the exact motion instead, for faster motion simulators and contacts.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters, compute_two_sided_force, deflection
from jaxhil.laws.shared.ring_buffer import look_back
from jaxhil.simulation.cells import IntervalInputs
from jaxhil.simulation.motion_simulator import apply_row
from jaxhil.simulation.sensors import apply_lag, lag_decay

NEWTON_STEPS = 3  # number of Newton steps from the root of the secant
PARABOLAS_PER_SECTION = 2  # number of parabolas that approximate the force in a section, for the sensor's lag
# Nodes and weights of three-point quadrature on (0, 1).
GAUSS_LEGENDRE = ((0.5 - 0.15**0.5, 5 / 18), (0.5, 4 / 9), (0.5 + 0.15**0.5, 5 / 18))


class MotionSample(NamedTuple):
    """Position and velocity of the real mechanism at one instant."""

    position: Float[Array, "*batch"]  # [m]
    velocity: Float[Array, "*batch"]  # [m/s]


class SamplingInterval(NamedTuple):
    """Motion of the real mechanism from one tick to the next."""

    sample: MotionSample  # motion at the instant at which the force is sampled
    # motion at the interval's start (right limit) and end (left limit); None if only the sample is used
    start: Any
    end: Any
    # inputs of the exact motion between the samples; None if the motion is not divided into cells
    interval_inputs: IntervalInputs | None


class PlantSignals(NamedTuple):
    """Force of the real contact in a sampling interval, without the effects of the sensors."""

    force: Float[Array, "*batch"]  # contact force at the sampling instant [N]
    # work done on the mechanism and work returned by it [J]; None unless energies are recorded
    work: tuple[Array, Array] | None
    # peak force in the interval [N]; None if the peak force follows from the samples
    peak: Float[Array, "*batch"] | None
    # duration of contact since the previous sample [periods]; None if samples in contact are counted instead
    contact_time: Float[Array, "*batch"] | None


class IntervalContact(NamedTuple):
    """Real contact in a sampling interval: forces, sensor readings, and state of the contact law."""

    plant_signals: PlantSignals  # force without the effects of the sensors
    # output of the force sensor's lag at the sampling instant [N]; None for a sensor without lag
    reading: Float[Array, "*batch"] | None
    lagged: Array  # output of the force sensor's lag at the interval's end [N]
    last: "ContactSample"  # contact at the sampling instant
    # duration of contact after the sample [periods]; None if samples in contact are counted instead
    contact_time: Float[Array, "*batch"] | None
    law: tuple[Array, ...]  # state of the contact law at the interval's end


class Surfaces(NamedTuple):
    """Contact law, its parameters and its state at one surface or two opposite surfaces."""

    law: ContactLaw  # contact law
    parameters: ContactParameters  # parameters of the contact law
    state: tuple[Any, ...]  # state of the contact law
    clearance: Array | None  # distance between two surfaces [m]; None for one surface

    def force(self, motion: MotionSample) -> tuple[Array, tuple[Any, ...]]:
        """Return the signed contact force [N] for this position and velocity, and the law's next state."""
        return compute_two_sided_force(
            self.law, self.parameters, self.state, motion.position, motion.velocity, self.clearance
        )

    def advance(self, start: MotionSample, end: MotionSample, duration: Array, s: Any = 1) -> "Surfaces":
        """Return a copy with the contact law's state at the fraction `s` of a smooth section of motion.

        Args:
            start: Motion at the section's start, where the contact law has the state of `self`.
            end: Motion at the section's end.
            duration: Duration of the section [s].
            s: Fraction of the section, from 0 to 1.
        """
        if not self.law.has_memory:
            return self
        side, surface = self.side(start, end)
        turn = jnp.minimum(_find_turning_point(start, end, duration, side), s)
        state = self.state
        for motion in (
            interpolate_motion(start, end, duration, turn),
            interpolate_motion(start, end, duration, s),
        ):
            depth = side * (motion.position - surface)
            _, state = self.law.step(self.parameters, state, depth, side * motion.velocity)
        return self._replace(state=state)

    def side(self, start: MotionSample, end: MotionSample) -> tuple[Array, Array]:
        """Return side (1 or -1; 0 without touch) and position [m] of the surface that the motion touches."""
        signed = deflection(start.position, self.clearance)
        side = jnp.sign(jnp.where(signed == 0, deflection(end.position, self.clearance), signed))
        return side, jnp.zeros_like(side) if self.clearance is None else jnp.where(
            side < 0, -self.clearance, 0
        )

    def sample(self, motion: MotionSample, force: Array) -> "ContactSample":
        """Return the `ContactSample` for this position, velocity and contact force [N]."""
        if self.clearance is None:
            onset_force = self.law.onset_force(self.parameters, motion.velocity)
            return ContactSample(motion.position, force, onset_force, jnp.ones_like(onset_force))
        far = -self.clearance - motion.position
        beyond = jnp.where(far > motion.position, far, motion.position)
        side = jnp.where(far > motion.position, -1, 1).astype(far.dtype)
        onset_force = side * self.law.onset_force(self.parameters, side * motion.velocity)
        return ContactSample(beyond, force, onset_force, side)


class ContactSample(NamedTuple):
    """Real contact at one instant, at the nearer surface."""

    distance: Float[Array, "*batch"]  # penetration into the nearer surface [m]; negative without contact
    force: Float[Array, "*batch"]  # contact force [N]
    onset_force: Float[Array, "*batch"]  # limit of the force as the penetration goes to 0 [N]
    side: Float[Array, "*batch"]  # side of the nearer surface, 1 or -1

    def position(self, clearance: Array | None) -> Array:
        """Return the position of the mechanism [m]; `clearance` is the distance between two surfaces [m]."""
        if clearance is None:
            return self.distance
        # The distance of the sample before a run (`no_contact`) is arbitrary: limit it to half the clearance.
        distance = jnp.maximum(self.distance, -clearance / 2)
        return jnp.where(self.side > 0, distance, -clearance - distance)


def no_contact(like: Array) -> ContactSample:
    """Return a `ContactSample` of a mechanism without contact, with the batch shape of `like`."""
    zeros = jnp.zeros_like(like)
    return ContactSample(zeros - 1, zeros, zeros, zeros + 1)


def compute_interval_motion(rows, state, start, end, plane):
    """Return the mechanism's motion in a sampling interval, relative to the surface at `plane` [m]."""

    def motion(position, velocity):
        return MotionSample(
            apply_row(position, state, start, end) - plane, apply_row(velocity, state, start, end)
        )

    sample = motion(rows.position, rows.velocity)
    if rows.start is None:
        return SamplingInterval(sample, None, None, None)
    return SamplingInterval(sample, motion(*rows.start), motion(*rows.end), None)


def read_current_interval(rig, pending, now, age):
    """Return the motion for which the contact is due now, from `pending`, the delay line of motions.

    A motion before the start of the run is 0: the mechanism is at rest at the surface, without a force.
    """
    intervals = rig.delays.contact
    return jax.tree.map(lambda ring: look_back(ring, now, intervals, age >= intervals), pending)


def compute_work_between(before: ContactSample, now: ContactSample) -> tuple[Array, Array]:
    """Return the work done on the mechanism and the work returned by it between two samples [J].

    The result is exact if the force is linear in the penetration.
    """
    depth_0 = jnp.where(before.distance > 0, before.distance, 0)
    depth_1 = jnp.where(now.distance > 0, now.distance, 0)
    force_0 = jnp.where(before.distance > 0, before.force, now.onset_force)
    force_1 = jnp.where(now.distance > 0, now.force, before.onset_force)
    side = jnp.where(now.distance > 0, now.side, before.side)
    work = side * (force_0 + force_1) / 2 * (depth_1 - depth_0)
    return jnp.where(work > 0, work, 0), jnp.where(work > 0, 0, -work)


def compute_work_along(
    surfaces: Surfaces, start: MotionSample, end: MotionSample, duration: Array
) -> tuple[Array, Array]:
    """Return the work done on the mechanism and the work returned by it in a smooth section of motion [J].

    If the force pulls while the penetration decreases, the returned work becomes smaller.
    """
    contact = _find_section_contact(surfaces, start, end, duration)

    def inward(s):
        return contact.side * interpolate_motion(start, end, duration, s).velocity

    inward_begin, inward_end = _find_positive_interval(inward, duration)
    turn = jnp.clip(jnp.where(inward_end < 1, inward_end, inward_begin), contact.begin, contact.end)
    done = returned = jnp.zeros_like(duration)
    for a, b in ((contact.begin, turn), (turn, contact.end)):
        for node, weight in GAUSS_LEGENDRE:
            motion, force = _force_along(surfaces, start, end, duration, a + (b - a) * node)
            work = force * motion.velocity * (weight * (b - a) * duration)
            deeper = contact.side * motion.velocity > 0
            done = done + jnp.where(deeper, work, 0)
            returned = returned - jnp.where(deeper, 0, work)
    return done, returned


def largest_force(
    surfaces: Surfaces, start: MotionSample, end: MotionSample, duration: Array
) -> Float[Array, "*batch"]:
    """Return the largest |force| [N] within a sampling interval.

    The result is the largest of three values: |force| at the start, at the end, and at the vertex of the
    parabola through |force| at both ends and in the middle.
    """

    def magnitude(motion, s):
        return jnp.abs(surfaces.advance(start, end, duration, s).force(motion)[0])

    first, last = magnitude(start, 0), magnitude(end, 1)
    half = magnitude(interpolate_motion(start, end, duration, 0.5), 0.5)
    slope, bend = last - first, first + last - 2 * half
    vertex = jnp.clip(0.5 - slope / (4 * jnp.where(bend < 0, bend, -1)), 0, 1)
    top = magnitude(interpolate_motion(start, end, duration, vertex), vertex)
    highest = jnp.where(first > last, first, last)
    return jnp.where((bend < 0) & (top > highest), top, highest)


def apply_sensor_lag(
    surfaces: Surfaces,
    reading: Float[Array, "*batch"],
    interval: SamplingInterval,
    sample_time: Array,
    duration: Array,
    time_constant: Array,
) -> tuple[Array, Array]:
    """Return the output [N] of a force sensor's lag at the sampling instant and at the interval's end.

    Args:
        surfaces: Contact law, with the state at the interval's start.
        reading: Output of the lag at the interval's start [N].
        interval: Motion of the mechanism.
        sample_time: Time from the interval's start to the sampling instant [s].
        duration: Duration of the interval [s].
        time_constant: Time constant of the lag [s].
    """

    def follow(reading, interval):
        sample = _apply_lag_along(
            surfaces, reading, interval.start, interval.sample, sample_time, time_constant
        )
        rest = duration - sample_time
        at_sample = surfaces.advance(interval.start, interval.sample, sample_time)
        return sample, _apply_lag_along(at_sample, sample, interval.sample, interval.end, rest, time_constant)

    def fade(reading, interval):
        # These are the operations of `follow` without a force, in the same order: the rounding of a lane must
        # not depend on whether other lanes of the batch are in contact.
        sample = reading * lag_decay(sample_time, time_constant)
        return sample, sample * lag_decay(duration - sample_time, time_constant)

    # In most intervals no lane is in contact, and the force is 0.
    motions = interval.sample, interval.start, interval.end
    outside = [deflection(motion.position, surfaces.clearance) == 0 for motion in motions]
    return lax.cond(jnp.all(outside[0] & outside[1] & outside[2]), fade, follow, reading, interval)


def interpolate_motion(start: MotionSample, end: MotionSample, duration: Array, s: Any) -> MotionSample:
    """Interpolate the motion at the fraction `s` of a section by a cubic Hermite polynomial."""
    v_0, v_1 = start.velocity * duration, end.velocity * duration
    displacement = end.position - start.position
    bend, twist = 3 * displacement - 2 * v_0 - v_1, v_0 + v_1 - 2 * displacement
    position = start.position + s * (v_0 + s * (bend + s * twist))
    velocity = v_0 + s * (2 * bend + s * 3 * twist)
    safe = jnp.where(duration > 0, duration, 1)
    return MotionSample(position, jnp.where(duration > 0, velocity / safe, start.velocity))


def _find_turning_point(start, end, duration, side):
    """Return the fraction of a smooth section at which inward motion reverses; 1 without a reversal."""
    first, last = side * start.velocity, side * end.velocity
    turns = (first > 0) & (last < 0)
    # The inward velocity, times the duration, is first + slope s + bend s^2 at the fraction s.
    displacement = side * (end.position - start.position)
    first, last = first * duration, last * duration
    slope, bend = 6 * displacement - 4 * first - 2 * last, 3 * (first + last - 2 * displacement)
    square = jnp.where(turns, slope**2 - 4 * bend * first, 1)
    return jnp.where(turns, 2 * first / jnp.where(turns, jnp.sqrt(square) - slope, 1), 1)


def _force_along(surfaces, start, end, duration, s):
    """Return motion and contact force [N] at the fraction `s` of a smooth section of motion."""
    motion = interpolate_motion(start, end, duration, s)
    force, _ = surfaces.advance(start, end, duration, s).force(motion)
    return motion, force


class _SectionContact(NamedTuple):
    """Beginning and end of the contact in a smooth section of motion."""

    touches: Array  # whether there is contact in the section
    side: Array  # side of the surface, 1 or -1
    begin: Array  # fraction of the section at which the contact begins
    end: Array  # fraction of the section at which the contact ends
    # whether the contact begins, and whether it ends, within the section at zero penetration
    at_surface: tuple[Array, Array]


def _find_section_contact(surfaces, start, end, duration):
    """Find the beginning and the end of the contact in a smooth section of motion.

    The contact lasts while both the penetration and the contact law's `separation_function` are positive.
    `separation_function` becomes negative if the force vanishes while there is still a penetration.
    """
    side, surface = surfaces.side(start, end)

    def depth(s):
        return side * (interpolate_motion(start, end, duration, s).position - surface)

    def separation(s):
        motion = interpolate_motion(start, end, duration, s)
        state = surfaces.advance(start, end, duration, s).state
        return surfaces.law.separation_function(surfaces.parameters, state, depth(s), side * motion.velocity)

    depth_begin, depth_end = _find_positive_interval(depth, duration)
    separation_begin, separation_end = _find_positive_interval(separation, duration)
    contact_begin = jnp.where(depth_begin >= separation_begin, depth_begin, separation_begin)
    contact_end = jnp.where(depth_end <= separation_end, depth_end, separation_end)
    touches = (side != 0) & (contact_begin < contact_end)
    begins_at_surface = (depth_begin > 0) & (depth_begin >= separation_begin)
    ends_at_surface = (depth_end < 1) & (depth_end <= separation_end)
    return _SectionContact(
        touches,
        side,
        jnp.where(touches, contact_begin, 0),
        jnp.where(touches, contact_end, 0),
        (begins_at_surface, ends_at_surface),
    )


def _find_positive_interval(function, like):
    """Return the subinterval of [0, 1] in which a function with at most one change of sign is positive."""
    zeros, ones = jnp.zeros_like(like), jnp.ones_like(like)
    at_0, at_1 = function(zeros), function(ones)
    rises, falls = (at_0 <= 0) & (at_1 > 0), (at_0 > 0) & (at_1 <= 0)
    chord = jnp.where(rises | falls, at_1 - at_0, 1)
    root = jnp.where(rises | falls, -at_0 / chord, 0)
    for _ in range(NEWTON_STEPS):
        value, slope = jax.jvp(function, (root,), (ones,))
        # If the slope has the wrong sign, a Newton step would lead away from the root.
        slope = jnp.where(slope * chord > 0, slope, chord)
        root = jnp.clip(root - value / slope, 0, 1)
    never = (at_0 <= 0) & (at_1 <= 0)
    return jnp.where(rises, root, jnp.where(never, 1, 0)), jnp.where(falls, root, jnp.where(never, 0, 1))


def _apply_lag_along(surfaces, reading, start, end, duration, time_constant):
    """Return the output [N] of the force sensor's lag after a smooth section of motion.

    During contact the force is approximated by parabolas. The lag's response to a parabola is exact.
    """
    contact = _find_section_contact(surfaces, start, end, duration)
    span = contact.end - contact.begin
    forces = []
    for i in range(2 * PARABOLAS_PER_SECTION + 1):
        s = contact.begin + span * (i / (2 * PARABOLAS_PER_SECTION))
        motion, force = _force_along(surfaces, start, end, duration, s)
        if i in (0, 2 * PARABOLAS_PER_SECTION):
            # At zero penetration, use the limit of the force as the penetration goes to 0 from above.
            onset_force = surfaces.law.onset_force(surfaces.parameters, contact.side * motion.velocity)
            force = jnp.where(contact.at_surface[i > 0], contact.side * onset_force, force)
        forces.append(jnp.where(contact.touches, force, 0))
    idle, touching, free = (part * duration for part in (contact.begin, span, 1 - contact.end))
    return apply_lag(reading, idle, touching, free, forces, time_constant)
