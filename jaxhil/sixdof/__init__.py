"""Simulation in six degrees of freedom: two free bodies that touch each other at several points."""
