"""The certificate: a search that knows nothing of the tuned gains; how far they are from what it found."""

import numpy as np
import pytest
from lead_cases import lead_task

from tuning.gains.global_search import certified
from tuning.gains.multistart import Found, find
from tuning.gains.objective import RMS
from tuning.gains.validation import Trial


@pytest.fixture(scope="module")
def trial():
    return Trial([lead_task()], 255, 0)


def test_a_gradient_optimum_is_confirmed_and_a_bad_one_exposed(trial):
    (found,) = find(trial, 3, 20, 0, 0)
    assert found.best is not None
    good = certified(trial, 0, found, RMS, 0, factor=20)
    assert good is not None
    assert good.spent == found.evaluations and good.evaluations <= 20 * good.spent
    assert good.tuned == pytest.approx(found.best.rms, rel=1e-9)
    assert abs(good.above) < 0.02
    assert good.above == pytest.approx(good.tuned / good.best - 1)
    astray = found.best._replace(shares=np.clip(found.best.shares + 0.1, 0, 1))
    bad = certified(trial, 0, found._replace(best=astray), RMS, 0, factor=20)
    assert bad is not None
    assert bad.best == good.best and bad.above > 0.5


def test_where_all_starts_failed_there_is_nothing_to_certify(trial):
    assert certified(trial, 0, Found(None, [], 100), RMS, 0) is None
