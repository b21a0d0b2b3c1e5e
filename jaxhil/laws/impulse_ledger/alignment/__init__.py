"""Position and velocity as old as the measured force."""
