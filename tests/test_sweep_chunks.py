"""Chunks of a sweep: bit-identical rows for any division, in either precision, for good and bad runs."""

import numpy as np
import pytest
from sweep_cases import NOISY, case, manifest

from tuning.sweeps.chunk_file import list_different_columns
from tuning.sweeps.chunks import build_sweep, run_chunk, run_chunks
from tuning.sweeps.columns import SCENARIO_OUTCOMES
from tuning.sweeps.replay import replay_scenario
from tuning.sweeps.store import open_store, write_chunk

pytestmark = pytest.mark.users_options


def joined(pieces):
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(("random", None), id="random", marks=pytest.mark.slow),
        pytest.param(("sobol", NOISY), id="sobol-noisy"),
    ],
)
def sweep(request):
    sampling, sensor = request.param
    return build_sweep(manifest(case(2, "phase_lead", sensor), 112, sampling=sampling))


def test_sweep_rows_do_not_depend_on_division_into_chunks(sweep):
    whole = run_chunk(sweep, 0, 112)
    assert list_different_columns(joined([rows for _, rows in run_chunks(sweep, range(4))]), whole) == []
    uneven = [run_chunk(sweep, first, until - first) for first, until in ((0, 1), (1, 80), (80, 112))]
    assert list_different_columns(joined(uneven), whole) == []
    assert np.ptp(whole["error_1"]) > 1e-3


def test_sweep_chunks_are_computed_in_the_requested_order(sweep):
    assert [part for part, _ in run_chunks(sweep, [3, 0])] == [3, 0]
    assert list(run_chunks(sweep, [])) == []


def test_sweep_delay_line_is_long_enough_for_every_drawn_delay():
    uncertain = {
        "rig.force_sensor.delay": {"distribution": "normal", "std": 0.05},
        "rig.control_period": {"distribution": "uniform", "low": 0.001, "high": 0.002},
    }
    few = build_sweep(manifest(case(uncertainty=uncertain)))
    # 8.2 standard deviations above 4.1 ms, and the simulator's delay, in periods of 1 ms.
    assert few.loop.ring == 512


def test_sweep_results_in_float32_are_close_to_float64():
    sweep = build_sweep(manifest(precision="float32"))
    single, double = run_chunk(sweep, 0, 32), run_chunk(sweep, 0, 32, "float64")
    assert single["error_1"].dtype == np.float32 and double["error_1"].dtype == np.float64
    assert single["contact.stiffness_1"].dtype == np.float64
    difference = np.abs(single["error_1"] - double["error_1"])
    assert 0 < np.max(difference) < 1e-4


def test_failed_runs_are_stored_as_sweep_rows():
    # The sensor reads almost nothing, so the bodies are never stopped.
    uncertain = {"rig.force_sensor.range": {"distribution": "loguniform", "low": 1e-7, "high": 1e3}}
    sweep = build_sweep(manifest(case(force_sensor={"range": 1.0}, uncertainty=uncertain)))
    rows = run_chunk(sweep, 0, 32)
    names = {SCENARIO_OUTCOMES[index] for index in rows["outcome"]}
    assert {"timeout", "saturated", "good"} <= names
    assert np.isnan(rows["restitution_1"][rows["outcome"] == SCENARIO_OUTCOMES.index("timeout")]).all()


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_run_counts_as_saturated_if_simulator_cannot_follow_the_model(tmp_path, precision):
    """Without damping and compensation, the model is fastest in free flight."""
    uncertain = {"rig.simulator.velocity_limit": {"distribution": "loguniform", "low": 0.0055, "high": 0.024}}
    label = manifest(case(uncertainty=uncertain, velocity_limit=0.01), 32, precision=precision)
    sweep = build_sweep(label)
    rows = run_chunk(sweep, 0, 32)
    approach, rebound = rows["approach_velocity_1"], rows["restitution_1"] * rows["approach_velocity_1"]
    too_slow = np.maximum(approach, rebound) > rows["rig.simulator.velocity_limit"]
    assert 4 < np.sum(too_slow) < 28
    np.testing.assert_array_equal(rows["position_shortfall_1"] > 0, too_slow)
    assert np.all(rows["position_shortfall_1"] >= 0)
    np.testing.assert_array_equal(rows["outcome"] == SCENARIO_OUTCOMES.index("saturated"), too_slow)
    store = open_store(tmp_path / "store", label, resume=False)
    write_chunk(store, 0, rows)
    for index in (np.argmax(too_slow), np.argmin(too_slow)):
        assert replay_scenario(store, int(index)).different_columns == []
