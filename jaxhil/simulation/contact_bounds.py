"""Bounds on the real contact relative to the ideal one: peak force and duration.

The restitution alone does not show whether a contact tests the hardware: a command can return the correct
energy after a real contact that is much harder and longer than the ideal contact. A contact is therefore good
only if its largest real force is at most `MOST_FORCE` times the ideal contact's peak force, and if the
duration of the real force is `SHORTEST` to `LONGEST` times the ideal contact's duration. The ideal contact is
the undelayed one, entered at the same speed. notebooks/guide/model.md, section 2, gives the reasons for the
numbers.
"""

import math
from typing import Any

MOST_FORCE = 2.0  # times the ideal contact's peak force [1]
SHORTEST, LONGEST = 0.5, 2.0  # times the ideal contact's duration [1]
COUNTING = 2  # control periods; rounding of a duration at both ends of a contact
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
# The following functions accept numbers and arrays of NumPy and JAX.


def too_hard(peak_force: Any, ideal_peak_force: Any) -> Any:
    """Return whether peak forces [N] of real contacts exceed the bound; False for NaN."""
    return peak_force > MOST_FORCE * ideal_peak_force


def duration_off(duration: Any, ideal_duration: Any, period: Any) -> Any:
    """Return whether durations of real contacts are outside the bounds.

    Args:
        duration: Time with a real force [s]; the result is False for NaN.
        ideal_duration: Duration of the ideal contact [s]; the result is False if infinite (no separation).
        period: Control period [s].
    """
    slack = COUNTING * period
    short = (duration < SHORTEST * ideal_duration - slack) & (ideal_duration < math.inf)
    return short | (duration > LONGEST * ideal_duration + slack)


def unlike_ideal(
    peak_force: Any, ideal_peak_force: Any, duration: Any, ideal_duration: Any, period: Any
) -> Any:
    """Return whether real contacts are too hard, too short or too long.

    The arguments are those of `too_hard` and `duration_off`.
    """
    return too_hard(peak_force, ideal_peak_force) | duration_off(duration, ideal_duration, period)
