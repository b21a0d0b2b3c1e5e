"""Fits to contacts drawn again on a dask.distributed cluster: the same intervals to the bit, whoever dies."""

import campaigns
import numpy as np
import pytest
from clusters import killed_meanwhile, started

from jaxhil.errors import InputError
from tuning.identification import bootstrap
from tuning.identification.contact import estimate
from tuning.identification.contact_laws import kelvin_voigt
from tuning.identification.rational import STRUCTURES, Model

pytestmark = pytest.mark.users_options


@pytest.fixture(scope="module")
def fit():
    """Of so many rows that BLAS would share a sum of products among its threads."""
    runs = campaigns._touch_runs(campaigns.KINDS["clean"], np.random.default_rng(0), (0.006, 0.012) * 15)
    model = Model(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
    timing = campaigns.campaign("clean", 0, (), 0, 0).timing
    return estimate(runs, model, timing, None, kelvin_voigt())


@pytest.mark.parametrize("asked", (("--scheduler", "tcp://127.0.0.1:1"), ("--resume",)))
def test_what_is_of_the_bootstrap_alone_is_one_line_without(jaxhil, asked):
    found = jaxhil("identify", "x.csv", *asked)
    assert found.code == 2
    assert f"{asked[0]}: found no --bootstrap, allowed beside one" in found.err


@pytest.mark.slow
def test_the_same_draws_though_a_worker_is_killed(fit, tmp_path, monkeypatch):
    assert fit.readings.counts.sum() > 10_000
    with pytest.raises(InputError, match="--scheduler: found 'nowhere"):
        bootstrap.bootstrap(fit, 20, scheduler="nowhere://x")
    here = bootstrap.bootstrap(fit, 20)
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker(OMP_NUM_THREADS="2", OPENBLAS_NUM_THREADS="2")
        killed_meanwhile(monkeypatch, bootstrap, cluster, first)
        there = bootstrap.bootstrap(fit, 20, scheduler=cluster.address)
        assert first.poll() is not None
    assert there.resampled == here.resampled
    np.testing.assert_array_equal(there.posterior.draws, here.posterior.draws)
