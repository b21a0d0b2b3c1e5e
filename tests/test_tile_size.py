"""Tiles of all lanes on accelerators and small tiles on processors, with equal results; no GPU is needed."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

import tuning
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation import tile_size
from jaxhil.simulation.tile_size import (
    COPIES,
    MAX_ACCELERATOR_LANES,
    MEMORY_SHARE,
    UNKNOWN_MEMORY,
    DeviceDescription,
    choose_tile_size,
    describe_devices,
)
from tuning.gains.multistart_solver import lower_solver, solve_tasks
from tuning.gains.objective import Objective
from tuning.gains.tasks import build_task, list_tuned_gains
from tuning.stability_map import grid

CPU = DeviceDescription(is_cpu=True)
LARGE = DeviceDescription(is_cpu=False, memory=80 << 30)
LANES = 300


def use(monkeypatch, device):
    monkeypatch.setattr(tile_size, "describe_devices", lambda: device)


def setting(name, compensator, lanes=LANES):
    mechanism = load_any(name).mechanism
    model = choose_rig_model(mechanism)
    scenarios = model.scenarios(mechanism, draw(mechanism, lanes, 1))
    loop = model.loop(mechanism, compensator, scenarios)
    return model, loop, literature_gains(mechanism, compensator), scenarios


def tile_shape(model, loop, gains, scenarios):
    """Return the shape (devices, tiles, lanes of a tile) of a batch."""
    return model.place_batch(scenarios, loop=loop).scenarios.control_period.shape


def assert_same_outcomes(first, second):
    """Check that outcomes agree except for rounding errors; only contacts that exist are compared."""
    np.testing.assert_array_equal(first.metrics.status, second.metrics.status)
    for name in ("error", "reference_restitution", "peak_ratio"):
        comparable = first.is_scheduled & first.good
        ours, theirs = (getattr(outcome, name)[comparable] for outcome in (first, second))
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)


def test_tile_size_on_processor_does_not_depend_on_lanes_or_memory():
    for lanes in (1, 64, 65, 1 << 20):
        assert choose_tile_size(CPU, lanes, 64, 1 << 40) == 64


def test_tile_size_on_accelerator_is_all_lanes_or_power_of_two_within_memory_share():
    assert choose_tile_size(LARGE, 16_384, 64, 5000) == 16_384
    assert choose_tile_size(LARGE, 3, 64, 5000) == 3
    for lane_bytes in (5000, 123_456, 10**7):
        tile = choose_tile_size(LARGE, 10**8, 64, lane_bytes)
        budget = MEMORY_SHARE * LARGE.memory / (COPIES * lane_bytes)
        assert tile & (tile - 1) == 0 and tile <= min(budget, MAX_ACCELERATOR_LANES) < 2 * tile
    assert choose_tile_size(LARGE, 100, 64, 1 << 60) == 1


@pytest.mark.parametrize("statistics", [{"bytes_limit": 10**9, "bytes_in_use": 10**8}, {}, None])
def test_device_description_has_memory_that_device_reports(monkeypatch, statistics):
    assert describe_devices() == CPU
    device = SimpleNamespace(platform="gpu", memory_stats=lambda: statistics)
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    assert describe_devices() == DeviceDescription(False, 10**9 if statistics else UNKNOWN_MEMORY)


@pytest.mark.parametrize(
    ("lanes", "shape"), [(1, (1, 16)), (33, (1, 32)), (300, (4, 64)), (5000, (48, 64)), (16_384, (128, 64))]
)
def test_batch_on_processor_has_tiles_of_at_most_64_lanes(lanes, shape):
    devices = jax.device_count()
    assert devices == 2
    assert tile_shape(*setting("varying", "none", lanes)) == (devices, *shape)


@pytest.mark.parametrize(("lanes", "tile"), [(1, 16), (33, 32), (300, 256), (16_384, 8192), (50_000, 25_600)])
def test_batch_on_accelerator_has_one_tile_per_device(monkeypatch, lanes, tile):
    use(monkeypatch, LARGE)
    assert tile_shape(*setting("varying", "none", lanes)) == (jax.device_count(), 1, tile)


def test_lane_memory_grows_with_delay_line_and_state():
    bytes_by_case = {}
    for name, compensator in [("varying", "none"), ("varying", "impulse_ledger")]:
        model, loop, _, scenarios = setting(name, compensator, 2)
        bytes_by_case[compensator] = model.count_lane_bytes(loop, scenarios)
        scenario_bytes = sum(leaf[..., 0].nbytes for leaf in jax.tree.leaves(scenarios))
        assert model.count_lane_bytes(None, scenarios) == scenario_bytes
        # The delay lines of force and position have `ring` samples of 8 bytes each.
        assert bytes_by_case[compensator] > scenario_bytes + 8 * loop.ring
    assert bytes_by_case["impulse_ledger"] > 2 * bytes_by_case["none"]


@pytest.mark.parametrize(
    ("name", "compensator"),
    [
        ("varying", "response_error"),
        pytest.param("suite-noisy", "phase_lead", marks=pytest.mark.slow),
        pytest.param("varying", "impulse_ledger", marks=pytest.mark.slow),
        pytest.param("probe-drogue", "none", marks=pytest.mark.slow),
    ],
)
def test_evaluation_in_one_tile_equals_evaluation_in_many_tiles(monkeypatch, name, compensator):
    case = model, loop, gains, scenarios = setting(name, compensator)
    many = model.evaluate(loop, gains, scenarios)
    lane_bytes = model.count_lane_bytes(loop, scenarios)
    small = DeviceDescription(False, round(64 * COPIES * lane_bytes / MEMORY_SHARE))
    for device, tiles in ((CPU, 4), (LARGE, 1), (small, 4)):
        use(monkeypatch, device)
        assert tile_shape(*case)[1] == tiles
        assert_same_outcomes(many, model.evaluate(loop, gains, scenarios))


@pytest.mark.slow
def test_solver_with_all_problems_in_one_tile_reaches_same_gains(monkeypatch):
    """The task has transparency probes, whose lanes are also divided into tiles on a processor."""
    task = build_task(load_any("rig-300kg").mechanism, "phase_lead", 10, 0, probed=True)
    starts = np.stack([np.full(len(list_tuned_gains([task])), value) for value in (0.3, 0.6)])
    objective = Objective(transparency_weight=1.0)
    results = []
    for device in (CPU, LARGE):
        use(monkeypatch, device)
        results.append(solve_tasks([task], [starts], 3, objective)[0])
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours.history, theirs.history, rtol=1e-7)
        np.testing.assert_allclose(ours.coordinates, theirs.coordinates, atol=1e-6)


def test_solver_runs_as_many_problems_together_as_memory_allows(monkeypatch):
    task = build_task(load_any("varying").mechanism, "phase_lead", 16, 0)
    state = task.model.count_lane_bytes(task.loop, task.scenarios) * (1 + len(task.tuned))
    tiles = []
    monkeypatch.setattr(
        "jaxhil.simulation.cached_programs.lower_cached",
        lambda function, static, *arguments, options: tiles.append(static[-1]),
    )
    for device in (CPU, LARGE, DeviceDescription(False, round(128 * COPIES * state / MEMORY_SHARE))):
        use(monkeypatch, device)
        lower_solver([task], starts=30)
    assert tiles == [4, 32, 8]


def test_stability_map_on_accelerator_runs_all_points_in_one_call(monkeypatch):
    calls, run_tile = [], grid.run_tile
    monkeypatch.setattr(grid, "MAX_TILE_RUNS", 100)
    monkeypatch.setattr(grid, "run_tile", lambda *part: calls.append(part) or run_tile(*part))
    results, numbers = [], []
    for device in (CPU, LARGE):
        use(monkeypatch, device)
        calls.clear()
        results.append(tuning.map("varying", "rig.force_sensor.delay", "contact.stiffness", points=4).error)
        numbers.append(len(calls))
    assert numbers == [-(-grid.count_runs(4) // 100), 1]
    np.testing.assert_allclose(*results, rtol=1e-9, atol=1e-12)
