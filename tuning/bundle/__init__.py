"""A bundle: the folder in which gains, controller, test vectors and self-test leave for the rig."""
