"""Contact surfaces of the mechanism: at position 0, and at -clearance if the contact is two-sided."""


def deflection(position: float, clearance: float) -> float:
    """Return the penetration [m] at x = `position`: x if x > 0, x + clearance if x < -clearance, else 0."""
    if position > 0.0:
        return position
    beyond = position + clearance
    return beyond if beyond < 0.0 else 0.0
