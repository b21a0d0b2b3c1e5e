"""Bounds on the peak force and the duration of a real contact, relative to the ideal contact.

The real contact is the contact of the hardware on the rig. The ideal contact is the contact without any delay
at the same approach speed.

A correct restitution does not prove that a contact tests the hardware. The force command can return the
correct energy although the real contact is much harder and longer than the ideal contact. A contact is
therefore good only if its peak force and its duration are within bounds. The largest real force must be at
most `MAX_PEAK_FORCE_RATIO` times the ideal contact's peak force. The duration of the real force must be
`MIN_DURATION_RATIO` to `MAX_DURATION_RATIO` times the ideal contact's duration. Section 2 of
notebooks/guide/model.md gives the reasons for these numbers.
"""

import math
from typing import Any

MAX_PEAK_FORCE_RATIO = 2.0  # maximum peak force, divided by the ideal contact's peak force [1]
MIN_DURATION_RATIO, MAX_DURATION_RATIO = 0.5, 2.0  # limits of duration divided by ideal duration [1]
# Control periods; maximum rounding error of a measured duration: one period at each end of the contact.
DURATION_ROUNDING = 2
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

# The functions below accept numbers, NumPy arrays and JAX arrays.


def is_peak_force_excessive(peak_force: Any, ideal_peak_force: Any) -> Any:
    """Return whether the peak force [N] of a real contact exceeds its bound; False for NaN."""
    return peak_force > MAX_PEAK_FORCE_RATIO * ideal_peak_force


def is_duration_out_of_bounds(duration: Any, ideal_duration: Any, period: Any) -> Any:
    """Return whether the duration of a real contact is outside its bounds.

    Args:
        duration: Time during which a real force acts [s]. For NaN, the result is False.
        ideal_duration: Duration of the ideal contact [s]. If infinite, because the bodies do not separate,
            the result is False.
        period: Control period [s].
    """
    slack = DURATION_ROUNDING * period
    short = (duration < MIN_DURATION_RATIO * ideal_duration - slack) & (ideal_duration < math.inf)
    return short | (duration > MAX_DURATION_RATIO * ideal_duration + slack)


def is_contact_out_of_bounds(
    peak_force: Any, ideal_peak_force: Any, duration: Any, ideal_duration: Any, period: Any
) -> Any:
    """Return whether a real contact is too hard, too short or too long.

    See `is_peak_force_excessive` and `is_duration_out_of_bounds` for the arguments.
    """
    return is_peak_force_excessive(peak_force, ideal_peak_force) | is_duration_out_of_bounds(
        duration, ideal_duration, period
    )
