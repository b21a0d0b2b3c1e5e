"""The real contact, one sampling interval after the other: its force, peak and work, and what a lagging force
sensor makes of it.

The motion simulator moves smoothly within a sampling interval (`jaxhil.simulation.motion_simulator`); its
corners are the interval's ends. The force is read where the sensor will sample it, once per interval. In a
loop of slow motion, what depends on the force in between follows it along the cubic through the exact
position and velocity at the ends of each smooth stretch; in others, along the exact motion
(`jaxhil.simulation.contact_in_cells`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxhil.contact.laws import ContactLaw, ContactParameters, deflection, two_sided
from jaxhil.simulation.cells import Course
from jaxhil.simulation.sensors import lag, lag_decay

ROOT_STEPS = 3  # of Newton's method, from a straight line's root
ARCS = 2  # parabolas that stand for the force of one stretch, for the sensor's lag
GAUSS = ((0.5 - 0.15**0.5, 5 / 18), (0.5, 4 / 9), (0.5 + 0.15**0.5, 5 / 18))  # node, weight


class Motion(NamedTuple):
    """Position [m] and velocity [m/s] somewhere in a sampling interval."""

    position: Float[Array, "*batch"]
    velocity: Float[Array, "*batch"]


class SamplingInterval(NamedTuple):
    """Motion of the real mechanism from one tick to the next."""

    sample: Motion  # where the force is sampled
    start: Any  # at the interval's start, from within; None for loops that do not look between the samples
    end: Any  # at its end, likewise
    course: Course | None  # what the motion in between follows from; None for loops that do not follow it


class PlantSignals(NamedTuple):
    """The contact in a sampling interval, as it is without the sensors."""

    force: Float[Array, "*batch"]  # of the contact, where it is sampled [N]
    # done on the mechanism and returned by it [J]; None unless energies are followed
    works: tuple[Array, Array] | None
    # of the force in the interval [N]; None unless the force has corners between samples
    peak: Float[Array, "*batch"] | None
    # time with a force since the sample before [periods]; None where touching samples are counted
    touched: Float[Array, "*batch"] | None


class Contact(NamedTuple):
    """What the contact of a sampling interval leaves."""

    plant_signals: PlantSignals  # of the contact, without the sensors
    # of a lagging force sensor, where it samples [N]; None without lag
    reading: Float[Array, "*batch"] | None
    lagged: Array  # its reading at the interval's end [N]
    last: "ContactSample"  # the sample of the contact
    # time with a force after the sample [periods]; None where touching samples are counted
    touched: Float[Array, "*batch"] | None
    law: tuple[Array, ...]  # state of the contact law at the interval's end


class Surfaces(NamedTuple):
    """A contact law at one surface or two."""

    law: ContactLaw  # the contact law
    parameters: ContactParameters  # its parameters
    state: tuple[Any, ...]  # its state
    clearance: Array | None  # between two surfaces [m]; None for one

    def force(self, motion: Motion) -> tuple[Array, tuple[Any, ...]]:
        """Signed force [N] and the law's next state."""
        return two_sided(
            self.law, self.parameters, self.state, motion.position, motion.velocity, self.clearance
        )

    def after(self, start: Motion, end: Motion, duration: Array, s: Any = 1) -> "Surfaces":
        """The same at the fraction s of a smooth stretch of motion of a `duration` [s], at whose start these
        are."""
        if not self.law.remembers:
            return self
        side, surface = self.side(start, end)
        turn = jnp.minimum(_turn(start, end, duration, side), s)
        state = self.state
        for motion in (along(start, end, duration, turn), along(start, end, duration, s)):
            depth = side * (motion.position - surface)
            _, state = self.law.step(self.parameters, state, depth, side * motion.velocity)
        return self._replace(state=state)

    def side(self, start: Motion, end: Motion) -> tuple[Array, Array]:
        """Side (1, -1, or 0 for none) and position [m] of the surface that a stretch touches."""
        signed = deflection(start.position, self.clearance)
        side = jnp.sign(jnp.where(signed == 0, deflection(end.position, self.clearance), signed))
        return side, jnp.zeros_like(side) if self.clearance is None else jnp.where(
            side < 0, -self.clearance, 0
        )

    def sample(self, motion: Motion, force: Array) -> "ContactSample":
        """A sample of the contact, whose force is known."""
        if self.clearance is None:
            edge = self.law.edge(self.parameters, motion.velocity)
            return ContactSample(motion.position, force, edge, jnp.ones_like(edge))
        far = -self.clearance - motion.position
        beyond = jnp.where(far > motion.position, far, motion.position)
        side = jnp.where(far > motion.position, -1, 1).astype(far.dtype)
        edge = side * self.law.edge(self.parameters, side * motion.velocity)
        return ContactSample(beyond, force, edge, side)


