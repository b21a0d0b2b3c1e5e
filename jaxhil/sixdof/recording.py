"""Recording of all ticks of a six-axis run and of the ideal contact, as NumPy arrays."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.rig.flight_recorder import COORDINATES, TWIST, WRENCH
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options
from jaxhil.sixdof.bodies import angular_velocity
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.building_contacts import candidate_names
from jaxhil.sixdof.forces import ContactGroup, Forces
from jaxhil.sixdof.ideal_contact_integration import IdealContactModel, sample_ideal_contact
from jaxhil.sixdof.loop import run
from jaxhil.sixdof.loop_state import Loop
from jaxhil.sixdof.relative import Pair, States, coordinates, relative
from jaxhil.sixdof.rollout import rollout
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.vectors import Vector

# Minimum number of ticks of a compiled program. Numbers are powers of two, so that runs can share programs.
MIN_TICKS = 256


class RunRecord(NamedTuple):
    """Signals of the rig and of the ideal contact at all ticks of a run, in SI units.

    Coordinates (p, theta), twists (v, w) and wrenches (force, moment about the origin) are in target frame T.
    Signals of the hardware belong to the force sensor's sampling instant. The measured signals are the
    controller's inputs, with the sensors' delays and errors. The motion of a body consists of position,
    attitude (w, x, y, z), velocity and angular velocity, in the axes of the mechanism file's table [start].

    Attributes:
        time: Time since the start of the run [s], (ticks,).
        desired: Coordinates of the numerical model, (ticks, 6).
        actual: Coordinates of the hardware, (ticks, 6).
        ideal: Coordinates in the ideal contact, (ticks, 6).
        twist_desired: Twist of the numerical model, (ticks, 6).
        twist_actual: Twist of the hardware, (ticks, 6).
        twist_ideal: Twist in the ideal contact, (ticks, 6).
        wrench: Wrench of the real contact, (ticks, 6).
        command: Wrench command, which acts on the numerical model, (ticks, 6).
        wrench_measured: Reading of the force sensor, (ticks, 6).
        pose_measured: Reading of the motion simulator's position sensor, as coordinates, (ticks, 6).
        wrench_ideal: Wrench of the ideal contact, (ticks, 6).
        target: Motion of the numerical model's target, (ticks, 13).
        chaser: Motion of the numerical model's chaser, (ticks, 13).
        names: Names of the contact candidates (pairs of shapes that may touch).
        force: Normal force of each candidate [N], (ticks, candidates).
        depth: Penetration of each candidate [m], negative if the shapes are apart, (ticks, candidates).
        point: Point where each candidate's force acts, in target frame T [m], (ticks, candidates, 3).
        push: Force of each candidate on the chaser, with friction, in target frame T [N],
            (ticks, candidates, 3).
        groups: Groups of contact candidates; a group has one contact law and the same two kinds of shapes.
    """

    time: np.ndarray
    desired: np.ndarray
    actual: np.ndarray
    ideal: np.ndarray
    twist_desired: np.ndarray
    twist_actual: np.ndarray
    twist_ideal: np.ndarray
    wrench: np.ndarray
    command: np.ndarray
    wrench_measured: np.ndarray
    pose_measured: np.ndarray
    wrench_ideal: np.ndarray
    target: np.ndarray
    chaser: np.ndarray
    names: tuple[str, ...]
    force: np.ndarray
    depth: np.ndarray
    point: np.ndarray
    push: np.ndarray
    groups: tuple[ContactGroup, ...]


MOTION = ("x", "y", "z", "qw", "qx", "qy", "qz", *TWIST)
# For each field of `RunRecord`, the suffixes of its columns in the CSV file.
COLUMNS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("desired", "actual", "ideal", "pose_measured"), COORDINATES),
    **dict.fromkeys(("twist_desired", "twist_actual", "twist_ideal"), TWIST),
    **dict.fromkeys(("wrench", "command", "wrench_measured", "wrench_ideal"), WRENCH),
    **dict.fromkeys(("target", "chaser"), MOTION),
}


def to_columns(recorded: RunRecord) -> dict[str, np.ndarray]:
    """Return the record as named columns (ticks,), such as `desired_x`, `wrench_fz` and `depth_tip`."""
    columns = {"time": recorded.time}
    for name, suffixes in COLUMNS.items():
        column = name.replace("ideal", "in_space")  # name in CSV files
        columns |= {f"{column}_{suffix}": getattr(recorded, name)[:, i] for i, suffix in enumerate(suffixes)}
    for key in ("force", "depth"):
        columns |= {f"{key}_{name}": getattr(recorded, key)[:, i] for i, name in enumerate(recorded.names)}
    return columns


def record(
    mechanism: SixAxisMechanism, compensator: str, gains: dict[str, Any], seed: int, duration: float
) -> RunRecord:
    """Simulate the nominal run of a mechanism for a `duration` [s], and record all ticks."""
    scenario = build_scenarios(mechanism, seed=seed)
    return _recorded(mechanism, make_loop(mechanism, compensator, scenario), gains, scenario, duration)


def record_scenario(
    mechanism: SixAxisMechanism, loop: Loop, gains: dict[str, Any], scenario: Scenario
) -> RunRecord:
    """Simulate the whole run of a mechanism's scenario (a batch with one lane), and record all ticks."""
    (duration,) = np.asarray(_duration()(loop, gains, scenario))
    return _recorded(mechanism, loop, gains, scenario, float(duration))


