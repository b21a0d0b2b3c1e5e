"""All contact laws by the names that mechanism files use, their parameters, contact at one surface or two.

A law is one file of `jaxhil.contact` and an entry here; `jaxhil.contact.base` says what it has to offer.
`jaxhil.register` enters those of other packages.
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
from jaxhil.contact.keys import Key
from jaxhil.contact.piecewise_linear import PiecewiseLinear
from jaxhil.contact.preloaded import Preloaded
from jaxhil.errors import InputError, shown

__all__ = [
    "KEYS",
    "LAWS",
    "ContactLaw",
    "ContactParameters",
    "HuntCrossley",
    "KelvinVoigt",
    "PiecewiseLinear",
    "contact_law",
    "deflection",
    "laws_with",
    "two_sided",
]

LAWS: dict[str, ContactLaw] = {
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
# All keys of some laws alone, in the order of the laws.
KEYS: dict[str, Key] = {key.name: key for law in LAWS.values() for key in law.keys or ()}


def contact_law(name: str) -> ContactLaw:
    """Return the law of this name. Raise `InputError` if there is none."""
    if name not in LAWS:
        raise InputError(f"contact.law: found {shown(name)}, expected one of {', '.join(LAWS)}")
    return LAWS[name]


def laws_with(key: Key) -> tuple[str, ...]:
    """Return the names of the laws that state the key, as files of one axis or of six call it."""
    stated = {law.name: law.keys or () for law in LAWS.values()}
    return tuple(
        name for name, keys in stated.items() if any(key in (one, one.in_six_axes()) for one in keys)
    )


if TYPE_CHECKING:

    class ContactParameters(NamedTuple):
        """Numbers of one contact; a leading axis of contacts, where there is one, comes first.

        Besides these fields it has one for each of `KEYS`, (...); that of a key without a value in the file
        is the key's neutral number.
        """

        stiffness: Any  # [N/m], or [N/m^n] with an exponent n; (segments, ...) of a segmented law
        damping: Any  # [N s/m], or chi [s/m] for Hunt-Crossley
        kind: Any = None  # number of the law for `jaxhil.contact.mixture`, else None

        def __getattr__(self, key: str) -> Any: ...

else:
    ContactParameters = namedtuple(
        "ContactParameters", ["stiffness", "damping", *KEYS, "kind"], defaults=[None]
    )


def deflection(position: Any, clearance: Any | None) -> Any:
    """Return the signed deflection [m] of the mechanism: x at x > 0, x + c at x < -c, else 0.

    The clearance c may be infinite; it is None where there is but one surface."""
    if clearance is None:
        return jnp.where(position > 0, position, 0)
    far = position + clearance
    return jnp.where(position > 0, position, jnp.where(far < 0, far, 0))


def two_sided(law, parameters, state, position, velocity, clearance):
    """Return the signed force [N] at either surface: law(d, d') with d = x, or -law(d, d') with d = -c - x;
    at one surface (`clearance` None) the former alone."""
    signed = deflection(position, clearance)
    if clearance is None:
        return law.step(parameters, state, signed, jnp.where(signed > 0, velocity, 0))
    side = jnp.sign(signed)
    force, state = law.step(parameters, state, side * signed, side * velocity)
    return side * force, state
