"""Recursive least-squares estimate of contact stiffness and damping."""
