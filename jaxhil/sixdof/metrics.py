"""Metrics of episodes: the rig's contact compared with the ideal contact with the same initial states.

Both are compared at the same time, when both are over. The relative mass matrix M at that pose relates metres
and radians: twists are compared in its norm.
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

LONGEST = 2.0  # control periods; longest step of the ideal contact's integration


class Metrics(NamedTuple):
    """Metrics of episodes, (episodes, *batch); NaN for values that they do not have."""

    energy_error: Float[Array, "..."]  # error of the change of kinetic energy, over m_n v_n^2/2 [1]
    twist_error: Float[Array, "..."]  # |V - V*| over |V* - V_0|, in the norm of M [1]
    normal_part: Float[Array, "..."]  # part of the twist error along the ideal impulse [1]
    lateral_part: Float[Array, "..."]  # translational part of the rest [1]
    rotational_part: Float[Array, "..."]  # rotational part of the rest [1]
    restitution: Float[Array, "..."]  # e at the first touch's point and normal, of a single touch [1]
    reference_restitution: Float[Array, "..."]  # e* of the ideal contact, of a single touch [1]
    effective_mass: Float[Array, "..."]  # m_n at the first touch [kg]
    approach_velocity: Float[Array, "..."]  # v_n there [m/s]
    point: Float[Array, "..."]  # point of the first touch, in T axes, (3, episodes, *batch) [m]
    normal: Float[Array, "..."]  # normal there, likewise
    energy_change: Float[Array, "..."]  # change of the kinetic energy [J]
    reference_energy_change: Float[Array, "..."]  # likewise in the ideal contact [J]
    peak_force: Float[Array, "..."]  # of the real contact [N]
    reference_peak_force: Float[Array, "..."]  # of the ideal contact [N]
    peak_moment: Float[Array, "..."]  # of the real contact, about T's origin [N m]
    reference_peak_moment: Float[Array, "..."]  # of the ideal contact [N m]
    duration: Float[Array, "..."]  # time in touch [s]
    reference_duration: Float[Array, "..."]  # of the ideal contact; NaN if not integrated to its end [s]
    touches: Int[Array, "..."]  # number of onsets of touch, over all candidates
    reference_touches: Int[Array, "..."]  # likewise in the ideal contact
    penetration: Float[Array, "..."]  # largest penetration on the rig, over the size of its shapes [1]
    captured: Bool[Array, "..."]  # whether a latch holds
    reference_captured: Bool[Array, "..."]  # likewise in the ideal contact
    status: Int[Array, "..."]  # index of `rollout.STATUS_NAMES`


class Moment(NamedTuple):
    """Two bodies at an instant."""

    twist: Twist  # twist of C against T
    energy: Float[Array, "..."]  # kinetic energy of both [J]
    mass: Float[Array, "..."]  # relative mass matrix, (6, 6, episodes, *batch)


class Result(NamedTuple):
    """Runs on the rig and their metrics."""

    metrics: Metrics
    final: States  # numerical model at the end of the run
    final_time: Float[Array, "*batch"]  # [s]


def evaluate(loop: Loop, gains: Gains, scenario: Scenario) -> Result:
    """Run and evaluate a batch of scenarios; `gains` are those of `jaxhil.sixdof.loop.build_rig`."""
    outcome = rollout(loop, gains, scenario)
    return Result(judge(scenario, outcome.episodes), outcome.final, outcome.final_time)


def reference_final(scenario: Scenario, time: Float[Array, "*batch"]) -> States:
    """Return the bodies' states in the ideal contact, at a time [s] after the scenario's start."""
    space = Space(scenario.bodies, scenario.groups, scenario.latches)
    longest = LONGEST * scenario.control_period
    flight = start_flight(space, scenario.start, jnp.minimum(longest, time))
    return fly(space, flight, time, longest, scale(space, scenario.start)).states


def judge(scenario: Scenario, episodes: Episode) -> Metrics:
    """Return the metrics of episodes."""
    slots = episodes.status.shape[0]

    def repeated(tree: Any) -> Any:
        """Add an axis of episodes before the batch."""
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
    """Return the metrics of episodes and of the ideal contacts."""
    bodies, meeting = space.bodies, meet(space, passage)
    ended = episodes.end_time - episodes.entry_time
    both = jnp.maximum(ended, over_time(passage, quiet))
    flown = [
        (episodes.entry, 0 * both),
        (episodes.end, both - ended),
        (passage.flight.states, both - passage.flight.time),
    ]
    start, end, expected = _later(bodies, flown)
    mass, (pose, before) = meeting_mass(bodies, meeting), relative(bodies, meeting.states)
    speed = _closing(pose, meeting, before)
    change, changed = end.energy - start.energy, expected.energy - start.energy
    parts = _twist_parts(expected.mass, end.twist, expected.twist, before)
    touched = (episodes.status != MISS) & (passage.touches > 0)
    once, only = touched & (episodes.touches == 1), touched & (passage.touches == 1)

    def of(is_valid: Array, value: Array) -> Array:
        return jnp.where(is_valid, value, jnp.nan)

    captured = jnp.zeros_like(touched)
    for latch in passage.flight.memories.held:
        captured = captured | jnp.any(latch.caught, axis=0)
    return Metrics(
        of(touched, (change - changed) / (mass * speed**2 / 2)),
        *(of(touched, part) for part in parts),
        restitution=of(once & only, -_closing(pose, meeting, end.twist) / speed),
        reference_restitution=of(only, -_closing(pose, meeting, expected.twist) / speed),
        effective_mass=of(touched, mass),
        approach_velocity=of(touched, speed),
        point=of(touched[None], components(meeting.point)),
        normal=of(touched[None], components(meeting.normal)),
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
        reference_captured=captured,
        status=episodes.status,
    )


def _closing(pose: Pose, meeting: Meeting, twist: Twist) -> Array:
    """Return the approach speed [m/s] of the first touch's point at a `pose`, for a `twist`."""
    velocity = twist.linear + cross(twist.angular, meeting.point - pose.position)
    return -dot(meeting.normal, velocity)


def _later(bodies: Pair, flown: list[tuple[States, Array]]) -> list[Moment]:
    """Return both bodies after free flights, given as (states, duration [s])."""
    # The loops are not unrolled: the compiler would fuse and repeat the computations.
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *flown)
    _, states = lax.scan(lambda _, flight: (None, glide(bodies, *flight)), None, stacked)

    def moment(_, states: States) -> tuple[None, Moment]:
        _, twist = relative(bodies, states)
        energies = [kinetic_energy(*item) for item in zip(bodies, states, strict=True)]
        return None, Moment(twist, energies[0] + energies[1], mass_matrix(bodies, states))

    _, moments = lax.scan(moment, None, states)
    return [jax.tree.map(lambda leaf, at=at: leaf[at], moments) for at in range(len(flown))]


def _twist_parts(matrix: Array, after: Twist, expected: Twist, before: Twist) -> tuple[Array, ...]:
    """Return the error of a twist in the norm of M, and its normal, lateral and rotational parts."""
    error, impulse = (
        jnp.stack(jax.tree.leaves(jax.tree.map(jnp.subtract, a, b)))
        for a, b in ((after, expected), (expected, before))
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
