"""Contact in space, without a rig: continuous and undelayed, which is what a rig is judged against.

The two bodies are followed by Dormand and Prince's pair of order 5(4), in steps whose error is held small: a
step in which something begins or ceases to touch is made again, down to 1 us: derivatives by what moves that
time are then right, too. Each lane has its own steps. Within a step each stage sees what the laws remember
from the step's start: laws with a memory are of first order, and have shorter steps.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.contact.dormand_prince import take_rolled_step
from jaxhil.sixdof.bodies import Body, Load, State, angular_velocity
from jaxhil.sixdof.forces import ContactGroup, Forces, Memory, contact_wrench
from jaxhil.sixdof.latch import Held, Latch, init_latch, latch_wrench
from jaxhil.sixdof.relative import (
    Pair,
    Pose,
    States,
    Twist,
    Wrench,
    interface_frame,
    loads,
    relative,
)
from jaxhil.sixdof.rotations import Quaternion, compose, normalise, rotate
from jaxhil.sixdof.vectors import norm

TOLERANCE = 1e-10  # of a step's error, per the relative speed
SHORTEST = 1e-9  # s: a step that is accepted whatever its error
EVENT = 1e-6  # s: within which the time is found at which something begins or ceases to touch, or is caught
REMEMBERING = 1e-4  # s: longest step of laws with a memory
MOST_STEPS = 200_000  # of a motion, unless its steps are long
SMALLEST, LARGEST = 0.1, 4.0  # change of the length from one step to the next


class Space(NamedTuple):
    """What stays constant."""

    bodies: Pair
    groups: tuple[ContactGroup, ...]  # the contact
    latches: tuple[Latch, ...]


class Memories(NamedTuple):
    """What a contact remembers."""

    laws: tuple[Memory, ...]
    held: tuple[Held, ...]  # by the latches


class Instant(NamedTuple):
    """Two bodies in contact, at a time."""

    states: States  # of the bodies
    pose: Pose
    twist: Twist
    wrench: Wrench  # on the chaser, about T's origin
    forces: tuple[Forces, ...]  # of the candidates


class Flight(NamedTuple):
    """A motion on its way."""

    time: Float[Array, "*batch"]  # since its start [s]
    length: Float[Array, "*batch"]  # of the next step [s]
    touching: tuple[Bool[Array, "candidates *batch"], ...]  # now, of each group
    memories: Memories
    states: States  # of the bodies
    tries: Int[Array, "*batch"]  # of steps so far


class Step(NamedTuple):
    """A step that was tried."""

    now: Instant  # at its end
    memories: Memories
    accepted: Bool[Array, "*batch"]


def start_flight(space: Space, states: States, length: Float[Array, "*batch"]) -> Flight:
    """A motion at its start; its first step is `length` [s]."""
    memories = Memories(tuple(group.init() for group in space.groups), ())
    if space.latches:
        pose, _ = relative(space.bodies, states)
        memories = memories._replace(held=tuple(init_latch(latch, pose) for latch in space.latches))
    touching = tuple(jnp.zeros_like(group.parameters.damping, bool) for group in space.groups)
    return Flight(0 * length, length, touching, memories, states, jnp.zeros(length.shape, jnp.int32))


def instant(
    space: Space, states: States, memories: Memories, duration: Float[Array, "*batch"]
) -> tuple[Instant, Memories]:
    """What happens at the states, `duration` [s] after the laws were evaluated last."""
    pose, twist = relative(space.bodies, states)
    wrench, forces, laws = contact_wrench(space.groups, memories.laws, pose, twist, duration)
    held = []
    for latch, before in zip(space.latches, memories.held, strict=True):
        pull, now = latch_wrench(latch, before, pose, twist)
        wrench = jax.tree.map(jnp.add, wrench, pull)
        held.append(now)
    return Instant(states, pose, twist, wrench, forces), Memories(laws, tuple(held))


def advance_flight(
    space: Space, flight: Flight, longest: Float[Array, "*batch"], speed: Float[Array, "*batch"]
) -> tuple[Flight, Step]:
    """One try of a step no longer than `longest` [s], at a relative speed [m/s] that scales its error: the
    motion at its end or, where it was not accepted, at its start, with a shorter step ahead. What is not a
    number, or takes too many steps, has no more to come: its time is infinite."""
    if _remembers(space):
        longest = jnp.minimum(longest, REMEMBERING)
    length = lax.stop_gradient(jnp.minimum(flight.length, longest))
    now, memories, error = _try(space, flight, length, speed)
    touching = tuple(forces.touch.depth > 0 for forces in now.forces)
    before = (*flight.touching, *(held.caught for held in flight.memories.held))
    happens = jnp.zeros(length.shape, bool)
    for old, new in zip(before, (*touching, *(held.caught for held in memories.held)), strict=True):
        happens = happens | jnp.any(old != new, axis=0)
    late = happens & (length > EVENT)
    accepted = ((error <= 1) | (length <= SHORTEST)) & ~late
    safe = jnp.where(jnp.isfinite(error), jnp.maximum(error, 1e-12), 1e12)
    change = jnp.clip(0.9 * safe**-0.2, SMALLEST, jnp.where(accepted, LARGEST, 0.9))
    proposed = length * change
    # A step cut short by its limit says little of the next.
    cut = accepted & (length < flight.length)
    proposed = jnp.where(cut, jnp.maximum(flight.length, proposed), proposed)
    ahead = lax.stop_gradient(jnp.where(late, length / 4, proposed))
    tries = flight.tries + 1
    time = jnp.where(jnp.isfinite(error), flight.time + length, jnp.inf)
    moved = Flight(time, ahead, touching, memories, now.states, tries)
    after: Flight = choose(accepted, moved, flight._replace(length=ahead, tries=tries))
    # So many steps of less than a thousandth of the longest, on the mean, have no end in sight.
    endless = (tries > MOST_STEPS) & (after.time < 1e-3 * tries.astype(length.dtype) * longest)
    time = jnp.where(endless, jnp.inf, after.time)
    return after._replace(time=time), Step(now, memories, accepted | endless)


def _try(
    space: Space, flight: Flight, length: Float[Array, "*batch"], speed: Array
) -> tuple[Instant, Memories, Array]:
    """Return what is at the end of a step of `length` [s], and its error over what is allowed."""

    def slope(offset, states):
        now, memories = instant(space, states, flight.memories, offset)
        return slope_at(space, now), (now._replace(states=None), memories)

    step = take_rolled_step(slope, flight.states, length)
    now, memories = step.found
    level: Any = States(*(one._replace(attitude=normalise(one.attitude)) for one in step.end))
    return now._replace(states=level), memories, _size(space, step.error, speed) / TOLERANCE


def slope_at(space: Space, now: Instant) -> States:
    """Rates of the states."""
    states = now.states
    target, chaser = loads(now.wrench, interface_frame(space.bodies.target, states.target), states)
    return States(
        _slope(space.bodies.target, states.target, target), _slope(space.bodies.chaser, states.chaser, chaser)
    )


def follow(
    space: Space,
    states: States,
    period: Float[Array, "*batch"],
    periods: int,
    longest: Float[Array, "*batch"],
) -> tuple[Flight, Instant]:
    """The motion after so many periods [s], and each period's start, (periods, ...); steps are no longer than
    `longest` [s]."""
    speed = scale(space, states)

    def body(flight, _):
        flight = flight._replace(time=0 * period, tries=0 * flight.tries)
        seen, _ = instant(space, flight.states, flight.memories, flight.time)
        return fly(space, flight, period, longest, speed), seen

    begin = start_flight(space, states, jnp.minimum(period, longest))
    return lax.scan(body, begin, None, length=periods)


def fly(space: Space, flight: Flight, until: Array, longest: Array, speed: Array) -> Flight:
    """The motion at a time [s] since its start."""

    def body(flight):
        left = until - flight.time
        moved, _ = advance_flight(space, flight, jnp.minimum(longest, left), speed)
        return choose(left > _nothing(until), moved, flight)

    def ahead(flight):
        return jnp.any(until - flight.time > _nothing(until))

    return lax.while_loop(ahead, body, flight)


def scale(space: Space, states: States) -> Float[Array, "*batch"]:
    """A speed [m/s] to hold errors against: that of the centres of mass against each other, and that of a
    point 1 m off. It is the same wherever the interface frames are."""
    target, chaser = (
        rotate(state.attitude, angular_velocity(body, state))
        for body, state in zip(space.bodies, states, strict=True)
    )
    apart = states.chaser.velocity - states.target.velocity
    return lax.stop_gradient(norm(apart) + norm(chaser - target) + 1e-9)


def choose(condition: Array, one: Any, other: Any) -> Any:
    """Lane by lane, one or the other; lanes are the last axes."""

    def either(a: Array, b: Array) -> Array:
        return lax.select(jnp.broadcast_to(condition, a.shape), a, b)

    return jax.tree.map(either, one, other)


def _nothing(until: Array) -> Array:
    """What is left of a time for rounding [s]."""
    return 1e-14 + 1e-13 * until


def _remembers(space: Space) -> bool:
    memories = jax.eval_shape(lambda: [group.init() for group in space.groups])
    return bool(jax.tree.leaves(memories))


def _size(space: Space, error: States, speed: Array) -> Array:
    """Of an error, relative: velocities against the speed, positions against its way in 0.1 s."""
    largest = jnp.zeros_like(speed)
    for body, one in zip(space.bodies, error, strict=True):
        turning = norm(body.inverse_inertia @ one.spin)
        tilt = 2 * norm(one.attitude.v)
        for part in (norm(one.velocity), turning, 10 * norm(one.position), 10 * tilt):
            largest = jnp.maximum(largest, part / speed)
    return lax.stop_gradient(largest)


def _slope(body: Body, state: State, load: Load) -> State:
    """Rates of a state."""
    angular = angular_velocity(body, state)
    turning = compose(state.attitude, Quaternion(0 * state.attitude.w, 0.5 * angular))
    return State(state.velocity, (1 / body.mass) * load.force, turning, load.torque)
