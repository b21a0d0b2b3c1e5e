"""The search of the whole box, blind to the tuned gains: how far they are from what it found."""

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
def test_a_gradient_optimum_is_confirmed_and_a_bad_one_exposed(validation):
    (found,) = find_gains(validation, SETTINGS)
    assert found.best is not None
    good = compare_with_global_search(validation, 0, found, SETTINGS, factor=20)
    assert good is not None
    assert good.spent == found.evaluations and good.evaluations <= 20 * good.spent
    assert good.tuned == pytest.approx(found.best.rms, rel=1e-9)
    assert abs(good.above) < 0.02
    assert good.above == pytest.approx(good.tuned / good.best - 1)
    astray = found.best._replace(coordinates=np.clip(found.best.coordinates + 0.1, 0, 1))
    bad = compare_with_global_search(validation, 0, found._replace(best=astray), SETTINGS, factor=20)
    assert bad is not None
    assert bad.best == good.best and bad.above > 0.5


def test_where_all_starts_failed_there_is_nothing_to_certify(validation):
    assert compare_with_global_search(validation, 0, MultistartResult(None, [], 100), SETTINGS) is None
