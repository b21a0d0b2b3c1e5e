"""Global search of the whole box without using the tuned gains, compared with these gains."""

import numpy as np
import pytest
from lead_cases import lead_task

from tuning.gains.global_search import compare_with_global_search
from tuning.gains.multistart import MultistartResult, find_gains
from tuning.gains.settings import TuneSettings
from tuning.gains.validation import build_validation

SETTINGS = TuneSettings(starts=3, steps=20, polish=0)


@pytest.fixture(scope="module")
def validation():
    return build_validation([lead_task()], 255, 0)


@pytest.mark.slow
def test_global_search_confirms_good_optimum_and_detects_poor_optimum(validation):
    (result,) = find_gains(validation, SETTINGS)
    assert result.best is not None
    good = compare_with_global_search(validation, 0, result, SETTINGS, factor=20)
    assert good is not None
    assert good.spent == result.evaluations and good.evaluations <= 20 * good.spent
    assert good.tuned == pytest.approx(result.best.rms, rel=1e-9)
    assert abs(good.above) < 0.02
    assert good.above == pytest.approx(good.tuned / good.best - 1)
    astray = result.best._replace(coordinates=np.clip(result.best.coordinates + 0.1, 0, 1))
    bad = compare_with_global_search(validation, 0, result._replace(best=astray), SETTINGS, factor=20)
    assert bad is not None
    assert bad.best == good.best and bad.above > 0.5


def test_global_search_returns_none_if_all_starts_failed(validation):
    assert compare_with_global_search(validation, 0, MultistartResult(None, [], 100), SETTINGS) is None
