"""Simulation of a six-axis mechanism on the rig: results of each episode, and all ticks."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.errors import InputError, format_value
from jaxhil.files import write_csv
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.gain_choice import choose_gains
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, jax_context, supported_options
from jaxhil.simulation.run import check_seed
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.mechanism_summary import SixAxisSummary, summarise_six_axes
from jaxhil.sixdof.metrics import Metrics, compute_ideal_states, evaluate
from jaxhil.sixdof.plausibility import check_scenario
from jaxhil.sixdof.recording import RunRecord, motion, record, to_columns
from jaxhil.sixdof.relative import Pair, States, effective_mass
from jaxhil.sixdof.rollout import STATUS_NAMES
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.vectors import Vector, cross, direction, vector

GOOD_STATUSES = ("rebounded", "captured")  # statuses of episodes that ended as they should
MAX_PENETRATION_RATIO = 0.5  # penetration divided by the shapes' size, above which there is a warning [1]


class Episode(NamedTuple):
    """Results of one episode (a contact with all its touches); NaN for a result that is not defined.

    The ideal contact is the contact of two free bodies, without a rig, from the same initial states.

    Attributes:
        energy_error: Change of kinetic energy minus its change in the ideal contact, divided by the energy of
            the approach [1].
        twist_error: Norm of the difference between the twist and the ideal contact's twist, divided by the
            norm of the ideal contact's change of twist [1].
        normal_part: Component of the twist error in the direction of the ideal contact's impulse [1].
        lateral_part: Translational part of the remaining twist error [1].
        rotational_part: Rotational part of the remaining twist error [1].
        restitution: Restitution e [1]; NaN unless there is a single touch.
        reference_restitution: Restitution e* of the ideal contact [1]; NaN unless it has a single touch.
        effective_mass: Effective mass m_n at the first touch [kg].
        approach_velocity: Approach velocity along the normal of the first touch [m/s].
        point: Point of the first touch, in target frame T [m].
        normal: Normal of the target's surface at this point, outward.
        peak_force: Peak force of the real contact [N].
        reference_peak_force: Peak force of the ideal contact [N].
        peak_moment: Peak moment of the real contact, about the origin of target frame T [N m].
        reference_peak_moment: Peak moment of the ideal contact, about the same origin [N m].
        duration: Time during which the hardware touches [s].
        reference_duration: Time during which the ideal contact touches [s].
        touches: Number of touches of the hardware, for all pairs of shapes.
        reference_touches: Number of touches of the ideal contact, for all pairs of shapes.
        penetration: Largest penetration of the hardware, divided by the size of the touching shapes [1].
        status: How the episode ended, one of `rollout.STATUS_NAMES`.
    """

    energy_error: float
    twist_error: float
    normal_part: float
    lateral_part: float
    rotational_part: float
    restitution: float
    reference_restitution: float
    effective_mass: float
    approach_velocity: float
    point: tuple[float, ...]
    normal: tuple[float, ...]
    peak_force: float
    reference_peak_force: float
    peak_moment: float
    reference_peak_moment: float
    duration: float
    reference_duration: float
    touches: int
    reference_touches: int
    penetration: float
    status: str


class Final(NamedTuple):
    """Motion of the bodies at the end of a run.

    Attributes:
        time: Time since the start of the run [s].
        pose: Position and rotation vector of chaser frame C relative to target frame T, in T [m, rad].
        twist: Velocity and angular velocity of C relative to T, in T [m/s, rad/s].
        v1: Velocity of the target's centre of mass, in world axes [m/s].
        w1: Angular velocity of the target, in body axes [rad/s].
        v2: Velocity of the chaser's centre of mass, in world axes [m/s].
        w2: Angular velocity of the chaser, in body axes [rad/s].
    """

    time: float
    pose: tuple[float, ...]
    twist: tuple[float, ...]
    v1: tuple[float, ...]
    w1: tuple[float, ...]
    v2: tuple[float, ...]
    w2: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class SixAxisRun:
    """Simulated run of a six-axis mechanism with a compensator.

    Attributes:
        mechanism: Simulated mechanism.
        compensator: Name of the compensator.
        gains: Gains of the compensator by name [SI units].
        seed: Seed of the sensors' noise.
        episodes: Results of every episode (a contact with all its touches).
        status: Status of the first episode that did not end with "rebounded" or "captured"; if there is no
            such episode, status of the last episode.
        final: Motion of the numerical model at the end of the run.
        summary: Summary of the mechanism.
    """

    mechanism: SixAxisMechanism = field(repr=False)
    compensator: str
    gains: dict[str, float]
    seed: int
    episodes: tuple[Episode, ...]
    status: str
    final: Final
    summary: SixAxisSummary

    @cached_property
    def reference_final(self) -> Final:
        """Return the motion of the bodies in the ideal contact from the same start, at `final.time`."""
        return compute_ideal_final(self.mechanism, self.final.time)

    @cached_property
    def ticks(self) -> RunRecord:
        """Return the signals at all ticks of the run; they are computed at the first use."""
        with jax_context():
            return record(self.mechanism, self.compensator, self.gains, self.seed, self.final.time)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the signals at all ticks as a CSV file, in SI units with full precision.

        The file has a header line, then one line for each tick.

        Args:
            path: Path of the file.

        Raises:
            InputError: The file cannot be written.
        """
        write_csv(path, {name: column.tolist() for name, column in to_columns(self.ticks).items()})


