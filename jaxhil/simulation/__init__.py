"""Simulation of the rig: scenarios, ticks, runs, and the metrics of each contact."""
