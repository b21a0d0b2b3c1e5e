"""Restitution margin: the largest difference from the expected restitution without an alarm.

If the expectation is accurate, the margin plus its error is below the limit, so that no bad run is missed. If
damping and delay are both unknown, the expectation's error is too large for that (an unknown delay looks like
damping, `tuning.watchdog.expectation`), and good runs would be stopped. The margin is then widened until they
pass, and `tuning.watchdog.alarms.noticed_from` states which errors are still noticed.
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
from tuning.watchdog.expectation import Expectation, expected_restitution

UNSEEN_RUN_FACTOR = 1.25  # factor on the largest value among some runs, as a bound for other runs
# Least margin, and margin of a good expectation, over the limit [1].
MIN_MARGIN_SHARE, USUAL_MARGIN_SHARE = 0.25, 0.75


class RestitutionMargin(NamedTuple):
    """Restitution margin and the runs that determine it."""

    value: float  # margin [1]
    widened_from: float | None  # margin against missed alarms only [1]; None if it was not widened
    runs: Bool[np.ndarray, "lanes"]  # runs that determine the margin


def choose_restitution_margin(
    runs: EvaluatedRuns,
    expectation: Expectation,
    limit: float,
    mass: float,
    fitted: Bool[np.ndarray, "lanes"],
    false_alarms: float,
) -> RestitutionMargin:
    """Return the restitution margin.

    It is `USUAL_MARGIN_SHARE` times the limit, less if the expectation's error exceeds the rest, but so large
    that at most the share `false_alarms` of good runs is stopped. An error e - e* beyond the limit is
    detected if the expectation's error is below limit - margin. A small share of good runs needs more runs
    than the fit of the expectation; in that case every second run is used besides the `fitted` ones.
    """
    expected = expected_restitution(expectation, extract_features(runs.audited), mass)
    difference = runs.audited.restitution - expected
    use = find_reached_contacts(runs, limit) & (runs.status == OK) & fitted
    # This includes the difference between the audit's and the loop's restitution.
    deviation = np.abs((difference - runs.error)[use])
    narrow = float(
        np.clip(
            limit - UNSEEN_RUN_FACTOR * np.max(deviation, initial=0.0),
            MIN_MARGIN_SHARE * limit,
            USUAL_MARGIN_SHARE * limit,
        )
    )
    good = find_good_runs(runs, GOOD_ERROR_FACTOR * limit)
    audited = runs.audited.begun & (runs.audited.approach > 0)
    furthest = np.max(np.where(audited, np.abs(difference), 0.0), axis=0)
    if _find_passing_margin(furthest[good & fitted], false_alarms) <= narrow:
        return RestitutionMargin(narrow, None, fitted)
    used = fitted | (runs.index % 2 == 1)
    wide = furthest[good & used]
    # The largest of n values is exceeded by a further one with probability 1/(n + 1).
    few = (len(wide) + 1) * false_alarms < 1
    margin = max(narrow, (UNSEEN_RUN_FACTOR if few else 1.0) * _find_passing_margin(wide, false_alarms))
    return RestitutionMargin(margin, narrow if margin > narrow else None, used)


def _find_passing_margin(furthest: Float[np.ndarray, "runs"], share: float) -> float:
    """Return the least margin that, with 95 % confidence, at most a `share` of runs exceeds.

    With too few runs for that it is the largest of these runs.
    """
    if not len(furthest):
        return 0.0
    high = binomial_interval(np.arange(len(furthest)), len(furthest)).high
    return float(np.sort(furthest)[::-1][max(0, np.sum(high <= share) - 1)])
