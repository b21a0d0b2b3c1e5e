"""Format of numbers in tables and pages, as an engineer writes them: 124360 N/m, not 1.2436e+05 N/m."""

import math
from numbers import Integral, Real
from typing import Any

LARGEST_PLAIN = 1e8  # smallest absolute value that is written with an exponent [1]


def format_number(value: Any, digits: int = 4) -> str:
    """Return a number as text with `digits` significant digits.

    Digits before the decimal point that are not significant become zeros. An integer keeps all its digits.
    For any other value, infinite or NaN included, return a dash.
    """
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        return "-"
    if isinstance(value, Integral):
        return str(value)
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text and abs(float(value)) < LARGEST_PLAIN else text
