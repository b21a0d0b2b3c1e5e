"""Contact laws in fits to logs (`jaxhil.contact.regression`), and the initial law of the fits."""

from jaxhil.contact.regression import Regression as Law

__all__ = ["Law", "kelvin_voigt"]


def kelvin_voigt() -> Law:
    """Return the law F = k d + b d' >= 0."""
    return Law("kelvin_voigt", lambda d, v: [d], ("stiffness", "damping"), lambda d, v: [v])
