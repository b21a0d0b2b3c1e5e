"""Phase lead of the measured force."""

AXES = (1, 6)