class ContactSample(NamedTuple):
    """A sample of the contact."""

    distance: Float[Array, "*batch"]  # into the nearer surface [m], negative outside
    force: Float[Array, "*batch"]  # [N]
    edge: Float[Array, "*batch"]  # limit of the force at that surface [N]
    side: Float[Array, "*batch"]  # of that surface, 1 or -1

    def position(self, clearance: Array | None) -> Array:
        """Position of the mechanism [m]."""
        if clearance is None:
            return self.distance
        # Before the first sample it is far from either surface.
        distance = jnp.maximum(self.distance, -clearance / 2)
        return jnp.where(self.side > 0, distance, -clearance - distance)


def no_contact(like: Array) -> ContactSample:
    """Far from any surface."""
    zeros = jnp.zeros_like(like)
    return ContactSample(zeros - 1, zeros, zeros, zeros + 1)


def works_between(before: ContactSample, now: ContactSample) -> tuple[Array, Array]:
    """Work [J] done on the mechanism and returned by it from one sample to the next, exact for a force
    straight in the penetration."""
    depth_0 = jnp.where(before.distance > 0, before.distance, 0)
    depth_1 = jnp.where(now.distance > 0, now.distance, 0)
    force_0 = jnp.where(before.distance > 0, before.force, now.edge)
    force_1 = jnp.where(now.distance > 0, now.force, before.edge)
    side = jnp.where(now.distance > 0, now.side, before.side)
    work = side * (force_0 + force_1) / 2 * (depth_1 - depth_0)
    return jnp.where(work > 0, work, 0), jnp.where(work > 0, 0, -work)


def works_along(surfaces: Surfaces, start: Motion, end: Motion, duration: Array) -> tuple[Array, Array]:
    """Work [J] done on the mechanism and returned by it along a smooth stretch of motion.

    A pulling force acts while the penetration recedes: it takes from the work returned.
    """
    contact = _touching(surfaces, start, end, duration)

    def inward(s):
        return contact.side * along(start, end, duration, s).velocity

    since, until = _crossing(inward, duration)
    turn = jnp.clip(jnp.where(until < 1, until, since), contact.first, contact.last)
    done = returned = jnp.zeros_like(duration)
    for a, b in ((contact.first, turn), (turn, contact.last)):
        for node, weight in GAUSS:
            motion, force = _force_along(surfaces, start, end, duration, a + (b - a) * node)
            work = force * motion.velocity * (weight * (b - a) * duration)
            deeper = contact.side * motion.velocity > 0
            done = done + jnp.where(deeper, work, 0)
            returned = returned - jnp.where(deeper, 0, work)
    return done, returned


def largest_force(surfaces: Surfaces, start: Motion, end: Motion, duration: Array) -> Float[Array, "*batch"]:
    """Largest |force| [N] within a sampling interval: at an end, or near the vertex of the parabola through
    both ends and the middle."""

    def magnitude(motion, s):
        return jnp.abs(surfaces.after(start, end, duration, s).force(motion)[0])

    first, last = magnitude(start, 0), magnitude(end, 1)
    half = magnitude(along(start, end, duration, 0.5), 0.5)
    slope, bend = last - first, first + last - 2 * half
    vertex = jnp.clip(0.5 - slope / (4 * jnp.where(bend < 0, bend, -1)), 0, 1)
    top = magnitude(along(start, end, duration, vertex), vertex)
    highest = jnp.where(first > last, first, last)
    return jnp.where((bend < 0) & (top > highest), top, highest)


def sensed_lag(
    surfaces: Surfaces,
    reading: Float[Array, "*batch"],
    interval: SamplingInterval,
    until: Array,
    duration: Array,
    time_constant: Array,
) -> tuple[Array, Array]:
    """Readings [N] of a lagging sensor at an interval's sample, `until` [s] after its start, and at its end,
    after `duration` [s]; `reading` was that at its start."""

    def follow(reading, interval):
        sample = _lag_along(surfaces, reading, interval.start, interval.sample, until, time_constant)
        rest = duration - until
        loaded = surfaces.after(interval.start, interval.sample, until)
        return sample, _lag_along(loaded, sample, interval.sample, interval.end, rest, time_constant)

    def fade(reading, interval):
        # In the same steps as `follow`: to the bit, no lane depends on whether others are in contact.
        sample = reading * lag_decay(until, time_constant)
        return sample, sample * lag_decay(duration - until, time_constant)

    # Most of the time no lane touches.
    motions = interval.sample, interval.start, interval.end
    outside = [deflection(motion.position, surfaces.clearance) == 0 for motion in motions]
    return lax.cond(jnp.all(outside[0] & outside[1] & outside[2]), fade, follow, reading, interval)


