"""Evaluation of batches of scenarios on all cores, for rigs with one axis or with six axes.

Each scenario of a batch is a lane. The lanes that run together on one device are a tile. Lanes are sorted
before they are divided into tiles. Sorting by delay lets lanes with equal delays read their delay lines
faster. Sorting by expected duration saves time, because a tile runs until its slowest lane has finished.

Tiles are distributed to the devices in turn. Batches are padded with idle lanes to a few sizes, so that most
calls reuse a compiled program. On an accelerator, a batch is a single tile per device, as far as the memory
allows (`jaxhil.simulation.tile_size`).
"""

import abc
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from jaxhil.laws.compensators import get_compensator
from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation import cached_programs
from jaxhil.simulation.jax_environment import DERIVATIVE_OPTIONS, ROLLOUT_OPTIONS
from jaxhil.simulation.outcome import Outcome
from jaxhil.simulation.tile_size import count_bytes, find_tile_size

# Maximum number of lanes per tile on a processor: more do not fit into a core's first-level cache.
TILE_SIZE = 64
MIN_TILE_SIZE = 16  # minimum number of lanes per tile, for small batches
DEVICE_AXIS = PartitionSpec("device")  # distributes arrays along their leading axis, one entry per device
# Minimum number of tiles per delay: if there are fewer, lanes are sorted by expected duration only.
MIN_TILES_PER_DELAY = 8


class Batch(NamedTuple):
    """Scenarios that `RigModel.place_batch` has distributed to the devices."""

    scenarios: Any  # scenarios on the devices, (devices, tiles, ..., lanes of a tile)
    assignment: "_TileAssignment"  # assignment of lanes to tiles
    positions: np.ndarray  # position of each lane in the flattened assignment


