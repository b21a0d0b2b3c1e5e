"""What goes to the rig: the bundle, its controller in Python and in C, and the loop in real time."""
