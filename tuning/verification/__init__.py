"""Verification of the rig's controller against the simulation, by replay and in closed loop."""
