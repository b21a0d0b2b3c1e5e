"""Record of a six-axis run, tick by tick, as NumPy arrays of one lane, beside the ideal contact."""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options
from jaxhil.sixdof.bodies import angular_velocity
from jaxhil.sixdof.building import build_scenarios, loop_of
from jaxhil.sixdof.building_contacts import candidate_names
from jaxhil.sixdof.forces import ContactGroup, Forces
from jaxhil.sixdof.loop import Loop, run
from jaxhil.sixdof.relative import Pair, States, coordinates, relative
from jaxhil.sixdof.rollout import rollout
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.space import Space, follow
from jaxhil.sixdof.vectors import Vector

LEAST_TICKS = 256  # least length of a program; lengths are powers of two, so that most runs share one


class Recorded(NamedTuple):
    """Record of every tick, in SI units.

    Coordinates (p, theta), twists (v, w) and wrenches (force, moment about T's origin) are in T axes.
    """

    time: np.ndarray  # (ticks,) [s]
    desired: np.ndarray  # (ticks, 6), coordinates of the numerical model
    actual: np.ndarray  # (ticks, 6), coordinates of the hardware at the force sensor's sampling instant
    in_space: np.ndarray  # (ticks, 6), coordinates in the ideal contact
    twist_desired: np.ndarray  # (ticks, 6), twist of the numerical model
    twist_actual: np.ndarray  # (ticks, 6), twist of the hardware at the force sensor's sampling instant
    twist_in_space: np.ndarray  # (ticks, 6), twist in the ideal contact
    wrench: np.ndarray  # (ticks, 6), wrench of the real contact at the sampling instant
    command: np.ndarray  # (ticks, 6), wrench on the numerical model
    wrench_in_space: np.ndarray  # (ticks, 6), wrench of the ideal contact
    # (ticks, 13), numerical model as in [start.target]: position, attitude, velocity, angular velocity
    target: np.ndarray
    chaser: np.ndarray  # (ticks, 13), likewise as in [start.chaser]
    names: tuple[str, ...]  # names of the candidates
    force: np.ndarray  # (ticks, candidates), normal force [N]
    depth: np.ndarray  # (ticks, candidates), penetration [m], negative apart
    point: np.ndarray  # (ticks, candidates, 3), point of the force, in T axes [m]
    push: np.ndarray  # (ticks, candidates, 3), force on the chaser, friction included [N]
    groups: tuple[ContactGroup, ...]  # candidates


COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
MOTION = ("x", "y", "z", "qw", "qx", "qy", "qz", *TWIST)
# Suffixes of the table's columns for each array.
COLUMNS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("desired", "actual", "in_space"), COORDINATES),
    **dict.fromkeys(("twist_desired", "twist_actual", "twist_in_space"), TWIST),
    **dict.fromkeys(("wrench", "command", "wrench_in_space"), WRENCH),
    **dict.fromkeys(("target", "chaser"), MOTION),
}


def table(recorded: Recorded) -> dict[str, np.ndarray]:
    """Return all ticks as columns (ticks,) by name, such as `desired_x`, `wrench_fz` and `depth_tip`."""
    columns = {"time": recorded.time}
    for name, suffixes in COLUMNS.items():
        columns |= {f"{name}_{suffix}": getattr(recorded, name)[:, i] for i, suffix in enumerate(suffixes)}
    for key in ("force", "depth"):
        columns |= {f"{key}_{name}": getattr(recorded, key)[:, i] for i, name in enumerate(recorded.names)}
    return columns


def record(
    mechanism: SixAxisMechanism, compensator: str, gains: dict[str, Any], seed: int, duration: float
) -> Recorded:
    """Return the nominal run of a mechanism for a `duration` [s]."""
    scenario = build_scenarios(mechanism, seed=seed)
    return _recorded(mechanism, loop_of(mechanism, compensator, scenario), gains, scenario, duration)


