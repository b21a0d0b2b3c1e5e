"""Registry of the contact laws, their parameters, and the contact force at one or two surfaces.

Each law is a module of `jaxhil.contact` and an entry of `CONTACT_LAWS`; `jaxhil.contact.base` defines the
interface. `jaxhil.register` adds laws of other packages.
"""

from collections import namedtuple
from typing import TYPE_CHECKING, Any, NamedTuple

from jaxhil.contact.arrays import jnp
from jaxhil.contact.base import ContactLaw
from jaxhil.contact.depth_damped import DepthDamped
from jaxhil.contact.elastoplastic import Elastoplastic
from jaxhil.contact.hardening import Hardening
from jaxhil.contact.hunt_crossley import HuntCrossley
from jaxhil.contact.kelvin_voigt import KelvinVoigt, Linear
from jaxhil.contact.keys import ContactKey
from jaxhil.contact.piecewise_linear import PiecewiseLinear
from jaxhil.contact.preloaded import Preloaded
from jaxhil.errors import InputError, format_value

__all__ = [
    "CONTACT_KEYS",
    "CONTACT_LAWS",
    "ContactLaw",
    "ContactParameters",
    "HuntCrossley",
    "KelvinVoigt",
    "PiecewiseLinear",
    "compute_two_sided_force",
    "deflection",
    "find_contact_law",
    "laws_with_key",
]

CONTACT_LAWS: dict[str, ContactLaw] = {
    law.name: law
    for law in (
        Linear(),
        KelvinVoigt(),
        HuntCrossley(),
        PiecewiseLinear(),
        Hardening(),
        DepthDamped(),
        Elastoplastic(),
        Preloaded(),
    )
}
# All keys that only some laws have, in the order of the laws.
CONTACT_KEYS: dict[str, ContactKey] = {
    key.name: key for law in CONTACT_LAWS.values() for key in law.keys or ()
}


def find_contact_law(name: str) -> ContactLaw:
    """Return the contact law with this name. Raise `InputError` for an unknown name."""
    if name not in CONTACT_LAWS:
        raise InputError(
            f"contact.law: found {format_value(name)}, expected one of {', '.join(CONTACT_LAWS)}"
        )
    return CONTACT_LAWS[name]


def laws_with_key(key: ContactKey) -> tuple[str, ...]:
    """Return the names of the contact laws that use a key; the key may have its one-axis or six-axis name."""
    return tuple(
        law.name
        for law in CONTACT_LAWS.values()
        if any(key in (law_key, law_key.in_six_axes()) for law_key in law.keys or ())
    )


if TYPE_CHECKING:

    class ContactParameters(NamedTuple):
        """Parameters of one contact, or of several contacts along a leading axis.

        Each key in `CONTACT_KEYS` is a further field. If the file has no value for a key, the field has the
        key's `neutral` value.
        """

        stiffness: Any  # [N/m], or [N/m^n] for a law with an exponent n; (segments, ...) if segmented
        damping: Any  # [N s/m], or chi [s/m] for Hunt-Crossley
        kind: Any = None  # index into `jaxhil.contact.mixture.LawMixture.laws`; None for a single law

        def __getattr__(self, key: str) -> Any: ...

else:
    ContactParameters = namedtuple(
        "ContactParameters", ["stiffness", "damping", *CONTACT_KEYS, "kind"], defaults=[None]
    )


def deflection(position: Any, clearance: Any | None) -> Any:
    """Return the signed deflection [m] of the mechanism at the position x [m].

    The deflection is x for x > 0, x + c for x < -c, and else 0. The clearance c [m] may be infinite; None
    means that there is only one surface.
    """
    if clearance is None:
        return jnp.where(position > 0, position, 0)
    far = position + clearance
    return jnp.where(position > 0, position, jnp.where(far < 0, far, 0))


def compute_two_sided_force(law, parameters, state, position, velocity, clearance):
    """Return the signed contact force [N] at one or two surfaces, and the next state of the law.

    At the first surface, the penetration is d = x, where x is `position` [m], and the force is F(d, d').
    Unless None, `clearance` c [m] adds a second surface, where the penetration is d = -c - x and the force is
    -F(d, d').
    """
    signed = deflection(position, clearance)
    if clearance is None:
        return law.step(parameters, state, signed, jnp.where(signed > 0, velocity, 0))
    side = jnp.sign(signed)
    force, state = law.step(parameters, state, side * signed, side * velocity)
    return side * force, state
