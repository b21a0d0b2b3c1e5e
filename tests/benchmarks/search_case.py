"""Tuning problem for the comparison of optimisers: a mechanism and its compiled loss.

A point is a vector of unit coordinates of the gains. Its loss is half the sum of squares of
`tuning.gains.objective.compute_residuals` over all scenarios. The scenarios are divided among the devices, so
that a single point also uses all devices.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.loop import Loop, RigConstants, build_rig_constants
from jaxhil.simulation.one_axis import ONE_AXIS
from jaxhil.simulation.scenario import Scenario
from tuning.gains.objective import RMS_OBJECTIVE, SolverProblem, compute_residuals, join_terms
from tuning.gains.tasks import (
    TuneTask,
    build_gain_bounds,
    build_task,
    group_by_program,
    join_loops,
    list_tuned_gains,
    spread_points,
)
from tuning.optimisation.unit_box import GainBounds, to_coordinates, to_gains

COMPENSATOR = "response_error"
SCENARIOS = 128
SEED = 0  # seed of the scenarios
CAPACITY = 256  # points per call of the program
SIDE_BY_SIDE = 128  # lanes that a device computes in parallel if there are many points


@dataclass(frozen=True)
class Case:
    """Tuning problem with loop, gain names and bounds; `problem` and `placed_bounds` are on the devices."""

    task: TuneTask
    loop: Loop
    names: tuple[str, ...]
    bounds: GainBounds
    problem: SolverProblem
    placed_bounds: GainBounds

    @property
    def name(self) -> str:
        return self.task.mechanism.name

    def losses(self, points: Float[np.ndarray, "points gains"]) -> Float[np.ndarray, "points"]:
        """Return the loss of every point."""
        number = len(points)
        if number > CAPACITY:
            rest = self.losses(points[CAPACITY:])
            return np.concatenate([self.losses(points[:CAPACITY]), rest])
        # A single point has its own program, without padding.
        together = 1 if number == 1 else max(1, SIDE_BY_SIDE * _devices() // SCENARIOS)
        capacity = 1 if number == 1 else CAPACITY
        padded = np.concatenate([points, np.broadcast_to(points[-1:], (capacity - number, len(self.names)))])
        static = self.loop, self.names, together
        parts = _losses(static, padded, np.array(number, np.int32), self.problem, self.placed_bounds)
        # Every device has the same number of contacts, so the mean over the devices is the mean over all
        # contacts.
        return np.mean(np.asarray(parts), axis=0)[:number]

    def warm_up(self) -> None:
        """Compile the programs that `losses` runs for one point and for several points."""
        for number in (1, 2):
            self.losses(np.full((number, len(self.names)), 0.5))

    def starts(self, number: int, seed: int) -> Float[np.ndarray, "starts gains"]:
        """Return starting points: the literature's gains, points around these gains, and random points."""
        first = np.array([self.task.literature[name] for name in self.names])
        return spread_points(self.shares_of(first), number, seed)

    def gains_of(self, coordinates: Float[np.ndarray, "*points gains"]) -> Float[np.ndarray, "*points gains"]:
        """Return the gains in their own units."""
        return to_gains(coordinates, self.bounds)

    def shares_of(self, gains: Float[np.ndarray, "*points gains"]) -> Float[np.ndarray, "*points gains"]:
        """Return the unit coordinates of gains (inverse of `gains_of`)."""
        return to_coordinates(gains, self.bounds)


def build_cases(mechanisms: Sequence[Mechanism]) -> list[Case]:
    """Return the tuning problems of the mechanisms; similar mechanisms share a compiled program."""
    tasks = [build_task(mechanism, COMPENSATOR, SCENARIOS, SEED) for mechanism in mechanisms]
    cases: dict[int, Case] = {}
    for group in group_by_program([task.loop for task in tasks], [task.scenarios for task in tasks]):
        loop = join_loops([tasks[i].loop for i in group])
        for i in group:
            cases[i] = _build_case(tasks[i], loop)
    return [cases[i] for i in range(len(tasks))]


