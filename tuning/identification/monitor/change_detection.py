"""Detection of a change in the mean by the generalised likelihood ratio (Siegmund and Venkatraman 1995).

Let z_1 ... z_n be the normalised deviations of a metric from its prediction in n contacts. Without a change,
they are independent and standard normal. If the mean changes at contact c to an unknown value, twice the log
likelihood ratio is

    sum(z_c ... z_n)^2 / (n - c + 1).

The value of c with the largest ratio estimates the first contact after the change. A ratio above
`ALARM_THRESHOLD` raises an alarm. `tests/test_monitor_charts.py` compares false alarms and detection delays
with those of a CUSUM chart and a moving average.
"""

from __future__ import annotations

import numpy as np

CONTACTS_PER_FALSE_ALARM = 2000  # mean number of contacts between two false alarms of all metrics together
# Threshold for twice the log likelihood ratio; it gives the rate of `CONTACTS_PER_FALSE_ALARM`.
ALARM_THRESHOLD = 19.55
CHANGE_WINDOW = 200  # number of the latest contacts in which a change is searched


def detect_changes(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each metric, the largest likelihood ratio of a change, and the contact of this change.

    Args:
        z: Normalised deviations, shape (contacts, metrics); NaN marks a missing value.

    Returns:
        Twice the log likelihood ratio, and the index of the first contact after the change, shape (metrics,).
    """
    first = max(0, len(z) - CHANGE_WINDOW)
    finite = np.isfinite(z[first:])
    number = np.cumsum(finite[::-1], axis=0)[::-1]
    total = np.cumsum(np.where(finite, z[first:], 0.0)[::-1], axis=0)[::-1]
    ratio = np.where(finite, total**2 / np.maximum(number, 1), 0.0)
    best = np.argmax(ratio, axis=0)
    return np.take_along_axis(ratio, best[None], axis=0)[0], first + best
