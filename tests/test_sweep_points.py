"""Points of a sweep's studies: bit-identical results for any chunk size, and saved when finished."""

import numpy as np
import pytest
from sweep_cases import case, manifest

from tuning.caches.checkpoints import Checkpoints
from tuning.sweeps import point_batches
from tuning.sweeps.chunk_file import list_different_columns
from tuning.sweeps.chunks import build_sweep
from tuning.sweeps.point_batches import LOCAL_RUN, PointRunSettings, run_locally, run_points

NUMBER = 100


@pytest.fixture(scope="module")
def simulated_points():
    """Return a sweep, points, noise indices, and the results."""
    sweep = build_sweep(manifest(case(force_sensor={"noise_std": 1.0})))
    inputs = np.random.default_rng(0).uniform(size=(NUMBER, 3))
    noise = np.arange(NUMBER) % 7
    return sweep, inputs, noise, run_points(sweep, inputs, noise)


def test_finished_study_points_are_not_simulated_again(simulated_points, tmp_path, monkeypatch):
    monkeypatch.setattr(point_batches, "MIN_POINTS_PER_BATCH", 8)
    *what, rows = simulated_points
    ran, result = [], []

    def interrupted(sweep, pieces):
        # Compute the batches in another order, as on a cluster, and each only once.
        for number, one in enumerate(run_locally(sweep, list(pieces)[::-1])):
            if number == 3:
                raise KeyboardInterrupt
            yield one

    running = PointRunSettings(
        ran.append, result.append, Checkpoints(tmp_path / "kept"), interrupted, max_batches=10
    )
    with pytest.raises(KeyboardInterrupt):
        run_points(*what, running)
    again = running._replace(checkpoints=Checkpoints(tmp_path / "kept", resume=True), computer=run_locally)
    assert list_different_columns(run_points(*what, again), rows) == []
    assert len(result) == 3 and sum(ran) == NUMBER and sum(result) == sum(ran[:3])
    assert again.checkpoints.other == []


def test_study_points_with_other_noise_are_simulated_again(simulated_points, tmp_path):
    sweep, inputs, noise, rows = simulated_points
    running = LOCAL_RUN._replace(checkpoints=Checkpoints(tmp_path / "kept", resume=True))
    run_points(sweep, inputs, noise, running)
    other = run_points(sweep, inputs, noise + 1, running)
    assert np.any(other["worst_error"] != rows["worst_error"])


def test_equal_study_points_are_simulated_only_once(simulated_points):
    sweep, inputs, noise, rows = simulated_points
    ran = []
    twice = run_points(
        sweep,
        np.tile(inputs[:32], (3, 1)),
        np.tile(noise[:32], 3),
        LOCAL_RUN._replace(report_computed=ran.append),
    )
    assert ran == [32]
    np.testing.assert_array_equal(twice["worst_error"], np.tile(rows["worst_error"][:32], 3))