def several(tree: Any, number: int) -> Any:
    """Repeat all arrays along a new leading axis; return NumPy arrays."""
    return jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (number, *leaf.shape)), tree)


def over_scenarios(function: Callable[..., Array], problem: SolverProblem, *arguments: Any) -> Array:
    """Apply `function(problem, *arguments)` to the scenarios of every device; return (devices, ...)."""
    everywhere = PartitionSpec()
    lanes_last = SolverProblem(
        jax.tree.map(_lanes_last, problem.rig),
        *jax.tree.map(lambda leaf: everywhere, (problem.fixed, problem.weights)),
    )
    return jax.shard_map(
        lambda *given: function(*given)[None],
        mesh=_mesh(),
        in_specs=(lanes_last, *[everywhere] * len(arguments)),
        out_specs=PartitionSpec("device"),
        check_vma=False,
    )(problem, *arguments)


def _build_case(task: TuneTask, loop: Loop) -> Case:
    if np.ptp(task.scenarios.contacts) > 0:
        raise ValueError(f"{task.mechanism.name}: scenarios of different numbers of contacts")
    names = list_tuned_gains([task])
    rig = jax.jit(_build_constants, static_argnums=0)(loop, _dealt(task.scenarios))
    fixed: Any = {name: np.asarray(value) for name, value in task.literature.items() if name not in names}
    mesh = _mesh()
    lanes_last = jax.tree.map(lambda leaf: NamedSharding(mesh, _lanes_last(leaf)), rig)
    rig = jax.device_put(rig, lanes_last)
    bounds = build_gain_bounds(task, names)
    fixed, weights, placed_bounds = jax.device_put(
        (fixed, RMS_OBJECTIVE.weights, bounds), NamedSharding(mesh, PartitionSpec())
    )
    return Case(task, loop, names, bounds, SolverProblem(rig, fixed, weights), placed_bounds)


def _build_constants(loop: Loop, scenarios: Scenario) -> RigConstants:
    return build_rig_constants(loop, scenarios)


def _dealt(scenarios: Scenario) -> Scenario:
    """Sort the scenarios so that all devices get the same number of long scenarios."""
    order = np.argsort(ONE_AXIS.expected_duration(scenarios), kind="stable")
    order = np.concatenate([order[device :: _devices()] for device in range(_devices())])
    return jax.tree.map(lambda leaf: np.asarray(leaf)[..., order], scenarios)


@partial(jax.jit, static_argnums=0)
def _losses(static, points, number, problem, bounds) -> Float[Array, "devices points"]:
    """Return the mean loss over the scenarios of each device for the first `number` points."""
    loop, names, together = static

    def one_device(problem, points, number, bounds):
        copies = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (together, *leaf.shape)), problem)

        def add_tile(i, found):
            coordinates = jax.lax.dynamic_slice_in_dim(points, i * together, together)
            rows = compute_residuals(
                (ONE_AXIS, loop, names, join_terms([RMS_OBJECTIVE])),
                jax.vmap(to_gains, (0, None))(coordinates, bounds),
                copies,
            )
            losses = jnp.sum(rows**2, axis=1) / 2
            return jax.lax.dynamic_update_slice_in_dim(found, losses, i * together, 0)

        found = jnp.zeros(len(points), points.dtype)
        return jax.lax.fori_loop(0, (number + together - 1) // together, add_tile, found)

    return over_scenarios(one_device, problem, points, number, bounds)


def _lanes_last(leaf) -> PartitionSpec:
    return PartitionSpec(*[None] * (leaf.ndim - 1), "device")


def _devices() -> int:
    return math.gcd(jax.device_count(), SCENARIOS)


def _mesh() -> Mesh:
    devices = jax.devices()[: _devices()]
    return jax.make_mesh((len(devices),), ("device",), axis_types=(AxisType.Auto,), devices=devices)
