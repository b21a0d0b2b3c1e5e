"""The certificate: a search that knows nothing of the tuned gains; how far they are from what it found."""

import numpy as np
import pytest

from jaxhil.mechanism_file import load
from tuning.certificate import certified, evaluations
from tuning.objective import RMS
from tuning.problems import build_task
from tuning.rounds import SCANNED, choose_starts, finish, solve_tasks
from tuning.trial import Trial


@pytest.fixture(scope="module")
def tuned():
    fast = ["rig.simulator.natural_frequency=60", "rig.simulator.delay=0.001"]
    trial = Trial([build_task(load("rig-300kg", fast).mechanism, "phase_lead", 8, 0)], 255, 0)
    starts = solve_tasks(trial.tasks, choose_starts(trial, 3, 0), 20)
    (found,) = finish(trial, starts, 0, 0)
    return trial, starts[0], found


def test_a_gradient_optimum_is_confirmed_and_a_bad_one_exposed(tuned):
    trial, starts, found = tuned
    spent = evaluations(found, starts, 2, 0)
    assert spent == SCANNED + 3 * sum(start.steps for start in starts)
    good = certified(trial, 0, found, starts, RMS, 0, 0, factor=20)
    assert good.spent == spent and good.evaluations <= 20 * spent
    assert good.tuned == pytest.approx(found.rms, rel=1e-9)
    assert abs(good.above) < 0.02
    assert good.above == pytest.approx(good.tuned / good.best - 1)
    astray = found._replace(shares=np.clip(found.shares + 0.1, 0, 1))
    bad = certified(trial, 0, astray, starts, RMS, 0, 0, factor=20)
    assert bad.best == good.best and bad.above > 0.5


def test_a_polish_counts_where_there_was_one(tuned):
    _, starts, found = tuned
    assert evaluations(found._replace(shares=found.shares.copy()), starts, 2, 320) == (
        evaluations(found, starts, 2, 320) + 320
    )
