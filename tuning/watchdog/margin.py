"""The restitution's margin: how far from the expected restitution the watchdog lets a contact be.

Where the expectation is good the margin leaves room for what it errs: then no bad run is missed. Where
damping and delay are both unknown it errs by more than the limit leaves room for (an unknown delay looks like
damping, `tuning.watchdog.expectation`), and good runs would be stopped. The margin is then widened until they
pass, and `tuning.watchdog.alarms.noticed_from` says at what price.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxhil.simulation.metrics import OK
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.alarms import GOOD_ERROR, JudgedRuns, features_of, good_runs, reached
from tuning.watchdog.expectation import Expectation, expected_restitution

BEYOND = 1.25  # times the largest that was met among some runs: what others may have
# Of the limit: the least margin of the restitution, and the one that a good expectation has.
LEAST, PLACE = 0.25, 0.75


class Margin(NamedTuple):
    """The margin, and what it was found from."""

    value: float
    widened_from: float | None  # what it would be if only missed alarms counted; None where it is that
    runs: Bool[np.ndarray, "lanes"]  # those that it follows from


def restitution_margin(
    runs: JudgedRuns,
    expectation: Expectation,
    limit: float,
    mass: float,
    fitted: Bool[np.ndarray, "lanes"],
    false_alarms: float,
) -> Margin:
    """At `PLACE` of the limit, nearer to 0 if the expectation errs by more than the rest; but not so near
    that more than the share `false_alarms` of good runs would be stopped.

    An error e - e* beyond the limit is seen if the expectation errs by less than limit - margin. To say how
    far few good runs go takes more runs than to fit the expectation: where that counts, every other one is
    taken besides the `fitted` ones.
    """
    expected = expected_restitution(expectation, features_of(runs.audited), mass)
    difference = runs.audited.restitution - expected
    use = reached(runs, limit) & (runs.status == OK) & fitted
    # Together with what the audit's own restitution differs from the loop's.
    apart = np.abs((difference - runs.error)[use])
    narrow = float(np.clip(limit - BEYOND * np.max(apart, initial=0.0), LEAST * limit, PLACE * limit))
    good = good_runs(runs, GOOD_ERROR * limit)
    audited = runs.audited.begun & (runs.audited.approach > 0)
    furthest = np.max(np.where(audited, np.abs(difference), 0.0), axis=0)
    if _passing(furthest[good & fitted], false_alarms) <= narrow:
        return Margin(narrow, None, fitted)
    placed = fitted | (runs.index % 2 == 1)
    wide = furthest[good & placed]
    # Of n runs the largest is exceeded by one in n + 1 others.
    few = (len(wide) + 1) * false_alarms < 1
    margin = max(narrow, (BEYOND if few else 1.0) * _passing(wide, false_alarms))
    return Margin(margin, narrow if margin > narrow else None, placed)


def _passing(furthest: Float[np.ndarray, "runs"], share: float) -> float:
    """The least margin that so few of these runs exceed that, with confidence, no more than the `share` of
    others does; the largest that one needs, where there are too few to say."""
    if not len(furthest):
        return 0.0
    high = binomial_interval(np.arange(len(furthest)), len(furthest)).high
    return float(np.sort(furthest)[::-1][max(0, np.sum(high <= share) - 1)])
