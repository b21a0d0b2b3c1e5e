"""Transparency of a compensator: how much its results depend on the hardware instead of expectations.

Two perturbations measure the transparency: pushes on the hardware, and additional damping of the mechanism.
"""
