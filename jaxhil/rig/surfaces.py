"""Surfaces of the mechanism: at position 0, and at -clearance if the contact is two-sided."""


def deflection(position: float, clearance: float) -> float:
    """Return by how much [m] a position x is beyond a surface: x > 0, x + clearance < 0, or 0 in between."""
    if position > 0.0:
        return position
    far = position + clearance
    return far if far < 0.0 else 0.0
