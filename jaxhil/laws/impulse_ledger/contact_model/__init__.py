"""Contact model that is estimated from the readings."""
