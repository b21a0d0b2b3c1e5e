"""Where the mechanism's surfaces are: at 0, and at -clearance where the contact is two-sided."""


def deflection(position: float, clearance: float) -> float:
    """By how far a position [m] is beyond a surface [m]: x > 0, x + clearance < 0, or 0 in between."""
    if position > 0.0:
        return position
    far = position + clearance
    return far if far < 0.0 else 0.0
