"""No compensation."""
