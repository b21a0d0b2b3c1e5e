"""Figures of episodes: the rig's against those of the same contact in space, entered alike.

Both are compared at one time, when both are over. The relative mass matrix M at that pose weighs metres
against radians: twists are compared in its norm.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.laws.simulation_base import Gains
from jaxhil.sixdof.bodies import kinetic_energy
from jaxhil.sixdof.equations import square_root
from jaxhil.sixdof.loop import Loop
from jaxhil.sixdof.reference import (
    Meeting,
    Passage,
    glide,
    meet,
    meeting_mass,
    over_time,
    pass_through,
)
from jaxhil.sixdof.relative import Pair, Pose, States, Twist, mass_matrix, relative
from jaxhil.sixdof.rollout import CAPTURED, MISS, REBOUNDED, Episode, quiet_time, rollout
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.space import Space, fly, scale, start_flight
from jaxhil.sixdof.vectors import components, cross, dot, root

LONGEST = 2.0  # control periods: the longest step in space


class Metrics(NamedTuple):
    """Figures of episodes, (episodes, *batch); NaN for what they do not have."""

    energy_error: Float[Array, "..."]  # of the change of kinetic energy, over m_n v_n^2/2 [1]
    twist_error: Float[Array, "..."]  # |V - V*| over |V* - V_0|, in the norm of M [1]
    normal_part: Float[Array, "..."]  # of it, along the impulse in space [1]
    lateral_part: Float[Array, "..."]  # of the rest, the translation [1]
    rotational_part: Float[Array, "..."]  # and the rotation [1]
    restitution: Float[Array, "..."]  # e at the first touch's point and normal, of a single touch [1]
    reference_restitution: Float[Array, "..."]  # e* in space, of a single touch [1]
    effective_mass: Float[Array, "..."]  # m_n at the first touch [kg]
    approach_velocity: Float[Array, "..."]  # v_n there [m/s]
    point: Float[Array, "..."]  # of the first touch, in T axes, (3, episodes, *batch) [m]
    normal: Float[Array, "..."]  # there, likewise
    energy_change: Float[Array, "..."]  # of the kinetic energy [J]
    reference_energy_change: Float[Array, "..."]  # likewise in space [J]
    peak_force: Float[Array, "..."]  # of the real contact [N]
    reference_peak_force: Float[Array, "..."]  # in space [N]
    peak_moment: Float[Array, "..."]  # about T's origin, of the real contact [N m]
    reference_peak_moment: Float[Array, "..."]  # in space [N m]
    duration: Float[Array, "..."]  # in touch [s]
    reference_duration: Float[Array, "..."]  # likewise in space; NaN where it was not followed to its end [s]
    touches: Int[Array, "..."]  # candidates that began to touch
    reference_touches: Int[Array, "..."]  # likewise in space
    penetration: Float[Array, "..."]  # largest depth on the rig, over the size of its shapes [1]
    captured: Bool[Array, "..."]  # whether a latch holds
    reference_captured: Bool[Array, "..."]  # likewise in space
    status: Int[Array, "..."]  # index of `rollout.STATUS_NAMES`


class Moment(NamedTuple):
    """Two bodies at a time."""

    twist: Twist  # of C against T
    energy: Float[Array, "..."]  # kinetic energy of both [J]
    mass: Float[Array, "..."]  # relative mass matrix, (6, 6, episodes, *batch)


class Result(NamedTuple):
    """Runs on the rig and what they are worth."""

    metrics: Metrics
    final: States  # of the numerical model, at the end of the run
    final_time: Float[Array, "*batch"]  # [s]


def evaluate(loop: Loop, gains: Gains, scenario: Scenario) -> Result:
    """Run a batch of scenarios, and judge it; `gains` as for `jaxhil.sixdof.loop.build_rig`."""
    outcome = rollout(loop, gains, scenario)
    return Result(judge(scenario, outcome.episodes), outcome.final, outcome.final_time)


def reference_final(scenario: Scenario, time: Float[Array, "*batch"]) -> States:
    """The bodies in space, from the scenario's start on, at a time [s]."""
    space = Space(scenario.bodies, scenario.groups, scenario.latches)
    longest = LONGEST * scenario.control_period
    flight = start_flight(space, scenario.start, jnp.minimum(longest, time))
    return fly(space, flight, time, longest, scale(space, scenario.start)).states


