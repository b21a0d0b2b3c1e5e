"""Tangent model of a contact: the force along its direction, linear and quadratic in the depth."""
