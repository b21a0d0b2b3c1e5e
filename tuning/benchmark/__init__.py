"""Every compensator, each tuned to its own best, on the same scenarios."""
