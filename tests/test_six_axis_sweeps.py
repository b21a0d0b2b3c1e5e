"""Six-axis sweeps: bit-identical replays, and unchanged rows and gains if a cluster worker is killed."""

import json

import numpy as np
import pytest
from clusters import killed_meanwhile, started

import jaxhil as package
import tuning
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.jax_environment import jax_context
from tuning.caches.cluster import ClusterWorkers
from tuning.gain_file import build_document, write_gain_file
from tuning.gains import tune_all
from tuning.sweeps.chunks import build_sweep
from tuning.sweeps.replay import record_six_axes
from tuning.sweeps.store import read_row, read_store

pytestmark = [pytest.mark.slow, pytest.mark.users_options]
NAME, LAW = "probe-drogue", "phase_lead"
ASKED = {"scenarios": 32, "chunk": 4, "limit": 1.2}


@pytest.fixture(scope="module")
def gains(tmp_path_factory):
    """Return the literature's gains."""
    mechanism, path = load_any(NAME).mechanism, tmp_path_factory.mktemp("gains") / "gains.json"
    result = literature_gains(mechanism, LAW)
    write_gain_file(path, build_document(LAW, result, mechanism, "0" * 64, {}, {}, 0, {}))
    return path


@pytest.fixture(scope="module")
def local_sweep(gains):
    """Return a sweep computed locally."""
    return tuning.sweep(gains, **ASKED, folder=gains.parent / "store")


def test_replay_of_six_axis_scenario_is_bit_identical(local_sweep, jaxhil, tmp_path):
    ran = jaxhil("replay", local_sweep.folder, 7, "--json", "--plot", tmp_path / "7.png")
    assert ran.code == 0, ran.err
    document, row = json.loads(ran.out), read_row(read_store(local_sweep.folder), 7)
    assert ran.code == 0 and document["verdict"] == "good" and (tmp_path / "7.png").stat().st_size > 10_000
    [episode] = document["episodes"]
    for name in ("energy_error", "twist_error", "peak_force", "duration"):
        assert episode[name] == row[f"{name}_1"][0]
    ran = jaxhil("replay", local_sweep.folder, 31)
    assert ran.code == 0 and "Episodes" in ran.out and "to the bit" in ran.out

    # The record contains only this scenario, until its end.
    with jax_context():
        ticks = record_six_axes(build_sweep(local_sweep.manifest), 7)
    touching = ticks.depth.max(axis=1) > 0
    force = np.linalg.norm(ticks.wrench[:, :3], axis=1)
    np.testing.assert_allclose(force.max(), row["peak_force_1"][0], rtol=1e-3)
    assert abs(touching.sum() * (ticks.time[1] - ticks.time[0]) - row["duration_1"][0]) < 1e-9
    assert not touching[-1]


def test_six_axis_cluster_sweep_is_unchanged_if_a_worker_is_killed(local_sweep, gains, tmp_path, monkeypatch):
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker()
        killed_meanwhile(monkeypatch, ClusterWorkers, cluster, first, "run")
        cluster_result = tuning.sweep(gains, **ASKED, scheduler=cluster.address)
        assert first.poll() is not None
    assert cluster_result.table.equals(local_sweep.table)
    for name in ("outcomes", "worst", "failure_probability", "error_quantiles"):
        assert cluster_result.document[name] == local_sweep.document[name]


def test_six_axis_cluster_tuning_is_unchanged_if_a_worker_is_killed(tmp_path, monkeypatch):
    monkeypatch.setattr(tune_all, "MAX_GROUP_SIZE", 1)
    mechanisms = [package.load(NAME, {"target.mass": mass, "name": f"{mass}"}) for mass in (1e3, 2e3, 3e3)]
    few = {"scenarios": 4, "starts": 1, "steps": 1, "validation": 15}
    local_sweep = tuning.tune(mechanisms, LAW, **few)
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker()
        killed_meanwhile(monkeypatch, tune_all, cluster, first)
        cluster_result = tuning.tune(mechanisms, LAW, scheduler=cluster.address, **few)
        assert first.poll() is not None
    for local, other in zip(local_sweep, cluster_result, strict=True):
        assert other.gains == local.gains and other.figures == local.figures and other.parts == local.parts
        assert other.found.starts[0].history == local.found.starts[0].history
