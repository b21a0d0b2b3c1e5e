"""All contact laws by the names that mechanism files use, and contact with one surface or two.

A law is one file of `jaxhil.contact`, an entry here and its name in `jaxhil.mechanism.structs.CONTACT_LAWS`;
`jaxhil.contact.base` says what it has to offer. `jaxhil.register` enters those of other packages.
"""

import jax.numpy as jnp
from jaxtyping import Array

from jaxhil.contact.base import ContactLaw, ContactParameters
from jaxhil.contact.depth_damped import DepthDamped
from jaxhil.contact.elastoplastic import Elastoplastic
from jaxhil.contact.hardening import Hardening
from jaxhil.contact.hunt_crossley import HuntCrossley
from jaxhil.contact.kelvin_voigt import KelvinVoigt
from jaxhil.contact.piecewise_linear import PiecewiseLinear
from jaxhil.contact.preloaded import Preloaded

__all__ = [
    "LAWS",
    "ContactLaw",
    "ContactParameters",
    "DepthDamped",
    "Elastoplastic",
    "Hardening",
    "HuntCrossley",
    "KelvinVoigt",
    "PiecewiseLinear",
    "Preloaded",
    "deflection",
    "two_sided",
]

_KELVIN_VOIGT = KelvinVoigt()
LAWS: dict[str, ContactLaw] = {
    "linear": _KELVIN_VOIGT,
    "kelvin_voigt": _KELVIN_VOIGT,
    "hunt_crossley": HuntCrossley(),
    "piecewise_linear": PiecewiseLinear(),
    "hardening": Hardening(),
    "depth_damped": DepthDamped(),
    "elastoplastic": Elastoplastic(),
    "preloaded": Preloaded(),
}


def deflection(position: Array, clearance: Array | None) -> Array:
    """Signed deflection [m] of the mechanism: x at x > 0, x + c at x < -c, else 0 (c may be inf; None where
    there is but one surface)."""
    if clearance is None:
        return jnp.where(position > 0, position, 0)
    far = position + clearance
    return jnp.where(position > 0, position, jnp.where(far < 0, far, 0))


def two_sided(law, parameters, state, position, velocity, clearance):
    """Signed force [N] at either surface: law(d, d') with d = x, or -law(d, d') with d = -c - x; at one
    surface (`clearance` None) the former alone."""
    signed = deflection(position, clearance)
    if clearance is None:
        return law.step(parameters, state, signed, jnp.where(signed > 0, velocity, 0))
    side = jnp.sign(signed)
    force, state = law.step(parameters, state, side * signed, side * velocity)
    return side * force, state