def _recorded(
    mechanism: SixAxisMechanism, loop: Loop, gains: dict[str, Any], scenario: Scenario, duration: float
) -> RunRecord:
    """Simulate a scenario with one lane for a `duration` [s], and record all ticks."""
    period = float(scenario.control_period[0])
    ticks = max(round(duration / period), 2)
    length = max(MIN_TICKS, 1 << (ticks - 1).bit_length())
    arrays = _run(loop, length, gains, scenario)
    return RunRecord(
        time=np.arange(ticks) * period,
        names=candidate_names(mechanism),
        groups=scenario.groups,
        **{name: np.asarray(value, float)[:ticks, ..., 0] for name, value in arrays.items()},
    )


@cache
def _duration() -> Callable[..., Any]:
    """Return a compiled function that computes the duration of runs [s], (lanes,)."""

    def time(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> Any:
        return rollout(loop, gains, scenario).final_time

    return jax.jit(time, static_argnums=0, compiler_options=supported_options(SINGLE_RUN_OPTIONS))


def motion(bodies: Pair, states: States) -> tuple[Any, ...]:
    """Return coordinates, twist, motion of the target, and motion of the chaser, (components, lanes) each.

    The motion of a body has 13 components: position, attitude (w, x, y, z), velocity and angular velocity.
    """
    pose, twist = relative(bodies, states)
    motions = (
        (state.position, state.attitude, state.velocity, angular_velocity(body, state))
        for body, state in zip(bodies, states, strict=True)
    )
    return tuple(_stacked(parts, 0) for parts in (coordinates(pose, twist)[0], twist, *motions))


@partial(jax.jit, static_argnums=(0, 1))
def _run(loop: Loop, ticks: int, gains: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    """Simulate a run and the ideal contact; return the arrays of `RunRecord`, (ticks, ..., lanes)."""
    loop = dataclasses.replace(loop, measures_pose=True)
    _, seen = run(loop, gains, scenario, ticks)
    contact_model, period = (
        IdealContactModel(scenario.bodies, scenario.groups, scenario.latches),
        scenario.control_period,
    )
    _, free = sample_ideal_contact(contact_model, scenario.start, period, ticks, period)
    desired, twist, target, chaser = jax.vmap(lambda states: motion(scenario.bodies, states))(seen.states)
    arrays = {
        "desired": desired,
        "actual": _stacked(coordinates(seen.pose, seen.twist)[0], 1),
        "ideal": _stacked(coordinates(free.pose, free.twist)[0], 1),
        "twist_desired": twist,
        "twist_actual": _stacked(seen.twist, 1),
        "twist_ideal": _stacked(free.twist, 1),
        "target": target,
        "chaser": chaser,
        "wrench": _stacked(seen.contact, 1),
        "command": _stacked(seen.command, 1),
        "wrench_measured": _stacked(seen.signals.wrench, 1),
        "pose_measured": seen.signals.pose_measured,
        "wrench_ideal": _stacked(free.wrench, 1),
    }
    nothing = {name: jnp.zeros((ticks, 0, *more, *period.shape)) for name, more in _OF_CANDIDATES.items()}
    candidates = [nothing, *map(_of_candidates, seen.forces)]
    return arrays | {name: jnp.concatenate([group[name] for group in candidates], axis=1) for name in nothing}


_OF_CANDIDATES = {"force": (), "depth": (), "point": (3,), "push": (3,)}


def _of_candidates(forces: Forces) -> dict[str, Any]:
    """Return force, depth, point and push of `RunRecord` for a group, (ticks, candidates, ..., lanes)."""
    touch = forces.touch
    push = forces.normal * touch.normal + forces.tangential
    return {
        "force": forces.normal,
        "depth": touch.depth,
        "point": _components(touch.point),
        "push": _components(push),
    }


def _components(points: Vector) -> Any:
    """Stack the components of vectors, (ticks, candidates, 3, lanes)."""
    return jnp.stack([points.x, points.y, points.z], axis=2)


def _stacked(parts: Any, axis: int) -> Any:
    return jnp.stack(jax.tree.leaves(parts), axis)
