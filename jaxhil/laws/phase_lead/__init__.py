"""Phase lead of the measured force."""
