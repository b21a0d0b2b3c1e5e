"""Batches of any size, on every core: runs with their errors against the undelayed reference.

Lanes are sorted and cut into tiles: by their delays, as lanes that look back alike are read at once, and by
how long they will take, as a tile ends with its own slowest lane. Tiles are dealt out to the devices in turn.
Batches are padded to a few sizes, so that most calls reuse a compiled program.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache, singledispatch
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float

from jaxhil.contact.laws import ContactParameters
from jaxhil.contact.reference import Reference
from jaxhil.simulation import kept_programs
from jaxhil.simulation.contact_bounds import unlike_ideal
from jaxhil.simulation.environment import ROLLOUT
from jaxhil.simulation.loop import Loop
from jaxhil.simulation.metrics import OK, Metrics
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import Scenario

TILE = 64  # lanes computed side by side on a device: more leave its first cache
SMALLEST_TILE = 16
OWN = PartitionSpec("device")  # each device has its own tiles
TILES_OF_A_DELAY = 8  # at least, to sort by: with fewer, tiles would wait longer for their slowest lanes


class Outcome(NamedTuple):
    """A run beside the undelayed reference, per contact, (slots, *batch)."""

    metrics: Metrics  # of the run
    # e* of the same contact in space, entered at the same speed [1]
    reference_restitution: Float[Array, "slots *batch"]
    reference_peak_force: Float[Array, "slots *batch"]  # of that contact [N]
    # of that contact [s]; infinite if the bodies never separate
    reference_duration: Float[Array, "slots *batch"]
    error: Float[Array, "slots *batch"]  # e - e* [1]
    peak_ratio: Float[Array, "slots *batch"]  # largest |F_c| over the reference's peak force [1]
    # excess variation of F_c (`Metrics`) over the reference's peak force [1]
    chatter: Float[Array, "slots *batch"]
    wanted: Bool[Array, "slots *batch"]  # whether the contact was asked for
    good: Bool[Array, "slots *batch"]  # whether it was reached and ended well
    # whether its real force or its duration is beyond the bounds beside the ideal contact (`contact_bounds`)
    unlike: Bool[Array, "slots *batch"]

    @property
    def peak_force_ratio(self) -> Any:
        """Largest real contact force over the ideal contact's peak force [1]."""
        return self.metrics.peak_force / self.reference_peak_force

    @property
    def duration_ratio(self) -> Any:
        """Time with a real contact force over the ideal contact's duration [1]."""
        return self.metrics.duration / self.reference_duration


def compare_with_reference(loop: Loop, scenario: Scenario, metrics: Metrics) -> Outcome:
    """Set a run beside the same contacts in space, each entered at the speed it had on the rig."""
    slots = metrics.restitution.shape[0]
    number = jnp.arange(slots, dtype=scenario.contacts.dtype).reshape(
        slots, *[1] * (metrics.restitution.ndim - 1)
    )
    wanted = number < scenario.contacts[None]
    good = wanted & (metrics.status == OK)
    velocity = jnp.where(good, metrics.approach_velocity, scenario.velocity[None])
    contact = parameters_by_slot(scenario.contact)
    mass = jnp.broadcast_to(scenario.equivalent_mass, velocity.shape)
    reference = loop.law.reference(contact, mass, velocity)
    known = scenario.reference
    if known is not None:
        given = ~jnp.isnan(known.restitution)
        reference = Reference(*(jnp.where(given, a, b) for a, b in zip(known, reference, strict=True)))
    return Outcome(
        metrics=metrics,
        reference_restitution=reference.restitution,
        reference_peak_force=reference.peak_force,
        reference_duration=reference.duration,
        error=metrics.restitution - reference.restitution,
        peak_ratio=metrics.peak_command / reference.peak_force,
        chatter=metrics.excess_variation / reference.peak_force,
        wanted=wanted,
        good=good,
        unlike=good
        & unlike_ideal(
            metrics.peak_force,
            reference.peak_force,
            metrics.duration,
            reference.duration,
            scenario.control_period[None],
        ),
    )


def parameters_by_slot(contact: ContactParameters) -> ContactParameters:
    """Contact parameters of a scenario with slots as part of the batch: segments and depths come first."""
    nested = contact.stiffness.ndim > contact.damping.ndim
    return contact._replace(
        stiffness=jnp.moveaxis(contact.stiffness, 0, 1) if nested else contact.stiffness,
        depths=jnp.moveaxis(contact.depths, 0, 1),
    )


