"""Optimisers in the unit box and the sensitivity at the optimum, independent of docking."""
