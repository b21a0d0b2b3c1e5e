"""The simulated loop: scenarios, one tick of the rig, whole runs, and what is said of each contact."""