def evaluate(loop: Any, gains: Mapping[str, Any], scenarios: Any, at_least: int = 1) -> Outcome:
    """Outcome (NumPy arrays) of `scenarios` (NumPy arrays, one batch axis), on every device.

    `gains` are scalars, or all of them one value per lane; they are taken in the scenarios' precision.
    Batches of up to `at_least` lanes share the compiled program of that many. To the bit, a lane's outcome
    depends neither on the lanes beside it nor on its place among them.
    """
    return begin_evaluation(loop, gains, scenarios, at_least)()


def begin_evaluation(
    loop: Any,
    gains: Mapping[str, Any],
    scenarios: Any,
    at_least: int = 1,
    wanted: Callable[[Outcome], Any] = lambda outcome: outcome,
) -> Callable[[], Any]:
    """Like `evaluate`, without waiting: what is returned waits for what is `wanted` of the outcome."""
    return begin_batch(loop, gains, place_batch(scenarios, at_least), wanted)


class Batch(NamedTuple):
    """Scenarios on the devices, to be run under one set of gains after another; see `place_batch`."""

    scenarios: Any  # dealt out, on the devices
    dealt: "_Dealt"  # which lanes are where
    places: np.ndarray  # where each lane is among those dealt out


def place_batch(scenarios: Any, at_least: int = 1) -> Batch:
    """Scenarios as `evaluate` takes them, dealt out to the devices."""
    dealt = _deal(scenarios, at_least)
    places = np.empty_like(dealt.lane, shape=lanes_of(scenarios))
    places[dealt.lane[~dealt.idle]] = np.flatnonzero(~dealt.idle)
    # All of it is placed: where a leaf comes from makes no other program.
    return Batch(_placed(_fold(dealt, scenarios), OWN), dealt, places)


def begin_batch(
    loop: Any,
    gains: Mapping[str, Any],
    batch: Batch,
    wanted: Callable[[Outcome], Any] = lambda outcome: outcome,
) -> Callable[[], Any]:
    """`begin_evaluation` of scenarios that are placed already."""
    common, per_lane = _fold_gains(batch.dealt, batch.scenarios, gains)
    placed = _placed(common, PartitionSpec()), _placed(per_lane, OWN)
    running = wanted(run_tiles(loop, *placed, batch.scenarios))

    def unfold(leaf):
        # (devices, tiles, ..., tile) -> (..., lanes), each device's part read where it is.
        devices, tiles, *slots, tile = leaf.shape
        rows = np.empty((*slots, devices, tiles, tile), leaf.dtype)
        for part in leaf.addressable_shards:
            rows[..., part.index[0], :, :] = np.moveaxis(np.asarray(part.data), (0, 1), (-3, -2))
        return np.take(rows.reshape(*slots, -1), batch.places, axis=-1)

    return lambda: jax.tree.map(unfold, running)


