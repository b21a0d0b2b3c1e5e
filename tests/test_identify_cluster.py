"""Bootstrap over contacts on a dask.distributed cluster: identical results even if a worker is killed."""

import campaigns
import numpy as np
import pytest
from clusters import killed_meanwhile, started

from jaxhil.errors import InputError
from tuning.identification import bootstrap
from tuning.identification.contact_fit import fit_contact
from tuning.identification.contact_laws import kelvin_voigt
from tuning.identification.rational import STRUCTURES, MotionModel

pytestmark = pytest.mark.users_options


@pytest.fixture(scope="module")
def fit():
    """Fit so many rows that BLAS would use several threads for a dot product."""
    runs = campaigns._touch_runs(campaigns.KINDS["clean"], np.random.default_rng(0), (0.006, 0.012) * 15)
    model = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
    timing = campaigns.campaign("clean", 0, (), 0, 0).timing
    return fit_contact(runs, model, timing, None, kelvin_voigt())


@pytest.mark.parametrize("asked", (("--scheduler", "tcp://127.0.0.1:1"), ("--resume",)))
def test_identify_rejects_bootstrap_options_without_bootstrap(jaxhil, asked):
    run = jaxhil("identify", "x.csv", *asked)
    assert run.code == 2
    assert f"{asked[0]}: found no --bootstrap, expected --bootstrap" in run.err


@pytest.mark.slow
def test_bootstrap_draws_are_unchanged_if_a_cluster_worker_is_killed(fit, tmp_path, monkeypatch):
    assert fit.readings.counts.sum() > 10_000
    with pytest.raises(InputError, match="--scheduler: found 'nowhere"):
        bootstrap.bootstrap(fit, 20, scheduler="nowhere://x")
    here = bootstrap.bootstrap(fit, 20)
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker(OMP_NUM_THREADS="2", OPENBLAS_NUM_THREADS="2")
        killed_meanwhile(monkeypatch, bootstrap, cluster, first)
        cluster_result = bootstrap.bootstrap(fit, 20, scheduler=cluster.address)
        assert first.poll() is not None
    assert cluster_result.resampled == here.resampled
    np.testing.assert_array_equal(cluster_result.posterior.draws, here.posterior.draws)
