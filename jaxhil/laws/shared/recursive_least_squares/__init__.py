"""Recursive least squares for contact stiffness and damping."""
