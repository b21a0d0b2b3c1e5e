"""Comparison of all compensators, each with its own tuned gains, on the same scenarios."""
