"""Evaluation of batches of any size on all cores, for rigs that move along one axis or in six.

Lanes are sorted and divided into tiles: by delay, since lanes with equal delays read their delay lines
together, and by expected duration, since a tile ends with its slowest lane. Tiles are assigned to the devices
in turn. Batches are padded to a few sizes, so that most calls reuse a compiled program.
"""

import abc
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from jaxhil.laws.simulation_base import Gains
from jaxhil.simulation import cached_programs
from jaxhil.simulation.jax_environment import ROLLOUT_OPTIONS
from jaxhil.simulation.outcome import Outcome

TILE_SIZE = 64  # lanes run together on a device; more do not fit into its first-level cache
MIN_TILE_SIZE = 16
DEVICE_AXIS = PartitionSpec("device")  # leading axis: the device that has the tiles
MIN_TILES_PER_DELAY = 8  # least number for sorting by delay; with fewer, tiles have more uneven durations


class Batch(NamedTuple):
    """Scenarios on the devices, as `RigModel.place_batch` distributes them."""

    scenarios: Any  # distributed to the devices
    assignment: "_TileAssignment"  # assignment of lanes to tiles
    places: np.ndarray  # index of each lane in the flattened assignment


class RigModel(abc.ABC):
    """Model of a rig along one axis or in six: how its scenarios are drawn, run and compared.

    Loops and scenarios are those that the model itself builds. A model has no state and equals any other
    instance of its class.
    """

    axes: ClassVar[int]  # 1 or 6
    run_name: ClassVar[str]  # what a run consists of: a contact or an episode
    # names of the errors of a run; an outcome has the rows of the first error, then those of the next
    errors: ClassVar[tuple[str, ...]]
    compiler_options: ClassVar[Mapping[str, int | str]] = ROLLOUT_OPTIONS  # for batches

    @abc.abstractmethod
    def scenarios(
        self, mechanism: Any, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
    ) -> Any:
        """Return scenarios of a mechanism as NumPy arrays: the nominal one, or those of the draws.

        Noise keys depend only on `seed` and on `first` + lane.
        """

    @abc.abstractmethod
    def loop(self, mechanism: Any, compensator: str, scenarios: Any, **parts: bool) -> Any:
        """Return the loop that runs all the scenarios; `parts` are options of the one-axis model."""

    @abc.abstractmethod
    def runs(self, mechanism: Any) -> int:
        """Return the number of contacts or episodes of a scenario."""

    @abc.abstractmethod
    def run(self, loop: Any, gains: Gains, scenario: Any) -> Outcome:
        """Run a batch of scenarios, given as JAX arrays."""

    @abc.abstractmethod
    def at_rest(self, scenarios: Any, idle: np.ndarray) -> Any:
        """Return scenarios in which the `idle` lanes do nothing."""

    @abc.abstractmethod
    def expected_duration(self, scenarios: Any) -> np.ndarray:
        """Return a rough duration [s] of each run, used only for sorting."""

    @abc.abstractmethod
    def whole_delays(self, scenarios: Any) -> np.ndarray:
        """Return a number that differs if a delay's whole periods differ, used only for sorting."""

    @abc.abstractmethod
    def without_noise(self, scenarios: Any) -> Any:
        """Return the scenarios with noise-free sensors."""

    @abc.abstractmethod
    def with_compensator(self, loop: Any, compensator: str) -> Any:
        """Return the loop with another compensator."""

    @abc.abstractmethod
    def compensator_name(self, loop: Any) -> str:
        """Return the name of a loop's compensator."""

    def prepared(self, loop: Any, scenarios: Any) -> Any:
        """Return the input of `outcome`, which depends on the scenarios but not on the gains."""
        return scenarios

    def outcome(self, loop: Any, gains: Gains, rig: Any) -> Outcome:
        """Return the outcome of a result of `prepared`; differentiable with respect to the gains."""
        return self.run(loop, gains, rig)

    def noise_amplification(self, loop: Any, gains: Gains, rig: Any) -> Float[Array, "*batch"]:
        """Return the compensator's amplification of the force sensor's noise [1]; 1 if unknown."""
        return jnp.ones_like(rig.control_period)

    def rows(self, mechanism: Any) -> int:
        """Return the number of rows of an outcome: errors times runs."""
        return len(self.errors) * self.runs(mechanism)

    def by_error(self, outcome: Outcome) -> dict[str, Outcome]:
        """Return the outcome of each error separately, by the error's name."""
        runs = len(outcome.error) // len(self.errors)
        return {
            name: jax.tree.map(lambda leaf, first=first: leaf[first : first + runs], outcome)
            for name, first in zip(self.errors, range(0, len(outcome.error), runs), strict=True)
        }

    def evaluate(self, loop: Any, gains: Mapping[str, Any], scenarios: Any, at_least: int = 1) -> Outcome:
        """Run `scenarios` (NumPy arrays, one batch axis) on all devices; return NumPy arrays.

        `gains` are scalars, or all of them have one value per lane; they are converted to the scenarios'
        precision. Batches of up to `at_least` lanes share a compiled program. A lane's outcome does not
        depend, to the bit, on the other lanes or on its position among them.
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
        """Start `evaluate`; the returned function waits for the value of `wanted(outcome)`."""
        return self.begin_batch(loop, gains, self.place_batch(scenarios, at_least), wanted)

    def place_batch(self, scenarios: Any, at_least: int = 1) -> Batch:
        """Distribute scenarios to the devices; the arguments are those of `evaluate`."""
        dealt = self._assign_tiles(scenarios, at_least)
        places = np.empty_like(dealt.lane, shape=count_lanes(scenarios))
        places[dealt.lane[~dealt.idle]] = np.flatnonzero(~dealt.idle)
        # Every leaf is placed explicitly, since JAX compiles another program for another placement.
        return Batch(_place_leaves(self._arrange_scenarios(dealt, scenarios), DEVICE_AXIS), dealt, places)

    def begin_batch(
        self,
        loop: Any,
        gains: Mapping[str, Any],
        batch: Batch,
        wanted: Callable[[Outcome], Any] = lambda outcome: outcome,
    ) -> Callable[[], Any]:
        """Start the evaluation of placed scenarios; see `begin_evaluation`."""
        common, per_lane = _arrange_gains(batch.assignment, batch.scenarios, gains)
        placed = _place_leaves(common, PartitionSpec()), _place_leaves(per_lane, DEVICE_AXIS)
        running = wanted(self.run_tiles(loop, *placed, batch.scenarios))

        def unfold(leaf):
            # (devices, tiles, ..., tile) -> (..., lanes); each device's part is read from that device.
            devices, tiles, *slots, tile = leaf.shape
            rows = np.empty((*slots, devices, tiles, tile), leaf.dtype)
            for part in leaf.addressable_shards:
                rows[..., part.index[0], :, :] = np.moveaxis(np.asarray(part.data), (0, 1), (-3, -2))
            return np.take(rows.reshape(*slots, -1), batch.places, axis=-1)

        return lambda: jax.tree.map(unfold, running)

    def shard(
        self, scenarios: Any, gains: Mapping[str, Any], at_least: int = 1
    ) -> tuple[dict[str, Any], dict[str, Any], Any]:
        """Return arguments of `run_tiles`: gains common to all lanes, gains per lane, and scenarios.

        Leaves are (devices, tiles, ..., lanes of a tile), padded with idle lanes.
        """
        dealt = self._assign_tiles(scenarios, at_least)
        return *_arrange_gains(dealt, scenarios, gains), self._arrange_scenarios(dealt, scenarios)

    def run_tiles(self, loop: Any, common: Any, per_lane: Any, scenarios: Any) -> Outcome:
        """Run the result of `shard` after `place_on_devices`; leaves are (devices, tiles, ..., lanes)."""
        static, options = (self, loop), self.compiler_options
        return cached_programs.run_cached(run_tiles, static, common, per_lane, scenarios, options=options)

    def _assign_tiles(self, scenarios: Any, at_least: int) -> "_TileAssignment":
        """Assign lanes to tiles of the devices; fill up with idle lanes."""
        number = count_lanes(scenarios)
        capacity = max(number, at_least)
        devices = jax.device_count()
        tile = TILE_SIZE
        while tile > MIN_TILE_SIZE and tile * devices >= 2 * capacity:
            tile //= 2
        # Powers of two up to 16 tiles per device, then multiples of 16, give few programs and little padding.
        tiles = -(-capacity // (tile * devices))
        tiles = 1 << (tiles - 1).bit_length() if tiles <= 16 else -(-tiles // 16) * 16
        lanes = tiles * tile * devices

        def fold(order):
            # Tiles of similar duration go to different devices.
            return order.reshape(tiles, devices, tile).swapaxes(0, 1)

        return _TileAssignment(
            fold(np.resize(self._sort_lanes(scenarios), lanes)), fold(np.arange(lanes) >= number)
        )

    def _sort_lanes(self, scenarios: Any) -> np.ndarray:
        """Return the order of lanes: by delay, if there are enough lanes per delay, then by duration."""
        duration, delays = self.expected_duration(scenarios), self.whole_delays(scenarios)
        if MIN_TILES_PER_DELAY * TILE_SIZE * len(np.unique(delays)) > len(delays):
            delays = np.zeros_like(delays)
        order = np.argsort(-duration)
        return order[np.argsort(delays[order], kind="stable")]

    def _arrange_scenarios(self, dealt: "_TileAssignment", scenarios: Any) -> Any:
        """Return scenarios in the order of the assignment."""

        def fold(leaf):
            if leaf.strides[-1] == 0:
                value = leaf[..., 0]
                return _broadcast_to_lanes(value.tobytes(), value.dtype, value.shape, dealt.lane.shape)
            return _arrange_leaf(dealt, leaf)

        return self.at_rest(jax.tree.map(fold, scenarios), dealt.idle)


def place_on_devices(common: Any, per_lane: Any, scenarios: Any) -> tuple[Any, Any, Any]:
    """Place the result of `RigModel.shard` on its devices, for several runs."""
    return (
        _place_leaves(common, PartitionSpec()),
        _place_leaves(per_lane, DEVICE_AXIS),
        _place_leaves(scenarios, DEVICE_AXIS),
    )


def count_lanes(scenarios: Any) -> int:
    """Return the number of scenarios."""
    return np.shape(scenarios.control_period)[-1]


def run_tiles(static: tuple[RigModel, Any], common: Any, per_lane: Any, scenarios: Any) -> Outcome:
    """Run the tiles of all devices; `static` is the model and the loop."""
    model, loop = static

    def one_device(common, arguments):
        def one_tile(arguments):
            gains, scenario = arguments
            return model.run(loop, {**common, **gains}, scenario)

        tiles = jax.tree.map(lambda leaf: leaf[0], arguments)
        return jax.tree.map(lambda leaf: leaf[None], jax.lax.map(one_tile, tiles))

    # Devices exchange no data and do not wait for each other.
    specs = PartitionSpec(), DEVICE_AXIS
    return jax.shard_map(
        one_device, mesh=_build_device_mesh(), in_specs=specs, out_specs=DEVICE_AXIS, check_vma=False
    )(common, (per_lane, scenarios))


class _TileAssignment(NamedTuple):
    """Assignment of lanes to tiles, (devices, tiles, lanes of a tile)."""

    lane: np.ndarray  # index of the lane
    idle: np.ndarray  # whether the lane only fills the tile


def _place_leaves(tree: Any, spec: PartitionSpec) -> Any:
    """Place the leaves of a tree on the devices."""
    return jax.device_put(tree, NamedSharding(_build_device_mesh(), spec))


def _arrange_gains(dealt: _TileAssignment, scenarios: Any, gains: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return gains common to all lanes, and gains per lane in the order of the assignment."""
    # The program computes in the scenarios' precision.
    values = {name: np.asarray(value, scenarios.control_period.dtype) for name, value in gains.items()}
    common = {name: value for name, value in values.items() if not value.ndim}
    return common, {name: _arrange_leaf(dealt, value) for name, value in values.items() if value.ndim}


def _arrange_leaf(dealt: _TileAssignment, leaf: np.ndarray) -> np.ndarray:
    """Return a leaf in the order of the assignment, (devices, tiles, ..., lanes of a tile)."""
    return np.moveaxis(np.take(leaf, dealt.lane, axis=-1), (-3, -2), (0, 1))


@lru_cache(maxsize=128)  # leaves; enough for a few batches of similar scenarios
def _broadcast_to_lanes(content, dtype, slots, lanes):
    """Place a value common to all lanes on the devices; it is sent once for all batches."""
    devices, tiles, tile = lanes
    value = np.frombuffer(content, dtype).reshape(1, 1, *slots, 1)
    return jax.device_put(
        np.broadcast_to(value, (devices, tiles, *slots, tile)),
        NamedSharding(_build_device_mesh(), DEVICE_AXIS),
    )


def _build_device_mesh():
    """Return the mesh of all devices."""
    return jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))
