"""Has a level changed, and since when? The generalised likelihood ratio of a change of the mean.

Of deviations z over their predicted standard deviation, a change with contact c is likelier than none by

    sum(z_c ... z_n)^2 / (n - c + 1)        (twice the logarithm, the new mean fitted)

and the c of the largest is since when (Siegmund and Venkatraman 1995). Beyond `LIMIT` it is an alarm. At the
same rate of false alarms a CUSUM with half a standard deviation of allowance beside an average with weight
0.2 finds a jump of one standard deviation one contact sooner in eighteen, and jumps of four later by a third;
`tests/test_monitor_charts.py` counts both.
"""

from __future__ import annotations

import numpy as np

CONTACTS = 2000  # to one false alarm, all seven figures together
LIMIT = 19.55  # such that it is so
WINDOW = 200  # contacts before the last one with which a change may have begun


def changes(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of deviations of (contacts, figures): how much likelier a change is than none, and the contact with
    which it began; NaN says nothing."""
    first = max(0, len(z) - WINDOW)
    known = np.isfinite(z[first:])
    number = np.cumsum(known[::-1], axis=0)[::-1]
    total = np.cumsum(np.where(known, z[first:], 0.0)[::-1], axis=0)[::-1]
    likelier = np.where(known, total**2 / np.maximum(number, 1), 0.0)
    best = np.argmax(likelier, axis=0)
    return np.take_along_axis(likelier, best[None], axis=0)[0], first + best