def simulate_six_axes(
    mechanism: SixAxisMechanism, compensator: str = "none", gains: Any = None, *, seed: int = 0
) -> SixAxisRun:
    """Simulate the episodes of a nominal six-axis mechanism once.

    See `jaxhil.simulate` for the arguments; `compensator` is one of `SIX_AXIS_COMPENSATORS`. Raise
    `InputError` if an argument is invalid.
    """
    if compensator not in SIX_AXIS_COMPENSATORS:
        allowed = f"one of {', '.join(SIX_AXIS_COMPENSATORS)} for six axes"
        raise InputError(f"compensator: found {format_value(compensator)}, expected {allowed}")
    number = check_seed(seed)
    name, values = choose_gains(mechanism, compensator, gains)
    with jax_context():
        scenario = build_scenarios(mechanism, seed=number)
        check_scenario(mechanism, scenario)
        loop = make_loop(mechanism, name, scenario)
        arrays = {key: jnp.asarray(value) for key, value in values.items()}
        outcome = jax.device_get(_compiled()(loop, arrays, scenario))
    return _result(mechanism, name, values, number, outcome)


def _result(
    mechanism: SixAxisMechanism, compensator: str, gains: dict[str, float], seed: int, outcome: Any
) -> SixAxisRun:
    """Build the `SixAxisRun` from the arrays that the compiled simulation returns (`outcome`)."""
    metrics, time, final, tangential = outcome
    check_integrated(mechanism, metrics)
    episodes = episodes_of(metrics)
    bad = [episode.status for episode in episodes if episode.status not in GOOD_STATUSES]
    first = episodes[0]
    duration = math.nan if metrics.reference_captured[0, 0] else first.reference_duration
    summary = summarise_six_axes(
        mechanism, first.effective_mass, float(tangential[0]), duration,
        first.reference_peak_force, first.reference_restitution,
    )  # fmt: skip
    deep = max(episode.penetration for episode in episodes)
    if deep > MAX_PENETRATION_RATIO:
        expected = f"at most {MAX_PENETRATION_RATIO:g}: too soft or too fast shapes pass through each other"
        warning = f"contact: found a depth of {deep:.2g} times the size of the shapes, expected {expected}"
        summary = summary._replace(warnings=(*summary.warnings, warning))
    status = [*bad, episodes[-1].status][0]
    return SixAxisRun(
        mechanism=mechanism,
        compensator=compensator,
        gains=gains,
        seed=seed,
        episodes=episodes,
        status=status,
        final=_final(float(time[0]), final),
        summary=summary,
    )


