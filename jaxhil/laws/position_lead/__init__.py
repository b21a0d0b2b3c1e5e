"""Position lead: the position command compensates for the motion simulator's lag."""
