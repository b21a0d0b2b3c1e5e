"""Conversion of the values that a rig passes to the controller."""

from math import nan
from typing import Any


def as_float(value: Any) -> float:
    """Convert the value to a float; return NaN if it is not a number."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return nan
