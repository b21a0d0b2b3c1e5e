"""Tuning on a dask.distributed cluster: bit-identical gains and Pareto fronts."""

from typing import Any

import numpy as np
import pytest
from clusters import started

import jaxhil
import tuning
from jaxhil.errors import InputError

pytestmark = pytest.mark.users_options
FEW: dict[str, Any] = {"scenarios": 4, "starts": 1, "steps": 2, "validation": 15}


def test_tuning_without_scheduler_fails_with_one_line_message():
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="--scheduler: found 'nowhere"):
        tuning.tune("varying", scheduler="nowhere://x", **FEW)


@pytest.mark.slow
def test_cluster_tuning_gives_same_gains_and_pareto_fronts_as_local_tuning(tmp_path, monkeypatch):
    for name in ("tune_all", "pareto"):
        monkeypatch.setattr(f"tuning.gains.{name}.BLOCK", 2)
    changes = [{"bodies.equivalent_mass": mass} for mass in (3e2, 4e2, 5e2)]
    mechanisms = [jaxhil.load("varying", {**one, "name": f"mass {i}"}) for i, one in enumerate(changes)]
    mechanisms.append(jaxhil.load("suite-rattling"))
    here = tuning.tune(mechanisms, pareto=2, **FEW)
    with started(tmp_path) as cluster:
        cluster.worker()
        cluster.worker()
        cluster_result = tuning.tune(mechanisms, pareto=2, scheduler=cluster.address, **FEW)
    for local, other in zip(here, cluster_result, strict=True):
        assert other.gains == local.gains and other.figures == local.figures
        assert other.found.starts[0].history == local.found.starts[0].history
        assert [one.point for one in other.pareto] == [one.point for one in local.pareto]
        for key, outcome in local.found.outcomes.items():
            np.testing.assert_array_equal(other.found.outcomes[key].error, outcome.error)
