"""Verification that the rig's controller behaves like the simulated one, by replay and in closed loop."""
