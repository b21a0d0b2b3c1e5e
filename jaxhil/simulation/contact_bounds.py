"""Bounds on the real contact relative to the ideal one: peak force and duration.

The restitution alone does not show whether a contact tests the hardware: a command can return the correct
energy after a real contact that is much harder and longer than the ideal contact. A contact is therefore good
only if its largest real force is at most `MAX_PEAK_FORCE_RATIO` times the ideal contact's peak force, and if
the duration of the real force is `MIN_DURATION_RATIO` to `MAX_DURATION_RATIO` times the ideal contact's
duration. The ideal contact is the undelayed one, entered at the same speed. notebooks/guide/model.md, section
2, gives the reasons for the numbers.
"""

import math
from typing import Any

MAX_PEAK_FORCE_RATIO = 2.0  # times the ideal contact's peak force [1]
MIN_DURATION_RATIO, MAX_DURATION_RATIO = 0.5, 2.0  # times the ideal contact's duration [1]
DURATION_ROUNDING = 2  # control periods; rounding of a duration at both ends of a contact
CONTACT_BOUNDS = {
    "peak_force_ratio": MAX_PEAK_FORCE_RATIO,
    "duration_ratio_lowest": MIN_DURATION_RATIO,
    "duration_ratio_highest": MAX_DURATION_RATIO,
}
CONTACT_BOUNDS_TEXT = (
    f"every peak force at most {MAX_PEAK_FORCE_RATIO:g} times and every duration {MIN_DURATION_RATIO:g} "
    f"to {MAX_DURATION_RATIO:g} times "
    "that of the ideal contact"
)
CONTACT_BOUNDS_SHORT_TEXT = (
    f"peak force at most {MAX_PEAK_FORCE_RATIO:g} times, "
    f"duration {MIN_DURATION_RATIO:g} to {MAX_DURATION_RATIO:g} times the ideal"
)
# The following functions accept numbers and arrays of NumPy and JAX.


def is_peak_force_excessive(peak_force: Any, ideal_peak_force: Any) -> Any:
    """Return whether peak forces [N] of real contacts exceed the bound; False for NaN."""
    return peak_force > MAX_PEAK_FORCE_RATIO * ideal_peak_force


def is_duration_out_of_bounds(duration: Any, ideal_duration: Any, period: Any) -> Any:
    """Return whether durations of real contacts are outside the bounds.

    Args:
        duration: Time with a real force [s]; the result is False for NaN.
        ideal_duration: Duration of the ideal contact [s]; the result is False if infinite (no separation).
        period: Control period [s].
    """
    slack = DURATION_ROUNDING * period
    short = (duration < MIN_DURATION_RATIO * ideal_duration - slack) & (ideal_duration < math.inf)
    return short | (duration > MAX_DURATION_RATIO * ideal_duration + slack)


def is_contact_out_of_bounds(
    peak_force: Any, ideal_peak_force: Any, duration: Any, ideal_duration: Any, period: Any
) -> Any:
    """Return whether real contacts are too hard, too short or too long.

    The arguments are those of `is_peak_force_excessive` and `is_duration_out_of_bounds`.
    """
    return is_peak_force_excessive(peak_force, ideal_peak_force) | is_duration_out_of_bounds(
        duration, ideal_duration, period
    )
