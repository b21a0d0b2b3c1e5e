"""Linear contact laws: a spring with a damper (Kelvin-Voigt), and a spring without a damper."""

from typing import ClassVar

import numpy as np

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.float_law import FloatLaw, clamp_force
from jaxhil.contact.keys import ContactKey
from jaxhil.contact.regression import Regression, RegressionFamily


class KelvinVoigt(ContactLaw):
    """Contact law F = k d + b d' (k: `stiffness`, b: `damping`), clamped at 0 unless `tension` is true."""

    name: ClassVar[str] = "kelvin_voigt"
    keys: ClassVar = (ContactKey("tension", "whether {laws} may pull", default=False),)
    is_linear: ClassVar[bool] = True

    @property
    def is_locally_parabolic(self):
        return True

    def step(self, parameters, state, penetration, rate):
        force = parameters.stiffness * penetration + parameters.damping * rate
        force = jnp.where(parameters.tension | (force > 0), force, 0)
        return jnp.where(penetration > 0, force, 0), state

    def onset_force(self, parameters, rate):
        force = parameters.damping * rate
        return jnp.where(parameters.tension | (force > 0), force, 0)

    def separation_function(self, parameters, state, penetration, rate):
        force = parameters.stiffness * penetration + parameters.damping * rate
        return jnp.where(parameters.tension, 1, force)

    def ideal_contact(self, parameters, mass, velocity):
        from jaxhil.contact.ideal_contact import ideal_kelvin_voigt

        return ideal_kelvin_voigt(
            mass, parameters.stiffness, parameters.damping, velocity, parameters.tension
        )

    def undamped_peak_force(self, parameters, mass, velocity):
        return np.sqrt(2 * (mass * velocity**2 / 2) * parameters.stiffness)

    def perturb_damping(self, drawn, ratio, mass, velocity):
        """Add 2 zeta sqrt(k M) to `damping`, where zeta is `ratio`, k `stiffness` and M `mass`."""
        return "damping", drawn("damping") + 2 * ratio * np.sqrt(drawn("stiffness") * mass)

    def as_float_law(self, contact, stiffness, damping):
        def spring(depth: float, rate: float) -> float:
            return stiffness * depth + damping * rate

        if contact.tension:
            return FloatLaw(spring, lambda depth, rate: 1.0, lambda rate: damping * rate)
        return clamp_force(spring, lambda rate: damping * rate)

    def regression(self, contact):
        return _kelvin_voigt(contact.tension)

    def families(self, deepest, entries):
        return [RegressionFamily(lambda _, pulls=pulls: _kelvin_voigt(pulls)) for pulls in (False, True)]


class Linear(KelvinVoigt):
    """Contact law F = k d, without damping."""

    name: ClassVar[str] = "linear"
    keys: ClassVar = ()
    is_damped: ClassVar[bool] = False
    damped_law: ClassVar[str] = "kelvin_voigt"

    @property
    def simulation_law(self):
        return KelvinVoigt()

    def as_float_law(self, contact, stiffness, damping):
        return super().as_float_law(contact, stiffness, 0.0)

    def regression(self, contact):
        return Regression("linear", lambda d, v: [d], ("stiffness",))

    def families(self, deepest, entries):
        return [RegressionFamily(lambda _: self.regression(None))]

    def coefficients(self, contact, stiffness, damping):
        return [stiffness]


def _kelvin_voigt(pulls: bool) -> Regression:
    """Return the regression F = k d + b d' with unknown k and b; if `pulls`, F may be negative."""
    return Regression(
        "kelvin_voigt",
        lambda d, v: [d],
        ("stiffness", "damping"),
        lambda d, v: [v],
        pulls,
        {"tension": True} if pulls else {},
    )
