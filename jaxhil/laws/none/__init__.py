"""No compensation."""

AXES = (1, 6)
