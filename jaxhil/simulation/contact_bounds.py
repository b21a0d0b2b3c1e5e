"""Bounds on the real contact beside the ideal one: its peak force and its duration.

The restitution alone does not say whether a contact is a test of the hardware: a command can return the right
energy after a real contact that is many times harder and longer than the ideal contact. So a contact is good
only if its largest real force is at most `MOST_FORCE` times the ideal contact's peak force, and if the time
with a real force is `SHORTEST` to `LONGEST` times the ideal contact's duration. The ideal contact is the
undelayed one, entered at the same speed. Reasons for the numbers: notebooks/guide/model.md, section 2.
"""

import math
from typing import Any

MOST_FORCE = 2.0  # of the ideal contact's peak force [1]
SHORTEST, LONGEST = 0.5, 2.0  # of the ideal contact's duration [1]
COUNTING = 2  # control periods; the duration is counted in whole ones, which both ends of a contact round
BOUNDS = {
    "peak_force_ratio": MOST_FORCE,
    "duration_ratio_lowest": SHORTEST,
    "duration_ratio_highest": LONGEST,
}
STATED = (
    f"every peak force at most {MOST_FORCE:g} times and every duration {SHORTEST:g} to {LONGEST:g} times "
    "that of the ideal contact"
)


BRIEFLY = f"peak force at most {MOST_FORCE:g} times, duration {SHORTEST:g} to {LONGEST:g} times the ideal"
# Of plain numbers, NumPy's and jax's arrays alike.


def too_hard(peak_force: Any, ideal_peak_force: Any) -> Any:
    """Return whether real contacts are harder than allowed; forces [N], NaN is no finding."""
    return peak_force > MOST_FORCE * ideal_peak_force


def duration_off(duration: Any, ideal_duration: Any, period: Any) -> Any:
    """Return whether real contacts are shorter or longer than allowed.

    Args:
        duration: time with a real force [s]; NaN is no finding.
        ideal_duration: that of the ideal contact [s]; where bodies never separate it is infinite, which is
            no finding.
        period: control period [s].
    """
    slack = COUNTING * period
    short = (duration < SHORTEST * ideal_duration - slack) & (ideal_duration < math.inf)
    return short | (duration > LONGEST * ideal_duration + slack)


def unlike_ideal(
    peak_force: Any, ideal_peak_force: Any, duration: Any, ideal_duration: Any, period: Any
) -> Any:
    """Return whether real contacts are too hard, too short or too long; arguments as above."""
    return too_hard(peak_force, ideal_peak_force) | duration_off(duration, ideal_duration, period)
