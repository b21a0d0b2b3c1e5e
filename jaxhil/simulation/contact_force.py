"""Force, peak force and mechanical work of the real contact in one sampling interval, and a sensor's lag.

The motion simulator moves smoothly within a sampling interval (`jaxhil.simulation.motion_simulator`); its
motion has corners only at the interval's ends. The force is evaluated once per interval, where the sensor
samples it. Whatever depends on the force in between follows, in loops with slow motion, the cubic (Hermite)
through the exact positions and velocities at the ends of each smooth section. Other loops follow the exact
motion (`jaxhil.simulation.contact_in_cells`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters, compute_two_sided_force, deflection
from jaxhil.simulation.cells import IntervalInputs
from jaxhil.simulation.sensors import apply_lag, lag_decay

NEWTON_STEPS = 3  # steps of Newton's method, which starts at the root of the chord
PARABOLAS_PER_SECTION = 2  # parabolas that approximate the force along one section, for the sensor's lag
GAUSS_LEGENDRE = ((0.5 - 0.15**0.5, 5 / 18), (0.5, 4 / 9), (0.5 + 0.15**0.5, 5 / 18))  # node, weight


class MotionSample(NamedTuple):
    """Position [m] and velocity [m/s] at an instant of a sampling interval."""

    position: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]


class SamplingInterval(NamedTuple):
    """Motion of the real mechanism from one tick to the next."""

    sample: MotionSample  # where the force is sampled
    start: Any  # right limit at the interval's start; None for loops that use the samples alone
    end: Any  # left limit at its end; None likewise
    interval_inputs: (
        IntervalInputs | None
    )  # input of the exact motion in between; None for loops that do not use it


class PlantSignals(NamedTuple):
    """Contact in a sampling interval, without the effects of the sensors."""

    force: Float[Array, "*batch"]  # contact force at the sampling instant [N]
    # work done on the mechanism and work returned by it [J]; None unless energies are recorded
    works: tuple[Array, Array] | None
    # peak force in the interval [N]; None unless the force has corners between samples
    peak: Float[Array, "*batch"] | None
    # time with a force since the previous sample [periods]; None if touching samples are counted instead
    touched: Float[Array, "*batch"] | None


class IntervalContact(NamedTuple):
    """Result of the contact in a sampling interval."""

    plant_signals: PlantSignals  # contact without the effects of the sensors
    # reading of a lagging force sensor at its sampling instant [N]; None without lag
    reading: Float[Array, "*batch"] | None
    lagged: Array  # reading of a lagging force sensor at the interval's end [N]
    last: "ContactSample"  # the sample of the contact
    # time with a force after the sample [periods]; None if touching samples are counted instead
    touched: Float[Array, "*batch"] | None
    law: tuple[Array, ...]  # state of the contact law at the interval's end


class Surfaces(NamedTuple):
    """Contact law at one surface or two."""

    law: ContactLaw  # the contact law
    parameters: ContactParameters  # its parameters
    state: tuple[Any, ...]  # its state
    clearance: Array | None  # distance between two surfaces [m]; None for one surface

    def force(self, motion: MotionSample) -> tuple[Array, tuple[Any, ...]]:
        """Return the signed force [N] and the law's next state."""
        return compute_two_sided_force(
            self.law, self.parameters, self.state, motion.position, motion.velocity, self.clearance
        )

    def after(self, start: MotionSample, end: MotionSample, duration: Array, s: Any = 1) -> "Surfaces":
        """Return the surfaces with the law's state at the fraction `s` of a smooth section of motion.

        `self` has the state at the section's start; the section takes `duration` [s].
        """
        if not self.law.remembers:
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
        """Return side (1, -1, or 0 for none) and position [m] of the surface that a section touches."""
        signed = deflection(start.position, self.clearance)
        side = jnp.sign(jnp.where(signed == 0, deflection(end.position, self.clearance), signed))
        return side, jnp.zeros_like(side) if self.clearance is None else jnp.where(
            side < 0, -self.clearance, 0
        )

    def sample(self, motion: MotionSample, force: Array) -> "ContactSample":
        """Return a sample of the contact, with known force [N]."""
        if self.clearance is None:
            edge = self.law.edge(self.parameters, motion.velocity)
            return ContactSample(motion.position, force, edge, jnp.ones_like(edge))
        far = -self.clearance - motion.position
        beyond = jnp.where(far > motion.position, far, motion.position)
        side = jnp.where(far > motion.position, -1, 1).astype(far.dtype)
        edge = side * self.law.edge(self.parameters, side * motion.velocity)
        return ContactSample(beyond, force, edge, side)


