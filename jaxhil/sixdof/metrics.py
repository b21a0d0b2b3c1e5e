"""Metrics of episodes (contacts with all their touches): comparison with ideal contacts from the same states.

The comparison takes place at the end of the rig's episode, when the bodies are free in both contacts. Twists
V are compared in the norm sqrt(V^T M V) of the relative mass matrix M, which relates metres and radians.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxhil.lanes import safe_sqrt
from jaxhil.laws.simulation_base import Gains
from jaxhil.sixdof.bodies import kinetic_energy
from jaxhil.sixdof.equations import square_root
from jaxhil.sixdof.first_touch import FirstTouch, first_touch_mass
from jaxhil.sixdof.ideal_contact import MAX_STEP_PERIODS, states_at
from jaxhil.sixdof.ideal_contact_integration import (
    IdealContactModel,
    error_speed,
    integrate_until,
    start_integration,
)
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.relative import Pair, Pose, States, Twist, mass_matrix, relative
from jaxhil.sixdof.rollout import CAPTURED, MISS, EpisodeBatch, rollout
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.vectors import components, cross, dot

# Minimum energy by which errors are divided, relative to the energy of the approach [1]. Without this
# minimum, a first touch that only grazes the surface would enlarge all errors.
MIN_ENERGY_SHARE = 0.05


class Metrics(NamedTuple):
    """Metrics of episodes (contacts with all their touches), (episodes, *batch); NaN for undefined metrics.

    The fields' comments use V for the twist after the contact, V* for the twist after the ideal contact, V_0
    for the twist before the contact, and M for the relative mass matrix.
    """

    energy_error: Float[Array, "..."]  # error of the energy change, divided by the approach's energy [1]
    twist_error: Float[Array, "..."]  # |V - V*| divided by |V* - V_0|, in the norm of M [1]
    normal_part: Float[Array, "..."]  # part of the twist error along the ideal impulse [1]
    lateral_part: Float[Array, "..."]  # translational part of the remaining twist error [1]
    rotational_part: Float[Array, "..."]  # rotational part of the remaining twist error [1]
    # restitution at the point and along the normal of the first touch; only for a single touch [1]
    restitution: Float[Array, "..."]
    reference_restitution: Float[Array, "..."]  # restitution of the ideal contact; only for one touch [1]
    effective_mass: Float[Array, "..."]  # effective mass m_n at the first touch [kg]
    approach_velocity: Float[Array, "..."]  # approach velocity v_n along the normal of the first touch [m/s]
    point: Float[Array, "..."]  # point of the first touch, in target frame T, (3, episodes, *batch) [m]
    normal: Float[Array, "..."]  # normal of the target's surface at `point`, (3, episodes, *batch)
    energy_change: Float[Array, "..."]  # change of the bodies' kinetic energy [J]
    reference_energy_change: Float[Array, "..."]  # change of the kinetic energy in the ideal contact [J]
    peak_force: Float[Array, "..."]  # peak force of the real contact [N]
    peak_command: Float[Array, "..."]  # largest force on the numerical model [N]
    reference_peak_force: Float[Array, "..."]  # peak force of the ideal contact [N]
    peak_moment: Float[Array, "..."]  # largest moment about T's origin in the real contact [N m]
    reference_peak_moment: Float[Array, "..."]  # largest moment about T's origin, ideal contact [N m]
    duration: Float[Array, "..."]  # time during which the hardware touches [s]
    # time during which the ideal contact touches [s]; NaN if this contact was too stiff to be integrated
    reference_duration: Float[Array, "..."]
    touches: Int[Array, "..."]  # number of touches of the hardware's shapes
    reference_touches: Int[Array, "..."]  # number of touches of the ideal contact
    penetration: Float[Array, "..."]  # largest penetration of the hardware, divided by the shapes' size [1]
    captured: Bool[Array, "..."]  # whether a latch of the hardware holds at the end
    reference_captured: Bool[Array, "..."]  # whether a latch holds at the end of the ideal contact
    status: Int[Array, "..."]  # index of `rollout.STATUS_NAMES`


class Snapshot(NamedTuple):
    """Twist, kinetic energy and mass matrix of the two bodies at one instant."""

    twist: Twist  # twist of chaser frame C relative to target frame T
    energy: Float[Array, "..."]  # kinetic energy of both bodies [J]
    mass: Float[Array, "..."]  # relative mass matrix, (6, 6, episodes, *batch)


class EvaluationResult(NamedTuple):
    """Metrics and final states of a batch of runs on the rig."""

    metrics: Metrics
    final: States  # states of the numerical model at the end of each run
    final_time: Float[Array, "*batch"]  # duration of each run [s]


def evaluate(loop: Loop, gains: Gains, scenario: Scenario) -> EvaluationResult:
    """Simulate a batch of scenarios on the rig, and compare their episodes with the ideal contacts.

    Each of the compensator's `gains` is a scalar or has the batch shape.
    """
    outcome = rollout(loop, gains, scenario)
    return EvaluationResult(
        compare_with_ideal(scenario.bodies, outcome.episodes), outcome.final, outcome.final_time
    )


def compute_ideal_states(scenario: Scenario, time: Float[Array, "*batch"]) -> States:
    """Return the bodies' states in the ideal contact at a `time` [s] after the start of the scenario."""
    contact_model = IdealContactModel(scenario.bodies, scenario.groups, scenario.latches)
    longest = MAX_STEP_PERIODS * scenario.control_period
    integration = start_integration(contact_model, scenario.start, jnp.minimum(longest, time))
    return integrate_until(
        contact_model, integration, time, longest, error_speed(contact_model, scenario.start)
    ).states