def episodes_of(metrics: Metrics) -> tuple[Episode, ...]:
    """Return the first episode of a single run, and all further episodes whose status is not "miss"."""
    return tuple(
        _episode(metrics, slot)
        for slot in range(metrics.status.shape[0])
        if slot == 0 or STATUS_NAMES[int(metrics.status[slot, 0])] != "miss"
    )


def compute_ideal_final(mechanism: SixAxisMechanism, time: float) -> Final:
    """Return the motion of the bodies in the ideal contact, at a `time` [s] after the start."""
    with jax_context():
        scenario = build_scenarios(mechanism)
        return _final(time, jax.device_get(_ideal_motion(scenario, np.array([time]))))


def check_integrated(mechanism: SixAxisMechanism, metrics: Metrics) -> None:
    """Raise `InputError` if the ideal contact could not be integrated; the message says what to change."""
    if not np.all(np.isfinite(metrics.reference_duration)):
        raise InputError(f"{mechanism.name}: {_stiffest(mechanism)}")


def _stiffest(mechanism: SixAxisMechanism) -> str:
    """Return a message that names the key to change if the ideal contact takes too many time steps."""
    frictions = {name: contact.friction for name, contact in mechanism.contact.items() if contact.friction}
    slips = {name: law.slip / max(law.coefficient, 1e-9) for name, law in frictions.items() if law.slip}
    if slips:
        name = min(slips, key=slips.__getitem__)
        found = f"contact.{name}.friction.slip: found {frictions[name].slip:g} m/s"
        allowed = "a larger slip, or friction = { law = 'bristle', ... }"
    else:
        name = next(iter(mechanism.contact))
        found, allowed = f"contact.{name}: found forces", "a softer contact"
    return f"{found} for which the integration of the ideal contact takes too many steps, expected {allowed}"


def _episode(metrics: Metrics, slot: int) -> Episode:
    def value(name: str) -> Any:
        entry = np.asarray(getattr(metrics, name))[..., slot, 0]
        if name == "status":
            return STATUS_NAMES[int(entry)]
        return tuple(entry.tolist()) if entry.ndim else entry.item()

    return Episode(*map(value, Episode._fields))


def _final(time: float, motion: Any) -> Final:
    pose, twist, *velocities = (tuple(np.asarray(part, float)[:, 0].tolist()) for part in motion)
    return Final(time, pose, twist, *velocities)


@cache
def _compiled() -> Callable[..., Any]:
    return jax.jit(_run, static_argnums=0, compiler_options=supported_options(SINGLE_RUN_OPTIONS))


def _run(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> tuple[Any, ...]:
    """Simulate the runs; return metrics, duration [s], final motion, and tangential effective mass [kg]."""
    result = evaluate(loop, gains, scenario)
    final = _motion(scenario.bodies, result.final)
    return result.metrics, result.final_time, final, _tangential_mass(scenario, result.metrics)


@jax.jit
def _ideal_motion(scenario: Scenario, time: Any) -> tuple[Any, ...]:
    """Return the motion of the bodies in the ideal contact at a `time` [s], as arrays like `_motion`."""
    return _motion(scenario.bodies, compute_ideal_states(scenario, time))


def _tangential_mass(scenario: Scenario, metrics: Metrics) -> Any:
    """Return the effective mass [kg] at the point of the first touch, for a force along the surface.

    The result is the smaller of the masses in two perpendicular directions along the surface.
    """
    point, normal = (vector(part[:, 0]) for part in (metrics.point, metrics.normal))
    zero = jnp.zeros_like(normal.x)
    flat = jnp.abs(normal.x) < 0.9
    across = direction(cross(normal, Vector(jnp.where(flat, 1, zero), jnp.where(flat, zero, 1), zero)))
    sides = (across, cross(normal, across))
    return jnp.minimum(*(effective_mass(scenario.bodies, scenario.start, point, side) for side in sides))


def _motion(bodies: Pair, states: States) -> tuple[Any, ...]:
    """Return the fields of `Final` without the time, as arrays (components, lanes)."""
    pose, twist, *motions = motion(bodies, states)
    return pose, twist, *(part for rows in motions for part in (rows[7:10], rows[10:]))
