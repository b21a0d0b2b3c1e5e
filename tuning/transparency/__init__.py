"""Transparency of a compensator: whether its runs still test the hardware.

It is measured with pushes on the hardware and damping perturbations.
"""
