"""Comparison on a dask.distributed cluster: identical results even if a worker is killed."""

from typing import Any

import pytest
from clusters import killed_meanwhile, started

import jaxhil
import tuning
from jaxhil.errors import InputError

pytestmark = pytest.mark.users_options
LAWS = ["none", "phase_lead", "response_error"]
FEW: dict[str, Any] = {"untuned": True, "judged": 16}


def figures(board):
    return {
        law: {which: vars(metrics) for which, metrics in by_gains.items()}
        for law, by_gains in board.figures.items()
    }


def test_compare_reports_missing_scheduler_with_one_line_message():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="--scheduler: found 'nowhere"):
        tuning.compare("varying", LAWS, scheduler="nowhere://x", **FEW)


@pytest.mark.slow
def test_compare_results_are_unchanged_if_a_cluster_worker_is_killed(tmp_path, monkeypatch):
    mechanisms = [jaxhil.load("varying"), jaxhil.load("suite-rattling")]
    here = tuning.compare(mechanisms, LAWS, **FEW)
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker()
        from tuning.benchmark import comparison

        killed_meanwhile(monkeypatch, comparison, cluster, first)
        on_cluster_result = tuning.compare(mechanisms, LAWS, scheduler=cluster.address, **FEW)
        assert first.poll() is not None
    assert [figures(board) for board in on_cluster_result] == [figures(board) for board in here]