class ContactSample(NamedTuple):
    """Sample of the contact."""

    distance: Float[Array, "*batch"]  # penetration of the nearer surface [m], negative outside
    force: Float[Array, "*batch"]  # [N]
    edge: Float[Array, "*batch"]  # limit of the force at that surface, from inside [N]
    side: Float[Array, "*batch"]  # side of that surface, 1 or -1

    def position(self, clearance: Array | None) -> Array:
        """Return the position of the mechanism [m]."""
        if clearance is None:
            return self.distance
        # The initial sample is far from both surfaces.
        distance = jnp.maximum(self.distance, -clearance / 2)
        return jnp.where(self.side > 0, distance, -clearance - distance)


def no_contact(like: Array) -> ContactSample:
    """Return a sample far from any surface."""
    zeros = jnp.zeros_like(like)
    return ContactSample(zeros - 1, zeros, zeros, zeros + 1)


def compute_work_between(before: ContactSample, now: ContactSample) -> tuple[Array, Array]:
    """Return the work [J] done on the mechanism and returned by it between two samples.

    It is exact if the force is linear in the penetration.
    """
    depth_0 = jnp.where(before.distance > 0, before.distance, 0)
    depth_1 = jnp.where(now.distance > 0, now.distance, 0)
    force_0 = jnp.where(before.distance > 0, before.force, now.edge)
    force_1 = jnp.where(now.distance > 0, now.force, before.edge)
    side = jnp.where(now.distance > 0, now.side, before.side)
    work = side * (force_0 + force_1) / 2 * (depth_1 - depth_0)
    return jnp.where(work > 0, work, 0), jnp.where(work > 0, 0, -work)