def record_scenario(
    mechanism: SixAxisMechanism, loop: Loop, gains: dict[str, Any], scenario: Scenario
) -> Recorded:
    """Return the whole run of a scenario of a mechanism, a batch of one lane."""
    (duration,) = np.asarray(_duration()(loop, gains, scenario))
    return _recorded(mechanism, loop, gains, scenario, float(duration))


def _recorded(
    mechanism: SixAxisMechanism, loop: Loop, gains: dict[str, Any], scenario: Scenario, duration: float
) -> Recorded:
    """Return the run of one lane for a `duration` [s]."""
    period = float(scenario.control_period[0])
    ticks = max(round(duration / period), 2)
    length = max(LEAST_TICKS, 1 << (ticks - 1).bit_length())
    arrays = _run(loop, length, gains, scenario)
    return Recorded(
        time=np.arange(ticks) * period,
        names=candidate_names(mechanism),
        groups=scenario.groups,
        **{name: np.asarray(value, float)[:ticks, ..., 0] for name, value in arrays.items()},
    )


@cache
def _duration() -> Callable[..., Any]:
    """Return the compiled function for the duration of runs [s], (lanes,)."""

    def time(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> Any:
        return rollout(loop, gains, scenario).final_time

    return jax.jit(time, static_argnums=0, compiler_options=supported_options(SINGLE_RUN_OPTIONS))


def motion(bodies: Pair, states: States) -> tuple[Any, ...]:
    """Return coordinates, twist, and the motion of target and chaser as in [start], (..., lanes)."""
    pose, twist = relative(bodies, states)
    motions = (
        (state.position, state.attitude, state.velocity, angular_velocity(body, state))
        for body, state in zip(bodies, states, strict=True)
    )
    return tuple(_stacked(parts, 0) for parts in (coordinates(pose, twist)[0], twist, *motions))


@partial(jax.jit, static_argnums=(0, 1))
def _run(loop: Loop, ticks: int, gains: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    """Return the recorded arrays, (ticks, ..., lanes), of a run and of the ideal contact."""
    _, seen = run(loop, gains, scenario, ticks)
    space, period = Space(scenario.bodies, scenario.groups, scenario.latches), scenario.control_period
    _, free = follow(space, scenario.start, period, ticks, period)
    desired, twist, target, chaser = jax.vmap(lambda states: motion(scenario.bodies, states))(seen.states)
    arrays = {
        "desired": desired,
        "actual": _stacked(coordinates(seen.pose, seen.twist)[0], 1),
        "in_space": _stacked(coordinates(free.pose, free.twist)[0], 1),
        "twist_desired": twist,
        "twist_actual": _stacked(seen.twist, 1),
        "twist_in_space": _stacked(free.twist, 1),
        "target": target,
        "chaser": chaser,
        "wrench": _stacked(seen.contact, 1),
        "command": _stacked(seen.command, 1),
        "wrench_in_space": _stacked(free.wrench, 1),
    }
    nothing = {name: jnp.zeros((ticks, 0, *more, *period.shape)) for name, more in _OF_CANDIDATES.items()}
    candidates = [nothing, *map(_of_candidates, seen.forces)]
    return arrays | {name: jnp.concatenate([group[name] for group in candidates], axis=1) for name in nothing}


_OF_CANDIDATES = {"force": (), "depth": (), "point": (3,), "push": (3,)}


def _of_candidates(forces: Forces) -> dict[str, Any]:
    """Return the arrays of a group's candidates, (ticks, candidates, ..., lanes)."""
    touch = forces.touch
    push = forces.normal * touch.normal + forces.tangential
    return {
        "force": forces.normal,
        "depth": touch.depth,
        "point": _components(touch.point),
        "push": _components(push),
    }


def _components(points: Vector) -> Any:
    """Return the components of vectors, (ticks, candidates, 3, lanes)."""
    return jnp.stack([points.x, points.y, points.z], axis=2)


def _stacked(parts: Any, axis: int) -> Any:
    """Return all components along an axis."""
    return jnp.stack(jax.tree.leaves(parts), axis)
