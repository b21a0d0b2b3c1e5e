"""Optimisers for variables in the unit box, and sensitivities at the optimum, independent of docking."""