def compute_work_along(
    surfaces: Surfaces, start: MotionSample, end: MotionSample, duration: Array
) -> tuple[Array, Array]:
    """Return the work [J] done on the mechanism and returned by it along a smooth section of motion.

    Work of a pulling force while the penetration decreases is subtracted from the work returned.
    """
    contact = _find_section_contact(surfaces, start, end, duration)

    def inward(s):
        return contact.side * interpolate_motion(start, end, duration, s).velocity

    since, until = _find_positive_interval(inward, duration)
    turn = jnp.clip(jnp.where(until < 1, until, since), contact.first, contact.last)
    done = returned = jnp.zeros_like(duration)
    for a, b in ((contact.first, turn), (turn, contact.last)):
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

    It is the force at an end, or near the vertex of the parabola through both ends and the middle.
    """

    def magnitude(motion, s):
        return jnp.abs(surfaces.after(start, end, duration, s).force(motion)[0])

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
    until: Array,
    duration: Array,
    time_constant: Array,
) -> tuple[Array, Array]:
    """Return the readings [N] of a lagging sensor at an interval's sample and at its end.

    Args:
        surfaces: Contact law at the interval's start.
        reading: Reading at the interval's start [N].
        interval: Motion of the mechanism.
        until: Time of the sample after the interval's start [s].
        duration: Duration of the interval [s].
        time_constant: Time constant of the sensor [s].
    """

    def follow(reading, interval):
        sample = _apply_lag_along(surfaces, reading, interval.start, interval.sample, until, time_constant)
        rest = duration - until
        loaded = surfaces.after(interval.start, interval.sample, until)
        return sample, _apply_lag_along(loaded, sample, interval.sample, interval.end, rest, time_constant)

    def fade(reading, interval):
        # The same operations as in `follow`: a lane's bits must not depend on the contacts of other lanes.
        sample = reading * lag_decay(until, time_constant)
        return sample, sample * lag_decay(duration - until, time_constant)

    # Most of the time no lane touches.
    motions = interval.sample, interval.start, interval.end
    outside = [deflection(motion.position, surfaces.clearance) == 0 for motion in motions]
    return lax.cond(jnp.all(outside[0] & outside[1] & outside[2]), fade, follow, reading, interval)


def interpolate_motion(start: MotionSample, end: MotionSample, duration: Array, s: Any) -> MotionSample:
    """Return position and velocity at the fraction `s` of a section, from its cubic (Hermite)."""
    v_0, v_1 = start.velocity * duration, end.velocity * duration
    moved = end.position - start.position
    bend, twist = 3 * moved - 2 * v_0 - v_1, v_0 + v_1 - 2 * moved
    position = start.position + s * (v_0 + s * (bend + s * twist))
    velocity = v_0 + s * (2 * bend + s * 3 * twist)
    safe = jnp.where(duration > 0, duration, 1)
    return MotionSample(position, jnp.where(duration > 0, velocity / safe, start.velocity))


def _find_turning_point(start, end, duration, side):
    """Return the fraction of a section at which an inward motion reverses; 1 if it does not."""
    first, last = side * start.velocity, side * end.velocity
    turns = (first > 0) & (last < 0)
    # first + slope s + bend s^2 is the velocity of the section's cubic, times the duration.
    moved = side * (end.position - start.position)
    first, last = first * duration, last * duration
    slope, bend = 6 * moved - 4 * first - 2 * last, 3 * (first + last - 2 * moved)
    square = jnp.where(turns, slope**2 - 4 * bend * first, 1)
    return jnp.where(turns, 2 * first / jnp.where(turns, jnp.sqrt(square) - slope, 1), 1)


def _force_along(surfaces, start, end, duration, s):
    """Return motion and force [N] at the fraction `s` of a section, at whose start `surfaces` hold."""
    motion = interpolate_motion(start, end, duration, s)
    force, _ = surfaces.after(start, end, duration, s).force(motion)
    return motion, force


class _SectionContact(NamedTuple):
    """Contact during a section of motion."""

    touches: Array  # whether there is contact
    side: Array  # side of the surface, 1 or -1
    first: Array  # fraction of the section at which it begins
    last: Array  # fraction of the section at which it ends
    at_surface: tuple[Array, Array]  # whether it begins, and whether it ends, at the surface


def _find_section_contact(surfaces, start, end, duration):
    """Return the contact during a section.

    Both of its instants are roots on the section's cubic: of the penetration, or of the law's `hold`, which
    changes sign where the force vanishes before the penetration does.
    """
    side, surface = surfaces.side(start, end)

    def depth(s):
        return side * (interpolate_motion(start, end, duration, s).position - surface)

    def hold(s):
        motion = interpolate_motion(start, end, duration, s)
        state = surfaces.after(start, end, duration, s).state
        return surfaces.law.hold(surfaces.parameters, state, depth(s), side * motion.velocity)

    enters, leaves = _find_positive_interval(depth, duration)
    catches, lets_go = _find_positive_interval(hold, duration)
    first = jnp.where(enters >= catches, enters, catches)
    last = jnp.where(leaves <= lets_go, leaves, lets_go)
    touches = (side != 0) & (first < last)
    begins_at_surface = (enters > 0) & (enters >= catches)
    ends_at_surface = (leaves < 1) & (leaves <= lets_go)
    return _SectionContact(
        touches,
        side,
        jnp.where(touches, first, 0),
        jnp.where(touches, last, 0),
        (begins_at_surface, ends_at_surface),
    )


def _find_positive_interval(function, like):
    """Return the bounds in [0, 1] between which a function is positive, if it changes sign at most once."""
    zeros, ones = jnp.zeros_like(like), jnp.ones_like(like)
    at_0, at_1 = function(zeros), function(ones)
    rises, falls = (at_0 <= 0) & (at_1 > 0), (at_0 > 0) & (at_1 <= 0)
    chord = jnp.where(rises | falls, at_1 - at_0, 1)
    root = jnp.where(rises | falls, -at_0 / chord, 0)
    for _ in range(NEWTON_STEPS):
        value, slope = jax.jvp(function, (root,), (ones,))
        # A slope of the wrong sign would lead away from the root.
        slope = jnp.where(slope * chord > 0, slope, chord)
        root = jnp.clip(root - value / slope, 0, 1)
    never = (at_0 <= 0) & (at_1 <= 0)
    return jnp.where(rises, root, jnp.where(never, 1, 0)), jnp.where(falls, root, jnp.where(never, 0, 1))


def _apply_lag_along(surfaces, reading, start, end, duration, time_constant):
    """Return the lagging reading [N] after a smooth section of motion.

    Between the begin and the end of contact, the force is approximated by parabolas, whose lag is exact.
    """
    contact = _find_section_contact(surfaces, start, end, duration)
    span = contact.last - contact.first
    forces = []
    for i in range(2 * PARABOLAS_PER_SECTION + 1):
        s = contact.first + span * (i / (2 * PARABOLAS_PER_SECTION))
        motion, force = _force_along(surfaces, start, end, duration, s)
        if i in (0, 2 * PARABOLAS_PER_SECTION):
            # At the surface, the force is its limit from inside.
            edge = surfaces.law.edge(surfaces.parameters, contact.side * motion.velocity)
            force = jnp.where(contact.at_surface[i > 0], contact.side * edge, force)
        forces.append(jnp.where(contact.touches, force, 0))
    idle, touching, free = (part * duration for part in (contact.first, span, 1 - contact.last))
    return apply_lag(reading, idle, touching, free, forces, time_constant)
