"""Change detection in the mean: generalised likelihood ratio of a change, and its time.

For deviations z over their predicted standard deviation, twice the log likelihood ratio of a change at
contact c, with the new mean fitted, is

    sum(z_c ... z_n)^2 / (n - c + 1)

and the maximizing c estimates the time of the change (Siegmund and Venkatraman 1995). A ratio above
`ALARM_THRESHOLD` raises an alarm. For comparison, `tests/test_monitor_charts.py` counts false alarms and
delays of a CUSUM with an allowance of half a standard deviation, together with a moving average with weight
0.2.
"""

from __future__ import annotations

import numpy as np

CONTACTS_PER_FALSE_ALARM = 2000  # contacts per false alarm, over all seven metrics
ALARM_THRESHOLD = 19.55  # of twice the log likelihood ratio; gives this rate of false alarms
CHANGE_WINDOW = 200  # number of latest contacts that are searched for a change


def detect_changes(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return twice the log likelihood ratio of a change, and its first contact, for each metric.

    `z` holds the deviations, (contacts, metrics); NaN marks a missing value.
    """
    first = max(0, len(z) - CHANGE_WINDOW)
    finite = np.isfinite(z[first:])
    number = np.cumsum(finite[::-1], axis=0)[::-1]
    total = np.cumsum(np.where(finite, z[first:], 0.0)[::-1], axis=0)[::-1]
    likelier = np.where(finite, total**2 / np.maximum(number, 1), 0.0)
    best = np.argmax(likelier, axis=0)
    return np.take_along_axis(likelier, best[None], axis=0)[0], first + best
