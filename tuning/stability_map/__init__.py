"""Stability maps: a contact's simulated and theoretical error on a grid of two keys, and margins."""
