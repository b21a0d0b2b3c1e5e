"""To the rig: the bundle that leaves the workstation, its writers, its test vectors and its self-test."""
