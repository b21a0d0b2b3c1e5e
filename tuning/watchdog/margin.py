"""Choice of the restitution margin: the largest difference from the expected restitution without an alarm.

If the expected restitution is accurate, the sum of the margin and the error of the expectation is below the
limit, so that no bad run is missed. If neither damping nor delay is known, the error of the expectation is
larger, because an unknown delay looks like damping (`tuning.watchdog.expectation`), and a small margin would
stop good runs. The margin is then widened until good runs pass, and
`tuning.watchdog.alarms.find_detectable_error` computes which errors are still detected.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxhil.simulation.metrics import OK
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.alarms import (
    GOOD_ERROR_FACTOR,
    EvaluatedRuns,
    extract_features,
    find_good_runs,
    find_reached_contacts,
)
from tuning.watchdog.expectation import ExpectationFit, expected_restitution

UNSEEN_RUN_FACTOR = 1.25  # bound for all other runs / largest value in the used runs [1]
# Smallest restitution margin, and restitution margin if the expected restitution is accurate, both divided by
# the limit of the restitution error [1].
MIN_MARGIN_SHARE, USUAL_MARGIN_SHARE = 0.25, 0.75


class RestitutionMargin(NamedTuple):
    """Restitution margin of the watchdog, and the runs from which it was computed."""

    value: float  # restitution margin [1]
    widened_from: float | None  # margin before it was widened for good runs [1]; None if it was not widened
    runs: Bool[np.ndarray, "lanes"]  # whether each run was used


def choose_restitution_margin(
    runs: EvaluatedRuns,
    expectation: ExpectationFit,
    limit: float,
    mass: float,
    fitted: Bool[np.ndarray, "lanes"],
    false_alarms: float,
) -> RestitutionMargin:
    """Choose the largest difference from the expected restitution that raises no alarm (the margin).

    The margin is usually `USUAL_MARGIN_SHARE` times the limit. It is smaller if the sum of margin and error
    of the expectation would exceed the limit, because an error e - e* beyond the limit could then be missed.
    It is larger if more than the fraction `false_alarms` of good runs would otherwise raise an alarm. To
    estimate such a small fraction, the larger margin is computed from many runs: the `fitted` runs and every
    second run.

    Args:
        runs: recorded runs.
        expectation: expected restitution of the watchdog.
        limit: limit of the restitution error [1].
        mass: equivalent mass [kg].
        fitted: whether the expectation was fitted to each run, (lanes,).
        false_alarms: largest acceptable rate of false alarms [1].
    """
    expected = expected_restitution(expectation, extract_features(runs.audited), mass)
    difference = runs.audited.restitution - expected
    use = find_reached_contacts(runs, limit) & (runs.status == OK) & fitted
    # The deviation includes the difference between the restitution in the audit and in the simulation.
    deviation = np.abs((difference - runs.error)[use])
    narrow = float(
        np.clip(
            limit - UNSEEN_RUN_FACTOR * np.max(deviation, initial=0.0),
            MIN_MARGIN_SHARE * limit,
            USUAL_MARGIN_SHARE * limit,
        )
    )
    good = find_good_runs(runs, GOOD_ERROR_FACTOR * limit)
    audited = runs.audited.occurred & (runs.audited.approach > 0)
    furthest = np.max(np.where(audited, np.abs(difference), 0.0), axis=0)
    if _find_passing_margin(furthest[good & fitted], false_alarms) <= narrow:
        return RestitutionMargin(narrow, None, fitted)
    used = fitted | (runs.index % 2 == 1)
    wide = furthest[good & used]
    # A further value exceeds the largest of n values with probability 1/(n + 1).
    few = (len(wide) + 1) * false_alarms < 1
    margin = max(narrow, (UNSEEN_RUN_FACTOR if few else 1.0) * _find_passing_margin(wide, false_alarms))
    return RestitutionMargin(margin, narrow if margin > narrow else None, used)


def _find_passing_margin(furthest: Float[np.ndarray, "runs"], share: float) -> float:
    """Return the smallest margin with which at most a fraction `share` of runs raises an alarm.

    `furthest` is each run's largest difference from the expected restitution; a run raises an alarm if this
    exceeds the margin. The confidence is 95 %. If there are too few runs for it, return the largest of
    these differences.
    """
    if not len(furthest):
        return 0.0
    high = binomial_interval(np.arange(len(furthest)), len(furthest)).high
    return float(np.sort(furthest)[::-1][max(0, np.sum(high <= share) - 1)])
