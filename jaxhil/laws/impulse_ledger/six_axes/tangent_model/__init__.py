"""Tangent model: scalar model of the contact force, linear and quadratic in the depth."""
