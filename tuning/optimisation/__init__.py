"""Optimisers in the unit box, and what they say of the optimum; they know nothing of docking."""
