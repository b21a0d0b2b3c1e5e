"""What goes to the rig: bundles, the controller in C, limits and their calibration, the loop over UDP."""
