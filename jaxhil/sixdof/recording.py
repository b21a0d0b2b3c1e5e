"""A run of six axes, tick by tick, as NumPy arrays of one lane; beside it the same contact in space."""

from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.simulation.environment import ONCE, known_options
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

LEAST_TICKS = 256  # a program runs a power of two of them, so that most runs share one


class Recorded(NamedTuple):
    """Every tick; coordinates (p, theta), twists (v, w) and wrenches (force, moment about T) in T axes; SI
    units."""

    time: np.ndarray  # (ticks,) [s]
    desired: np.ndarray  # (ticks, 6), of the numerical model
    actual: np.ndarray  # (ticks, 6), of the hardware when the force sensor samples it
    in_space: np.ndarray  # (ticks, 6), of two free bodies without a rig
    twist_desired: np.ndarray  # (ticks, 6), of the numerical model
    twist_actual: np.ndarray  # (ticks, 6), of the hardware when the force sensor samples it
    twist_in_space: np.ndarray  # (ticks, 6)
    wrench: np.ndarray  # (ticks, 6), of the real contact when it is sampled
    command: np.ndarray  # (ticks, 6), that moves the numerical model
    wrench_in_space: np.ndarray  # (ticks, 6)
    target: np.ndarray  # (ticks, 13), of the numerical model, as [start.target] has it: position, attitude,
    # velocity, angular velocity
    chaser: np.ndarray  # (ticks, 13), likewise
    names: tuple[str, ...]  # of the candidates
    force: np.ndarray  # (ticks, candidates), normal [N]
    depth: np.ndarray  # (ticks, candidates) [m], negative apart
    point: np.ndarray  # (ticks, candidates, 3), where they touch, in T axes [m]
    push: np.ndarray  # (ticks, candidates, 3), force on the chaser, friction included [N]
    groups: tuple[ContactGroup, ...]  # the candidates


COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")
MOTION = ("x", "y", "z", "qw", "qx", "qy", "qz", *TWIST)
# What a table has of each array, a column each.
COLUMNS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("desired", "actual", "in_space"), COORDINATES),
    **dict.fromkeys(("twist_desired", "twist_actual", "twist_in_space"), TWIST),
    **dict.fromkeys(("wrench", "command", "wrench_in_space"), WRENCH),
    **dict.fromkeys(("target", "chaser"), MOTION),
}


def table(recorded: Recorded) -> dict[str, np.ndarray]:
    """Every tick as columns (ticks,) by name, such as `desired_x`, `wrench_fz` and `depth_tip`."""
    found = {"time": recorded.time}
    for name, suffixes in COLUMNS.items():
        found |= {f"{name}_{suffix}": getattr(recorded, name)[:, i] for i, suffix in enumerate(suffixes)}
    for name in ("force", "depth"):
        found |= {f"{name}_{one}": getattr(recorded, name)[:, i] for i, one in enumerate(recorded.names)}
    return found


def record(
    mechanism: SixAxisMechanism, compensator: str, gains: dict[str, Any], seed: int, duration: float
) -> Recorded:
    """The nominal run of a mechanism for so long [s]."""
    scenario = build_scenarios(mechanism, seed=seed)
    return _recorded(mechanism, loop_of(mechanism, compensator, scenario), gains, scenario, duration)


def record_scenario(
    mechanism: SixAxisMechanism, loop: Loop, gains: dict[str, Any], scenario: Scenario
) -> Recorded:
    """The run of a scenario of a mechanism, a batch of one lane, until it is over."""
    (duration,) = np.asarray(_lasted()(loop, gains, scenario))
    return _recorded(mechanism, loop, gains, scenario, float(duration))


def _recorded(
    mechanism: SixAxisMechanism, loop: Loop, gains: dict[str, Any], scenario: Scenario, duration: float
) -> Recorded:
    period = float(scenario.control_period[0])
    ticks = max(round(duration / period), 2)
    length = max(LEAST_TICKS, 1 << (ticks - 1).bit_length())
    found = _run(loop, length, gains, scenario)
    return Recorded(
        time=np.arange(ticks) * period,
        names=candidate_names(mechanism),
        groups=scenario.groups,
        **{name: np.asarray(value, float)[:ticks, ..., 0] for name, value in found.items()},
    )


@cache
def _lasted() -> Callable[..., Any]:
    """How long a run lasts [s], (lanes,)."""

    def time(loop: Loop, gains: dict[str, Any], scenario: Scenario) -> Any:
        return rollout(loop, gains, scenario).final_time

    return jax.jit(time, static_argnums=0, compiler_options=known_options(ONCE))


def motion(bodies: Pair, states: States) -> tuple[Any, ...]:
    """Coordinates, twist, and the motion of target and chaser as [start] has it, (..., lanes)."""
    pose, twist = relative(bodies, states)
    each = (
        (one.position, one.attitude, one.velocity, angular_velocity(body, one))
        for body, one in zip(bodies, states, strict=True)
    )
    return tuple(_stacked(parts, 0) for parts in (coordinates(pose, twist)[0], twist, *each))


@partial(jax.jit, static_argnums=(0, 1))
def _run(loop: Loop, ticks: int, gains: dict[str, Any], scenario: Scenario) -> dict[str, Any]:
    _, seen = run(loop, gains, scenario, ticks)
    space, period = Space(scenario.bodies, scenario.groups, scenario.latches), scenario.control_period
    _, free = follow(space, scenario.start, period, ticks, period)
    desired, twist, target, chaser = jax.vmap(lambda states: motion(scenario.bodies, states))(seen.states)
    found = {
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
    return found | {name: jnp.concatenate([one[name] for one in candidates], axis=1) for name in nothing}


_OF_CANDIDATES = {"force": (), "depth": (), "point": (3,), "push": (3,)}


def _of_candidates(forces: Forces) -> dict[str, Any]:
    """(ticks, candidates, ..., lanes)"""
    touch = forces.touch
    push = forces.normal * touch.normal + forces.tangential
    return {
        "force": forces.normal,
        "depth": touch.depth,
        "point": _components(touch.point),
        "push": _components(push),
    }


def _components(place: Vector) -> Any:
    """(ticks, candidates, 3, lanes)"""
    return jnp.stack([place.x, place.y, place.z], axis=2)


def _stacked(parts: Any, axis: int) -> Any:
    """All components along an axis, before which are the ticks."""
    return jnp.stack(jax.tree.leaves(parts), axis)