class RigModel(abc.ABC):
    """Interface to the simulation of rigs with one axis or with six axes.

    A model builds scenarios and loops, runs the scenarios and compares the results with the ideal contact.
    The methods of a model accept only scenarios and loops that the same model has built. A model has no
    state; all instances of a class are equal.

    A run is one contact on a rig with one axis. On a rig with six axes, a run is one episode: a contact with
    all its touches.
    """

    axes: ClassVar[int]  # number of axes, 1 or 6
    run_name: ClassVar[str]  # name of a run in messages: "contact" or "episode"
    # names of a run's error metrics; an outcome contains the first metric of all runs, then the second
    errors: ClassVar[tuple[str, ...]]
    verdict_error: ClassVar[str]  # name of the error that tuning minimises and to which limits apply
    compiler_options: ClassVar[Mapping[str, int | str]] = ROLLOUT_OPTIONS  # compiler options for batches
    derivative_options: ClassVar[Mapping[str, int | str]] = DERIVATIVE_OPTIONS  # the same with derivatives

    @abc.abstractmethod
    def scenarios(
        self, mechanism: Any, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
    ) -> Any:
        """Return scenarios of a mechanism as NumPy arrays.

        Args:
            mechanism: Mechanism to be simulated.
            draws: Values of uncertain parameters by dotted path, one per scenario; None for the nominal
                scenario.
            seed: Seed of the sensors' noise.
            first: Index of the first scenario. The noise of a scenario depends only on seed and index.
        """

    @abc.abstractmethod
    def loop(self, mechanism: Any, compensator: str, scenarios: Any, **parts: bool) -> Any:
        """Return the loop that runs all scenarios; `parts` contains options that only one-axis rigs have."""

    @abc.abstractmethod
    def runs(self, mechanism: Any) -> int:
        """Return the number of runs (contacts, or six-axis episodes) in a scenario of this mechanism."""

    @abc.abstractmethod
    def run(self, loop: Any, gains: Gains, scenario: Any) -> Outcome:
        """Run a batch of scenarios (JAX arrays) and return the outcome of every run."""

    @abc.abstractmethod
    def initial_state(self, loop: Any, gains: Gains, scenario: Any) -> Any:
        """Return the simulation's state before the first tick of a batch of scenarios (JAX arrays)."""

    @abc.abstractmethod
    def at_rest(self, scenarios: Any, idle: np.ndarray) -> Any:
        """Return a copy of the scenarios in which `idle` lanes (which only fill a tile) have no runs."""

    @abc.abstractmethod
    def expected_duration(self, scenarios: Any) -> np.ndarray:
        """Return a rough estimate of each scenario's duration [s], used only for sorting lanes."""

    @abc.abstractmethod
    def whole_delays(self, scenarios: Any) -> np.ndarray:
        """Return a sorting key for each scenario, which places scenarios with similar delays together.

        Two scenarios have equal keys if every delay has the same number of whole control periods in both.
        """

    @abc.abstractmethod
    def without_noise(self, scenarios: Any) -> Any:
        """Return a copy of the scenarios in which the sensors have no noise."""

    @abc.abstractmethod
    def with_compensator(self, loop: Any, compensator: str) -> Any:
        """Return a copy of the loop with another compensator, chosen by its name."""

    @abc.abstractmethod
    def compensator_name(self, loop: Any) -> str:
        """Return the name of a loop's compensator."""

    def with_ideal_contacts(self, batches: Sequence[Any]) -> list[Any]:
        """Add the ideal contacts to batches of scenarios, so that they are computed once for all gains.

        Batches whose ideal contacts are cheap are returned unchanged.
        """
        return list(batches)

    def prepared(self, loop: Any, scenarios: Any) -> Any:
        """Compute the part of a run that does not depend on the gains; the result is passed to `outcome`."""
        return scenarios

    def outcome(self, loop: Any, gains: Gains, rig: Any) -> Outcome:
        """Run the scenarios that `prepared` received. The outcome is differentiable with respect to gains."""
        return self.run(loop, gains, rig)

    def noise_amplification(self, loop: Any, gains: Gains, rig: Any) -> Float[Array, "*batch"]:
        """Return the factor [1] by which the compensator amplifies force sensor noise; 1 if unknown."""
        return jnp.ones_like(rig.control_period)

    def by_error(self, outcome: Outcome) -> dict[str, Outcome]:
        """Return a separate outcome for each error metric, by the name of the metric."""
        runs = len(outcome.error) // len(self.errors)
        return {
            name: jax.tree.map(lambda leaf, first=first: leaf[first : first + runs], outcome)
            for name, first in zip(self.errors, range(0, len(outcome.error), runs), strict=True)
        }

    def select_verdict_error(self, outcome: Outcome) -> Outcome:
        """Return only those rows of an outcome that contain the verdict's error.

        The verdict's error is the error that tuning minimises and that is compared with the limits.
        """
        return self.by_error(outcome)[self.verdict_error]

    def evaluate(self, loop: Any, gains: Mapping[str, Any], scenarios: Any, at_least: int = 1) -> Outcome:
        """Run scenarios on all devices and return their outcome as NumPy arrays.

        The outcome of a scenario does not depend on the other scenarios of the batch, not even in the last
        bit.

        Args:
            loop: Loop that runs the scenarios.
            gains: Gains by name [SI units], each a scalar or one value per scenario. The values are converted
                to the floating-point precision of the scenarios.
            scenarios: NumPy arrays with one batch axis.
            at_least: Number of scenarios to which smaller batches are padded, so that they share a compiled
                program.
        """
        return self.begin_evaluation(loop, gains, scenarios, at_least)()

    def begin_evaluation(
        self,
        loop: Any,
        gains: Mapping[str, Any],
        scenarios: Any,
        at_least: int = 1,
        wanted: Callable[[Outcome], Any] = lambda outcome: outcome,
    ) -> Callable[[], Any]:
        """Start an evaluation; return a function that waits for the outcome and returns `wanted(outcome)`."""
        return self.begin_batch(loop, gains, self.place_batch(scenarios, at_least, loop), wanted)

    def place_batch(self, scenarios: Any, at_least: int = 1, loop: Any = None) -> Batch:
        """Distribute scenarios to the devices; see `evaluate` for the arguments.

        On an accelerator, the memory per lane is estimated for `loop`. If `loop` is None, only the memory of
        the scenarios counts.
        """
        assignment = self._assign_tiles(scenarios, at_least, loop)
        positions = np.empty_like(assignment.lane, shape=count_lanes(scenarios))
        positions[assignment.lane[~assignment.idle]] = np.flatnonzero(~assignment.idle)
        # Place every leaf explicitly: for any other placement, JAX would compile the program again.
        arranged = self._arrange_scenarios(assignment, scenarios)
        return Batch(_place_leaves(arranged, DEVICE_AXIS), assignment, positions)

    def begin_batch(
        self,
        loop: Any,
        gains: Mapping[str, Any],
        batch: Batch,
        wanted: Callable[[Outcome], Any] = lambda outcome: outcome,
    ) -> Callable[[], Any]:
        """Start the evaluation of scenarios on the devices; see `begin_evaluation` for the result."""
        outcome = wanted(self.run_tiles(loop, *place_gains(batch, gains), batch.scenarios))
        return lambda: unfold_tiles(batch, outcome)

    def run_tiles(self, loop: Any, common: Any, per_lane: Any, scenarios: Any) -> Outcome:
        """Run the scenarios of a batch with the gains that `place_gains` returned."""
        static, options = (self, loop), self.compiler_options
        return cached_programs.run_cached(run_tiles, static, common, per_lane, scenarios, options=options)

    def count_lane_bytes(self, loop: Any, scenarios: Any) -> int:
        """Return the memory [bytes] of a scenario and, unless `loop` is None, of its state between ticks."""
        leaves, structure = jax.tree.flatten(scenarios)
        lane = tuple(jax.ShapeDtypeStruct((*leaf.shape[:-1], 1), leaf.dtype) for leaf in leaves)
        return count_bytes(lane) + (_count_state_bytes(self, loop, structure, lane) if loop else 0)

    def _assign_tiles(self, scenarios: Any, at_least: int, loop: Any) -> "_TileAssignment":
        """Assign lanes to tiles (groups of equal size) on the devices; fill the tiles with idle lanes."""
        number = count_lanes(scenarios)
        capacity = max(number, at_least)
        devices = jax.device_count()
        # Each number and each size of tiles needs a separate compiled program; both are therefore rounded up.
        units = _round_up(-(-capacity // (TILE_SIZE * devices)))
        tile = find_tile_size(units * TILE_SIZE, TILE_SIZE, lambda: self.count_lane_bytes(loop, scenarios))
        while tile > MIN_TILE_SIZE and tile * devices >= 2 * capacity:
            tile //= 2
        tiles = _round_up(-(-capacity // (tile * devices)))
        lanes = tiles * tile * devices

        def fold(order):
            # Tiles of similar duration are assigned to different devices.
            return order.reshape(tiles, devices, tile).swapaxes(0, 1)

        return _TileAssignment(
            fold(np.resize(self._sort_lanes(scenarios), lanes)), fold(np.arange(lanes) >= number)
        )

    def _sort_lanes(self, scenarios: Any) -> np.ndarray:
        """Sort lane indices by expected duration; if enough lanes share each delay, sort by delay first."""
        duration, delays = self.expected_duration(scenarios), self.whole_delays(scenarios)
        if MIN_TILES_PER_DELAY * TILE_SIZE * len(np.unique(delays)) > len(delays):
            delays = np.zeros_like(delays)
        order = np.argsort(-duration)
        return order[np.argsort(delays[order], kind="stable")]

    def _arrange_scenarios(self, assignment: "_TileAssignment", scenarios: Any) -> Any:
        def fold(leaf):
            if leaf.strides[-1] == 0:
                value = leaf[..., 0]
                return _broadcast_to_lanes(value.tobytes(), value.dtype, value.shape, assignment.lane.shape)
            return _arrange_leaf(assignment, leaf)

        return self.at_rest(jax.tree.map(fold, scenarios), assignment.idle)


def place_gains(batch: Batch, gains: Mapping[str, Any]) -> tuple[Any, Any]:
    """Place gains on the devices; return gains common to all lanes, and gains per lane in groups (tiles)."""
    # The program computes in the floating-point precision of the scenarios.
    dtype = batch.scenarios.control_period.dtype
    values = {name: np.asarray(value, dtype) for name, value in gains.items()}
    common = {name: value for name, value in values.items() if not value.ndim}
    per_lane = {name: _arrange_leaf(batch.assignment, v) for name, v in values.items() if v.ndim}
    return _place_leaves(common, PartitionSpec()), _place_leaves(per_lane, DEVICE_AXIS)


def count_lanes(scenarios: Any) -> int:
    """Return the number of lanes (scenarios) in a batch."""
    return np.shape(scenarios.control_period)[-1]


def run_tiles(static: tuple[RigModel, Any], common: Any, per_lane: Any, scenarios: Any) -> Outcome:
    """Run all tiles (groups of lanes): devices in parallel, the tiles of a device one after another.

    `static` is the pair (model, loop); `common` and `per_lane` are the gains from `place_gains`.
    """
    model, loop = static

    def one_tile(common, arguments):
        gains, scenario = arguments
        return model.run(loop, {**common, **gains}, scenario)

    return map_tiles(one_tile, common, (per_lane, scenarios))


def map_tiles(function: Callable[[Any, Any], Any], common: Any, per_lane: Any) -> Any:
    """Apply `function(common, tile)` to each tile in `per_lane`, (devices, tiles, ..., lanes of a tile)."""

    def one_device(common, tiles):
        tiles = jax.tree.map(lambda leaf: leaf[0], tiles)
        results = jax.lax.map(lambda tile: function(common, tile), tiles)
        return jax.tree.map(lambda leaf: leaf[None], results)

    # The devices exchange no data and do not wait for each other.
    specs = PartitionSpec(), DEVICE_AXIS
    return jax.shard_map(
        one_device, mesh=_build_device_mesh(), in_specs=specs, out_specs=DEVICE_AXIS, check_vma=False
    )(common, per_lane)


def unfold_tiles(batch: Batch, results: Any) -> Any:
    """Merge the tiles of results, (devices, tiles, ..., lanes of a tile), into NumPy arrays, (..., lanes)."""

    def unfold(leaf):
        # The results are copied from one device at a time.
        devices, tiles, *slots, tile = leaf.shape
        rows = np.empty((*slots, devices, tiles, tile), leaf.dtype)
        for part in leaf.addressable_shards:
            rows[..., part.index[0], :, :] = np.moveaxis(np.asarray(part.data), (0, 1), (-3, -2))
        return np.take(rows.reshape(*slots, -1), batch.positions, axis=-1)

    return jax.tree.map(unfold, results)


class _TileAssignment(NamedTuple):
    """Assignment of lanes to groups (tiles); arrays have the shape (devices, tiles, lanes of a tile)."""

    lane: np.ndarray  # index of the lane in the batch
    idle: np.ndarray  # whether the lane only fills the tile


def _round_up(number: int) -> int:
    """Round up to a power of two or, above 16, to a multiple of 16."""
    return 1 << (number - 1).bit_length() if number <= 16 else -(-number // 16) * 16


@lru_cache(maxsize=32)
def _count_state_bytes(model: RigModel, loop: Any, structure: Any, leaves: tuple[Any, ...]) -> int:
    """Return the memory [bytes] of a lane's state; `leaves` are the shapes of one scenario's arrays."""
    lane = jax.tree.unflatten(structure, leaves)
    compensator = get_compensator(model.compensator_name(loop), model.axes)
    gains = {gain.name: lane.control_period for gain in compensator.gains}
    return count_bytes(jax.eval_shape(partial(model.initial_state, loop), gains, lane))


def _place_leaves(tree: Any, spec: PartitionSpec) -> Any:
    return jax.device_put(tree, NamedSharding(_build_device_mesh(), spec))


def _arrange_leaf(assignment: _TileAssignment, leaf: np.ndarray) -> np.ndarray:
    """Arrange an array with one value per lane in tiles, (devices, tiles, ..., lanes of a tile)."""
    return np.moveaxis(np.take(leaf, assignment.lane, axis=-1), (-3, -2), (0, 1))


@lru_cache(maxsize=128)  # number of arrays, which is enough for a few batches of similar scenarios
def _broadcast_to_lanes(content, dtype, slots, lanes):
    """Place an array on the devices that repeats a value for all lanes; later batches reuse this array."""
    devices, tiles, tile = lanes
    value = np.frombuffer(content, dtype).reshape(1, 1, *slots, 1)
    return jax.device_put(
        np.broadcast_to(value, (devices, tiles, *slots, tile)),
        NamedSharding(_build_device_mesh(), DEVICE_AXIS),
    )


def _build_device_mesh():
    """Return JAX's mesh of all devices, with the one axis `device`."""
    return jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))
