"""Contact laws as linear regressions (`jaxhil.contact.regression`), and the law for first fits."""

from jaxhil.contact.regression import Regression as Law

__all__ = ["Law", "kelvin_voigt"]


def kelvin_voigt() -> Law:
    """Return the Kelvin-Voigt law F = max(0, k d + b d')."""
    return Law("kelvin_voigt", lambda d, v: [d], ("stiffness", "damping"), lambda d, v: [v])