def along(start: Motion, end: Motion, duration: Array, s: Any) -> Motion:
    """Position and velocity at the fraction s of a stretch, by its cubic (Hermite)."""
    v_0, v_1 = start.velocity * duration, end.velocity * duration
    moved = end.position - start.position
    bend, twist = 3 * moved - 2 * v_0 - v_1, v_0 + v_1 - 2 * moved
    position = start.position + s * (v_0 + s * (bend + s * twist))
    velocity = v_0 + s * (2 * bend + s * 3 * twist)
    safe = jnp.where(duration > 0, duration, 1)
    return Motion(position, jnp.where(duration > 0, velocity / safe, start.velocity))


def _turn(start, end, duration, side):
    """The fraction of a stretch at which it turns round on its way in; 1 where it does not."""
    first, last = side * start.velocity, side * end.velocity
    turns = (first > 0) & (last < 0)
    # The velocity first + slope s + bend s^2 of the stretch's cubic, times the duration.
    moved = side * (end.position - start.position)
    first, last = first * duration, last * duration
    slope, bend = 6 * moved - 4 * first - 2 * last, 3 * (first + last - 2 * moved)
    square = jnp.where(turns, slope**2 - 4 * bend * first, 1)
    return jnp.where(turns, 2 * first / jnp.where(turns, jnp.sqrt(square) - slope, 1), 1)


def _force_along(surfaces, start, end, duration, s):
    """Motion at the fraction s of a stretch, and the force there [N]; `surfaces` are those at its start."""
    motion = along(start, end, duration, s)
    force, _ = surfaces.after(start, end, duration, s).force(motion)
    return motion, force


class _Touching(NamedTuple):
    """Contact during a stretch of motion."""

    touches: Array  # whether there is any
    side: Array  # of the surface, 1 or -1
    first: Array  # fraction of the stretch at which it begins
    last: Array  # fraction of the stretch at which it ends
    at_surface: tuple[Array, Array]  # whether it begins, and whether it ends, at the surface


def _touching(surfaces, start, end, duration):
    """Both instants are roots on the stretch's cubic: of the depth, or of the force that lets go before."""
    side, surface = surfaces.side(start, end)

    def depth(s):
        return side * (along(start, end, duration, s).position - surface)

    def hold(s):
        motion = along(start, end, duration, s)
        state = surfaces.after(start, end, duration, s).state
        return surfaces.law.hold(surfaces.parameters, state, depth(s), side * motion.velocity)

    enters, leaves = _crossing(depth, duration)
    catches, lets_go = _crossing(hold, duration)
    first = jnp.where(enters >= catches, enters, catches)
    last = jnp.where(leaves <= lets_go, leaves, lets_go)
    touches = (side != 0) & (first < last)
    begins_at_surface = (enters > 0) & (enters >= catches)
    ends_at_surface = (leaves < 1) & (leaves <= lets_go)
    return _Touching(
        touches,
        side,
        jnp.where(touches, first, 0),
        jnp.where(touches, last, 0),
        (begins_at_surface, ends_at_surface),
    )


def _crossing(function, like):
    """From which s in [0, 1] and until which a function of s is positive, if it changes its sign once."""
    zeros, ones = jnp.zeros_like(like), jnp.ones_like(like)
    at_0, at_1 = function(zeros), function(ones)
    rises, falls = (at_0 <= 0) & (at_1 > 0), (at_0 > 0) & (at_1 <= 0)
    chord = jnp.where(rises | falls, at_1 - at_0, 1)
    root = jnp.where(rises | falls, -at_0 / chord, 0)
    for _ in range(ROOT_STEPS):
        value, slope = jax.jvp(function, (root,), (ones,))
        # Towards the other end, at any rate.
        slope = jnp.where(slope * chord > 0, slope, chord)
        root = jnp.clip(root - value / slope, 0, 1)
    never = (at_0 <= 0) & (at_1 <= 0)
    return jnp.where(rises, root, jnp.where(never, 1, 0)), jnp.where(falls, root, jnp.where(never, 0, 1))


def _lag_along(surfaces, reading, start, end, duration, time_constant):
    """The lagging reading after a smooth stretch of motion: the force is taken along parabolas, whose lag is
    exact, from where contact begins to where it ends."""
    contact = _touching(surfaces, start, end, duration)
    span = contact.last - contact.first
    forces = []
    for i in range(2 * ARCS + 1):
        s = contact.first + span * (i / (2 * ARCS))
        motion, force = _force_along(surfaces, start, end, duration, s)
        if i in (0, 2 * ARCS):
            # At the surface the force has a limit from inside.
            edge = surfaces.law.edge(surfaces.parameters, contact.side * motion.velocity)
            force = jnp.where(contact.at_surface[i > 0], contact.side * edge, force)
        forces.append(jnp.where(contact.touches, force, 0))
    idle, touching, free = (part * duration for part in (contact.first, span, 1 - contact.last))
    return lag(reading, idle, touching, free, forces, time_constant)
