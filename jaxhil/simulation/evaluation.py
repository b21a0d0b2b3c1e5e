"""Evaluation of batches of any size on every core, for rigs that move along one axis or in six.

Lanes are sorted and cut into tiles: by their delays, as lanes that look back alike are read at once, and by
how long they will take, as a tile ends with its slowest lane. Tiles are dealt out to the devices in turn.
Batches are padded to a few sizes, so that most calls reuse a compiled program.
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
from jaxhil.simulation import kept_programs
from jaxhil.simulation.environment import ROLLOUT
from jaxhil.simulation.outcome import Outcome

TILE = 64  # lanes computed side by side on a device: more leave its first cache
SMALLEST_TILE = 16
OWN = PartitionSpec("device")  # each device has its own tiles
TILES_OF_A_DELAY = 8  # at least, to sort by: with fewer, tiles would wait longer for their slowest lanes


class Batch(NamedTuple):
    """Scenarios on the devices, as `RigModel.place_batch` deals them out."""

    scenarios: Any  # dealt out, on the devices
    dealt: "_Dealt"  # which lanes are where
    places: np.ndarray  # where each lane is among those dealt out


class RigModel(abc.ABC):
    """Model of a rig along one axis or in six: how its scenarios are drawn, run and compared.

    Loops and scenarios are those that the model itself builds. A model has no state and equals any other
    of its class.
    """

    axes: ClassVar[int]  # 1 or 6
    run_name: ClassVar[str]  # what a run consists of: a contact or an episode
    # Errors of each of these; an outcome has the rows of the first error, then those of the next.
    errors: ClassVar[tuple[str, ...]]
    compiler_options: ClassVar[Mapping[str, int | str]] = ROLLOUT  # for batches

    @abc.abstractmethod
    def scenarios(
        self, mechanism: Any, draws: Mapping[str, Any] | None = None, seed: int = 0, first: int = 0
    ) -> Any:
        """Return scenarios of a mechanism as NumPy arrays, nominal ones or those of the draws.

        Noise keys depend on `seed` and on `first` + lane alone.
        """

    @abc.abstractmethod
    def loop(self, mechanism: Any, compensator: str, scenarios: Any, **parts: bool) -> Any:
        """Return the loop that runs all the scenarios; `parts` are options that one axis has."""

    @abc.abstractmethod
    def runs(self, mechanism: Any) -> int:
        """Return how many contacts or episodes a scenario has."""

    @abc.abstractmethod
    def run(self, loop: Any, gains: Gains, scenario: Any) -> Outcome:
        """Run a batch of scenarios, as arrays of JAX."""

    @abc.abstractmethod
    def at_rest(self, scenarios: Any, idle: np.ndarray) -> Any:
        """Return scenarios of which the `idle` lanes do nothing."""

    @abc.abstractmethod
    def expected_duration(self, scenarios: Any) -> np.ndarray:
        """Return the order of each run's duration [s]; for sorting only."""

    @abc.abstractmethod
    def whole_delays(self, scenarios: Any) -> np.ndarray:
        """Return a number that differs where the whole periods of a delay do; for sorting only."""

    @abc.abstractmethod
    def without_noise(self, scenarios: Any) -> Any:
        """Return the scenarios with sensors that have no noise."""

    @abc.abstractmethod
    def with_compensator(self, loop: Any, compensator: str) -> Any:
        """Return the loop with another compensator."""

    @abc.abstractmethod
    def compensator_name(self, loop: Any) -> str:
        """Return the name of a loop's compensator."""

    def prepared(self, loop: Any, scenarios: Any) -> Any:
        """Return what `outcome` needs of scenarios, worked out once for all gains."""
        return scenarios

    def outcome(self, loop: Any, gains: Gains, rig: Any) -> Outcome:
        """Return the outcome of what `prepared` returned, differentiable by the gains."""
        return self.run(loop, gains, rig)

    def noise_amplification(self, loop: Any, gains: Gains, rig: Any) -> Float[Array, "*batch"]:
        """Return by how much the compensator amplifies the force sensor's noise [1]; 1 if it is not known."""
        return jnp.ones_like(rig.control_period)

    def rows(self, mechanism: Any) -> int:
        """Return how many rows an outcome has for a mechanism: every error of every run."""
        return len(self.errors) * self.runs(mechanism)

    def by_error(self, outcome: Outcome) -> dict[str, Outcome]:
        """Return the outcome of each error by itself, by its name."""
        runs = len(outcome.error) // len(self.errors)
        return {
            name: jax.tree.map(lambda leaf, first=first: leaf[first : first + runs], outcome)
            for name, first in zip(self.errors, range(0, len(outcome.error), runs), strict=True)
        }

    def evaluate(self, loop: Any, gains: Mapping[str, Any], scenarios: Any, at_least: int = 1) -> Outcome:
        """Run `scenarios` (NumPy arrays, one batch axis) on every device; return NumPy arrays.

        `gains` are scalars, or all of them one value per lane; they are taken in the scenarios' precision.
        Batches of up to `at_least` lanes share the compiled program of that many. To the bit, a lane's
        outcome depends neither on the lanes beside it nor on its place among them.
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
        """Start `evaluate`; the function returned waits for what is `wanted` of the outcome."""
        return self.begin_batch(loop, gains, self.place_batch(scenarios, at_least), wanted)

    def place_batch(self, scenarios: Any, at_least: int = 1) -> Batch:
        """Deal scenarios, as `evaluate` takes them, out to the devices."""
        dealt = self._deal(scenarios, at_least)
        places = np.empty_like(dealt.lane, shape=lanes_of(scenarios))
        places[dealt.lane[~dealt.idle]] = np.flatnonzero(~dealt.idle)
        # Every leaf is placed: otherwise the source of a leaf would select another program.
        return Batch(_placed(self._fold(dealt, scenarios), OWN), dealt, places)

    def begin_batch(
        self,
        loop: Any,
        gains: Mapping[str, Any],
        batch: Batch,
        wanted: Callable[[Outcome], Any] = lambda outcome: outcome,
    ) -> Callable[[], Any]:
        """Start the evaluation of scenarios that are placed already; see `begin_evaluation`."""
        common, per_lane = _fold_gains(batch.dealt, batch.scenarios, gains)
        placed = _placed(common, PartitionSpec()), _placed(per_lane, OWN)
        running = wanted(self.run_tiles(loop, *placed, batch.scenarios))

        def unfold(leaf):
            # (devices, tiles, ..., tile) -> (..., lanes), each device's part read where it is.
            devices, tiles, *slots, tile = leaf.shape
            rows = np.empty((*slots, devices, tiles, tile), leaf.dtype)
            for part in leaf.addressable_shards:
                rows[..., part.index[0], :, :] = np.moveaxis(np.asarray(part.data), (0, 1), (-3, -2))
            return np.take(rows.reshape(*slots, -1), batch.places, axis=-1)

        return lambda: jax.tree.map(unfold, running)

    def shard(
        self, scenarios: Any, gains: Mapping[str, Any], at_least: int = 1
    ) -> tuple[dict[str, Any], dict[str, Any], Any]:
        """Return arguments of `run_tiles`: gains common to all lanes, gains per lane and scenarios.

        Leaves are (devices, tiles, ..., lanes of a tile), dealt out and padded with idle lanes.
        """
        dealt = self._deal(scenarios, at_least)
        return *_fold_gains(dealt, scenarios, gains), self._fold(dealt, scenarios)

    def run_tiles(self, loop: Any, common: Any, per_lane: Any, scenarios: Any) -> Outcome:
        """Run what `shard` made and `place` placed, each leaf (devices, tiles, ..., lanes of a tile)."""
        static, options = (self, loop), self.compiler_options
        return kept_programs.run(run_tiles, static, common, per_lane, scenarios, options=options)

    def _deal(self, scenarios: Any, at_least: int) -> "_Dealt":
        number = lanes_of(scenarios)
        room = max(number, at_least)
        devices = jax.device_count()
        tile = TILE
        while tile > SMALLEST_TILE and tile * devices >= 2 * room:
            tile //= 2
        # Tiles per device in powers of two up to 16, then multiples of 16: few programs, little padding.
        tiles = -(-room // (tile * devices))
        tiles = 1 << (tiles - 1).bit_length() if tiles <= 16 else -(-tiles // 16) * 16
        lanes = tiles * tile * devices

        def fold(order):
            # Neighbours in time fall to different devices.
            return order.reshape(tiles, devices, tile).swapaxes(0, 1)

        return _Dealt(fold(np.resize(self._in_turn(scenarios), lanes)), fold(np.arange(lanes) >= number))

    def _in_turn(self, scenarios: Any) -> np.ndarray:
        """Order lanes by their delays, unless there would be but a few tiles of each, then by duration."""
        duration, delays = self.expected_duration(scenarios), self.whole_delays(scenarios)
        if TILES_OF_A_DELAY * TILE * len(np.unique(delays)) > len(delays):
            delays = np.zeros_like(delays)
        order = np.argsort(-duration)
        return order[np.argsort(delays[order], kind="stable")]

    def _fold(self, dealt: "_Dealt", scenarios: Any) -> Any:
        """Return scenarios as they were dealt out."""

        def fold(leaf):
            if leaf.strides[-1] == 0:
                same = leaf[..., 0]
                return _in_every_lane(same.tobytes(), same.dtype, same.shape, dealt.lane.shape)
            return _by_lane(dealt, leaf)

        return self.at_rest(jax.tree.map(fold, scenarios), dealt.idle)


def place(common: Any, per_lane: Any, scenarios: Any) -> tuple[Any, Any, Any]:
    """Place what `RigModel.shard` made on its devices, for several runs of it."""
    return _placed(common, PartitionSpec()), _placed(per_lane, OWN), _placed(scenarios, OWN)


def lanes_of(scenarios: Any) -> int:
    """Return the number of scenarios."""
    return np.shape(scenarios.control_period)[-1]


def run_tiles(static: tuple[RigModel, Any], common: Any, per_lane: Any, scenarios: Any) -> Outcome:
    """Run the tiles of every device; `static` is the model with the loop."""
    model, loop = static

    def one_device(common, arguments):
        def one_tile(arguments):
            gains, scenario = arguments
            return model.run(loop, {**common, **gains}, scenario)

        tiles = jax.tree.map(lambda leaf: leaf[0], arguments)
        return jax.tree.map(lambda leaf: leaf[None], jax.lax.map(one_tile, tiles))

    # Each device ends its tiles in its own time; nothing is exchanged.
    specs = PartitionSpec(), OWN
    return jax.shard_map(one_device, mesh=_mesh(), in_specs=specs, out_specs=OWN, check_vma=False)(
        common, (per_lane, scenarios)
    )


class _Dealt(NamedTuple):
    """Lanes dealt out to tiles, (devices, tiles, lanes of a tile)."""

    lane: np.ndarray  # index of the lane
    idle: np.ndarray  # whether it only fills the tile


def _placed(tree: Any, spec: PartitionSpec) -> Any:
    return jax.device_put(tree, NamedSharding(_mesh(), spec))


def _fold_gains(dealt: _Dealt, scenarios: Any, gains: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return gains common to all lanes, and gains per lane as they were dealt out."""
    # The scenarios' precision is that of the program.
    values = {name: np.asarray(value, scenarios.control_period.dtype) for name, value in gains.items()}
    common = {name: value for name, value in values.items() if not value.ndim}
    return common, {name: _by_lane(dealt, value) for name, value in values.items() if value.ndim}


def _by_lane(dealt: _Dealt, leaf: np.ndarray) -> np.ndarray:
    return np.moveaxis(np.take(leaf, dealt.lane, axis=-1), (-3, -2), (0, 1))


@lru_cache(maxsize=128)  # leaves: a few batches of like scenarios have no more
def _in_every_lane(content, dtype, slots, lanes):
    """Place on its devices what all lanes have in common, which is sent once for all batches."""
    devices, tiles, tile = lanes
    same = np.frombuffer(content, dtype).reshape(1, 1, *slots, 1)
    return jax.device_put(np.broadcast_to(same, (devices, tiles, *slots, tile)), NamedSharding(_mesh(), OWN))


def _mesh():
    return jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))