def shard(
    scenarios: Any, gains: Mapping[str, Any], at_least: int = 1
) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Arguments of `run_tiles`: gains common to all lanes, gains per lane and scenarios as
    (devices, tiles, ..., lanes of a tile), dealt out and padded with idle lanes."""
    dealt = _deal(scenarios, at_least)
    return *_fold_gains(dealt, scenarios, gains), _fold(dealt, scenarios)


def place(common: Any, per_lane: Any, scenarios: Any) -> tuple[Any, Any, Any]:
    """What `shard` made, on its devices: for what runs it several times."""
    return _placed(common, PartitionSpec()), _placed(per_lane, OWN), _placed(scenarios, OWN)


def _placed(tree: Any, spec: PartitionSpec) -> Any:
    return jax.device_put(tree, NamedSharding(_mesh(), spec))


class _Dealt(NamedTuple):
    """Lanes dealt out to tiles, (devices, tiles, lanes of a tile)."""

    lane: np.ndarray  # which one
    idle: np.ndarray  # whether it is there but to fill the tile


def _deal(scenarios, at_least):
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

    return _Dealt(fold(np.resize(_in_turn(scenarios), lanes)), fold(np.arange(lanes) >= number))


def _in_turn(scenarios):
    """Lanes by their delays, unless there would be but a few tiles of each, then by their duration."""
    duration, delays = expected_duration(scenarios), whole_delays(scenarios)
    if TILES_OF_A_DELAY * TILE * len(np.unique(delays)) > len(delays):
        delays = np.zeros_like(delays)
    order = np.argsort(-duration)
    return order[np.argsort(delays[order], kind="stable")]


def _fold(dealt, scenarios):
    """Scenarios as they were dealt out."""

    def fold(leaf):
        if leaf.strides[-1] == 0:
            same = leaf[..., 0]
            return _in_every_lane(same.tobytes(), same.dtype, same.shape, dealt.lane.shape)
        return _by_lane(dealt, leaf)

    return at_rest(jax.tree.map(fold, scenarios), dealt.idle)


def _fold_gains(dealt, scenarios, gains):
    """Gains common to all lanes, and gains per lane as they were dealt out."""
    # The scenarios' precision is that of the program.
    values = {name: np.asarray(value, scenarios.control_period.dtype) for name, value in gains.items()}
    common = {name: value for name, value in values.items() if not value.ndim}
    return common, {name: _by_lane(dealt, value) for name, value in values.items() if value.ndim}


def _by_lane(dealt, leaf):
    return np.moveaxis(np.take(leaf, dealt.lane, axis=-1), (-3, -2), (0, 1))


@lru_cache(maxsize=128)  # leaves: a few batches of like scenarios have no more
def _in_every_lane(content, dtype, slots, lanes):
    """On its devices, what all lanes have in common: it is not sent there again with every batch."""
    devices, tiles, tile = lanes
    same = np.frombuffer(content, dtype).reshape(1, 1, *slots, 1)
    return jax.device_put(np.broadcast_to(same, (devices, tiles, *slots, tile)), NamedSharding(_mesh(), OWN))


def lanes_of(scenarios: Any) -> int:
    """How many scenarios there are."""
    return np.shape(scenarios.control_period)[-1]


# What follows is another for scenarios and loops of six axes (`jaxhil.sixdof.evaluation`).


@singledispatch
def at_rest(scenarios: Any, idle: np.ndarray) -> Any:
    """Scenarios of which the `idle` lanes do nothing."""
    contacts: Any = np.where(idle, 0, scenarios.contacts).astype(np.int32)
    return scenarios._replace(contacts=contacts)


@singledispatch
def run_lanes(loop: Any, gains: Any, scenario: Any) -> Outcome:
    """Outcome of a tile's lanes."""
    return compare_with_reference(loop, scenario, rollout(loop, gains, scenario))


@singledispatch
def compiler_options(loop: Any) -> Mapping[str, int | str]:
    """Options of the compiler for batches."""
    return ROLLOUT


@singledispatch
def expected_duration(scenarios: Any) -> np.ndarray:
    """Order of a run's duration [s]: half a period sqrt(M/k) per contact; for sorting only."""
    stiffness = np.asarray(scenarios.contact.stiffness)
    while stiffness.ndim > 2:
        stiffness = stiffness[:, 0]
    slots = np.arange(len(stiffness))[:, None] < np.asarray(scenarios.contacts)
    periods = np.sqrt(np.asarray(scenarios.equivalent_mass) / np.maximum(stiffness, 1e-9))
    return np.sum(np.where(slots, periods, 0), axis=0)


@singledispatch
def whole_delays(scenarios: Any) -> np.ndarray:
    """A number that differs where the whole periods of a delay do; for sorting only."""
    simulator = np.asarray(scenarios.simulator.delay)
    period = np.asarray(scenarios.control_period)
    force, position = (
        np.floor((simulator + np.asarray(sensor.delay)) / period + 1e-9)
        for sensor in (scenarios.force_sensor, scenarios.position_sensor)
    )
    return force + position / (1 + np.max(position))


def run_tiles(loop: Any, common: Any, per_lane: Any, scenarios: Any) -> Outcome:
    """Outcome of what `shard` made and `place` placed, each leaf (devices, tiles, ..., lanes of a tile)."""
    return kept_programs.run(_run_tiles, loop, common, per_lane, scenarios, options=compiler_options(loop))


def _mesh():
    return jax.make_mesh((jax.device_count(),), ("device",), axis_types=(AxisType.Auto,))


def _run_tiles(loop: Any, common: Any, per_lane: Any, scenarios: Any) -> Outcome:
    def one_device(common, arguments):
        def one_tile(arguments):
            gains, scenario = arguments
            return run_lanes(loop, {**common, **gains}, scenario)

        own = jax.tree.map(lambda leaf: leaf[0], arguments)
        return jax.tree.map(lambda leaf: leaf[None], jax.lax.map(one_tile, own))

    # Each device ends its tiles in its own time; nothing is exchanged.
    specs = PartitionSpec(), OWN
    return jax.shard_map(one_device, mesh=_mesh(), in_specs=specs, out_specs=OWN, check_vma=False)(
        common, (per_lane, scenarios)
    )
