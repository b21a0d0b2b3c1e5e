"""A comparison on a dask.distributed cluster: the same figures to the bit, whoever dies."""

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
    return {law: {which: vars(own) for which, own in each.items()} for law, each in board.figures.items()}


def test_a_scheduler_that_is_not_there_is_one_line():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="--scheduler: found 'nowhere"):
        tuning.compare("varying", LAWS, scheduler="nowhere://x", **FEW)


@pytest.mark.slow
def test_the_same_figures_though_a_worker_is_killed(tmp_path, monkeypatch):
    mechanisms = [jaxhil.load("varying"), jaxhil.load("suite-rattling")]
    here = tuning.compare(mechanisms, LAWS, **FEW)
    with started(tmp_path) as cluster:
        first, _ = cluster.worker(), cluster.worker()
        from tuning.benchmark import study

        killed_meanwhile(monkeypatch, study, cluster, first)
        there = tuning.compare(mechanisms, LAWS, scheduler=cluster.address, **FEW)
        assert first.poll() is not None
    assert [figures(one) for one in there] == [figures(one) for one in here]