def compare_with_ideal(bodies: Pair, episodes: EpisodeBatch) -> Metrics:
    """Compare episodes (episodes, *batch) with their ideal contacts; `bodies` has a pair per run (*batch)."""
    bodies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, episodes.status.shape), bodies)
    summary, first_touch = episodes.summary, episodes.first_touch
    expected_states = states_at(bodies, summary, episodes.elapsed)
    start, end, expected, before = _take_snapshots(
        bodies, [episodes.start, episodes.end, expected_states, first_touch.states]
    )
    mass, (pose, _) = first_touch_mass(bodies, first_touch), relative(bodies, first_touch.states)
    speed = _approach_speed(pose, first_touch, before.twist)
    least = MIN_ENERGY_SHARE * _square(before.mass, _stacked(before.twist)) / 2
    approach = jnp.maximum(mass * speed**2 / 2, least)
    change, changed = end.energy - start.energy, expected.energy - start.energy
    parts = _twist_parts(expected.mass, end.twist, expected.twist, before.twist)
    touched = (episodes.status != MISS) & (summary.touches > 0)
    touched_once, is_single = touched & (episodes.touches == 1), touched & (summary.touches == 1)

    def of(is_valid: Array, value: Array) -> Array:
        return jnp.where(is_valid, value, jnp.nan)

    return Metrics(
        of(touched, (change - changed) / approach),
        *(of(touched, part) for part in parts),
        restitution=of(touched_once & is_single, -_approach_speed(pose, first_touch, end.twist) / speed),
        reference_restitution=of(is_single, -_approach_speed(pose, first_touch, expected.twist) / speed),
        effective_mass=of(touched, mass),
        approach_velocity=of(touched, speed),
        point=of(touched[None], components(first_touch.point)),
        normal=of(touched[None], components(first_touch.normal)),
        energy_change=change,
        reference_energy_change=changed,
        peak_force=episodes.peak_force,
        peak_command=episodes.peak_command,
        reference_peak_force=summary.peak_force,
        peak_moment=episodes.peak_moment,
        reference_peak_moment=summary.peak_moment,
        duration=episodes.duration,
        reference_duration=of(jnp.isfinite(summary.time), summary.touch_duration),
        touches=episodes.touches,
        reference_touches=summary.touches,
        penetration=episodes.penetration,
        captured=episodes.status == CAPTURED,
        reference_captured=summary.captured,
        status=episodes.status,
    )


def _approach_speed(pose: Pose, first_touch: FirstTouch, twist: Twist) -> Array:
    """Return the approach speed [m/s] at the point and along the normal of the first touch."""
    velocity = twist.linear + cross(twist.angular, first_touch.point - pose.position)
    return -dot(first_touch.normal, velocity)


def _take_snapshots(bodies: Pair, states: list[States]) -> list[Snapshot]:
    """Return relative twist, kinetic energy and mass matrix of the bodies for each entry of `states`."""

    # The compiler would unroll a Python loop, fuse its computations and repeat them.
    def snapshot(_, states: States) -> tuple[None, Snapshot]:
        _, twist = relative(bodies, states)
        energies = [kinetic_energy(*item) for item in zip(bodies, states, strict=True)]
        return None, Snapshot(twist, energies[0] + energies[1], mass_matrix(bodies, states))

    _, snapshots = lax.scan(snapshot, None, jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
    return [jax.tree.map(lambda leaf, at=at: leaf[at], snapshots) for at in range(len(states))]


def _twist_parts(matrix: Array, after: Twist, expected: Twist, before: Twist) -> tuple[Array, ...]:
    """Return the twist error in the norm of the mass `matrix`, and its normal, lateral and rotational parts.

    All results are divided by the norm of the ideal contact's change of twist, `expected` - `before` [1].
    """
    error, impulse = (_stacked(a) - _stacked(b) for a, b in ((after, expected), (expected, before)))
    size = safe_sqrt(_square(matrix, impulse))
    scale_ = 1 / jnp.where(size > 0, size, jnp.nan)
    half = square_root(matrix)
    weighed, along = (jnp.sum(half * vector[None], axis=1) for vector in (error, scale_[None] * impulse))
    normal = jnp.sum(weighed * along, axis=0)
    rest = weighed - normal[None] * along
    lateral, rotational = (safe_sqrt(jnp.sum(part**2, axis=0)) for part in (rest[:3], rest[3:]))
    total = safe_sqrt(_square(matrix, error))
    return total * scale_, normal * scale_, lateral * scale_, rotational * scale_


def _stacked(twist: Twist) -> Float[Array, "6 *batch"]:
    return jnp.stack(jax.tree.leaves(twist))


def _square(matrix: Float[Array, "6 6 *batch"], vector: Float[Array, "6 *batch"]) -> Float[Array, "*batch"]:
    """Return the quadratic form vector^T matrix vector."""
    return jnp.sum(vector[:, None] * matrix * vector[None], axis=(0, 1))