def judge(scenario: Scenario, episodes: Episode) -> Metrics:
    """Figures of episodes."""
    slots = episodes.status.shape[0]

    def repeated(tree: Any) -> Any:
        """With an axis of episodes before the batch."""
        lanes = scenario.control_period.ndim
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(
                jnp.expand_dims(leaf, leaf.ndim - lanes),
                (*leaf.shape[: leaf.ndim - lanes], slots, *leaf.shape[leaf.ndim - lanes :]),
            ),
            tree,
        )

    space = Space(*repeated((scenario.bodies, scenario.groups, scenario.latches)))
    period, duration, sensor = repeated((scenario.control_period, scenario.duration, scenario.sensor))
    lasted = jnp.where(
        episodes.status == REBOUNDED, duration - episodes.entry_time, episodes.end_time - episodes.entry_time
    )
    quiet = quiet_time(sensor, period)
    passage = pass_through(space, episodes.entry, quiet, jnp.where(lasted > 0, lasted, 0), LONGEST * period)
    return _compare(space, episodes, passage, quiet)


def _compare(space: Space, episodes: Episode, passage: Passage, quiet: Array) -> Metrics:
    bodies, meeting = space.bodies, meet(space, passage)
    ended = episodes.end_time - episodes.entry_time
    both = jnp.maximum(ended, over_time(passage, quiet))
    flown = [
        (episodes.entry, 0 * both),
        (episodes.end, both - ended),
        (passage.flight.states, both - passage.flight.time),
    ]
    start, end, expected = _later(bodies, flown)
    mass, (there, before) = meeting_mass(bodies, meeting), relative(bodies, meeting.states)
    speed = _closing(there, meeting, before)
    change, changed = end.energy - start.energy, expected.energy - start.energy
    parts = _twist_parts(expected.mass, end.twist, expected.twist, before)
    met = (episodes.status != MISS) & (passage.touches > 0)
    once, only = met & (episodes.touches == 1), met & (passage.touches == 1)

    def of(known: Array, value: Array) -> Array:
        return jnp.where(known, value, jnp.nan)

    held = jnp.zeros_like(met)
    for one in passage.flight.memories.held:
        held = held | jnp.any(one.caught, axis=0)
    return Metrics(
        of(met, (change - changed) / (mass * speed**2 / 2)),
        *(of(met, part) for part in parts),
        restitution=of(once & only, -_closing(there, meeting, end.twist) / speed),
        reference_restitution=of(only, -_closing(there, meeting, expected.twist) / speed),
        effective_mass=of(met, mass),
        approach_velocity=of(met, speed),
        point=of(met[None], components(meeting.point)),
        normal=of(met[None], components(meeting.normal)),
        energy_change=change,
        reference_energy_change=changed,
        peak_force=episodes.peak_force,
        reference_peak_force=passage.force.largest,
        peak_moment=episodes.peak_moment,
        reference_peak_moment=passage.moment.largest,
        duration=episodes.duration,
        reference_duration=of(jnp.isfinite(passage.flight.time), passage.touched),
        touches=episodes.touches,
        reference_touches=passage.touches,
        penetration=episodes.penetration,
        captured=episodes.status == CAPTURED,
        reference_captured=held,
        status=episodes.status,
    )


def _closing(pose: Pose, meeting: Meeting, twist: Twist) -> Array:
    """Speed [m/s] at which the point of the first touch, met at a pose, closes at another's twist."""
    velocity = twist.linear + cross(twist.angular, meeting.point - pose.position)
    return -dot(meeting.normal, velocity)


def _later(bodies: Pair, flown: list[tuple[States, Array]]) -> list[Moment]:
    """After free flights from states [s]."""
    # Loops, not unrolled: fused into one another they would be worked out over and over.
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *flown)
    _, states = lax.scan(lambda _, one: (None, glide(bodies, *one)), None, stacked)

    def moment(_, states: States) -> tuple[None, Moment]:
        _, twist = relative(bodies, states)
        energies = [kinetic_energy(*one) for one in zip(bodies, states, strict=True)]
        return None, Moment(twist, energies[0] + energies[1], mass_matrix(bodies, states))

    _, moments = lax.scan(moment, None, states)
    return [jax.tree.map(lambda leaf, at=at: leaf[at], moments) for at in range(len(flown))]


def _twist_parts(matrix: Array, after: Twist, expected: Twist, before: Twist) -> tuple[Array, ...]:
    """Error of a twist in the norm of M, and its parts along the impulse, lateral, rotational."""
    error, impulse = (
        jnp.stack(jax.tree.leaves(jax.tree.map(jnp.subtract, one, other)))
        for one, other in ((after, expected), (expected, before))
    )

    def square(vector: Array) -> Array:
        return jnp.sum(vector[:, None] * matrix * vector[None], axis=(0, 1))

    size = root(square(impulse))
    scale_ = 1 / jnp.where(size > 0, size, jnp.nan)
    half = square_root(matrix)
    weighed, along = (jnp.sum(half * vector[None], axis=1) for vector in (error, scale_[None] * impulse))
    normal = jnp.sum(weighed * along, axis=0)
    rest = weighed - normal[None] * along
    lateral, rotational = (root(jnp.sum(part**2, axis=0)) for part in (rest[:3], rest[3:]))
    total = root(square(error))
    return total * scale_, normal * scale_, lateral * scale_, rotational * scale_
