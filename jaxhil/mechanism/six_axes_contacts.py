"""Rules of the contacts of a mechanism file of six axes: which shapes can touch, and which keys they have."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxhil.contact.laws import contact_law
from jaxhil.errors import shown
from jaxhil.mechanism.conversion import KeyProblem, Path, allowed_at
from jaxhil.mechanism.rules import check_law
from jaxhil.mechanism.six_axes import (
    KEYS_IN_SIX_AXES,
    Contact,
    Friction,
    Latch,
    Shape,
    SixAxisMechanism,
)

__all__ = ["check_contact", "check_latch"]

# Keys that each shape needs, and those that it may have.
KEYS_OF_SHAPES: Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "sphere": (("centre", "radius"), ("inside",)),
    "plane": (("point", "normal"), ()),
    "drogue": (("half_angle", "bottom_radius", "bottom"), ("mouth_radius",)),
    "capsule": (("from", "to", "radius"), ()),
    "box": (("centre", "half_lengths", "rounding"), ("rotation",)),
}
KEYS_OF_FRICTION: Mapping[str, tuple[str, ...]] = {
    "regularised": ("slip",),
    "bristle": ("stiffness", "damping"),
}


def check_contact(mechanism: SixAxisMechanism, name: str, contact: Contact) -> None:
    """The contact's shapes can touch, and its keys are those of its shapes and laws. Raises `KeyProblem`."""
    path: Path = ("contact", name)
    for body in ("chaser", "target"):
        _check_shape((*path, body), getattr(contact, body))
    _check_pair(path, contact)
    if contact.target_pattern is not None and contact.pattern is None:
        raise KeyProblem(
            (*path, "target_pattern"), "a table", "nothing, or pattern = { count = N } beside it"
        )
    check_law(path, contact, mechanism.uncertainty, KEYS_IN_SIX_AXES.values())
    law = contact_law(contact.law)
    if not (law.damped or law.dissipates_by) and contact.damping:
        allowed = f"0 (law {law.name} has none), or {law.damped_as}"
        raise KeyProblem((*path, "damping"), shown(contact.damping), allowed)
    if contact.friction is not None:
        _check_friction((*path, "friction"), contact.friction)


def check_latch(mechanism: SixAxisMechanism, name: str, latch: Latch) -> None:
    """The latch has one spring, and what it is caught by. Raises `KeyProblem`."""
    path: Path = ("latch", name)
    if latch.latched and mechanism.approach is not None:
        allowed = "false: an approach is free until the first touch ([start] says where a latch holds)"
        raise KeyProblem((*path, "latched"), "true", allowed)
    for key in ("depth", "angle"):
        if not latch.latched and getattr(latch, key) is None:
            allowed = f"{allowed_at(Latch, key)}, or latched = true: held from the start on"
            raise KeyProblem((*path, key), "nothing", allowed)
    if (latch.stiffness is None) == (latch.stiffness_matrix is None):
        found = "nothing" if latch.stiffness is None else "stiffness_matrix beside it"
        raise KeyProblem((*path, "stiffness"), found, "six numbers, or stiffness_matrix instead")
    if latch.stiffness_matrix is not None:
        matrix = np.asarray(latch.stiffness_matrix)
        size = np.max(np.abs(matrix))
        if np.any(np.abs(matrix - matrix.T) > 1e-12 * size) or np.linalg.eigvalsh(matrix)[0] < -1e-9 * size:
            found = "one that is not symmetric or has an eigenvalue below 0"
            raise KeyProblem(
                (*path, "stiffness_matrix"), found, "that of a spring: symmetric, no eigenvalue below 0"
            )


def _check_shape(path: Path, shape: Shape) -> None:
    needed, more = KEYS_OF_SHAPES[shape.shape]
    for key, value in _given(shape).items():
        if key in needed and value is None:
            allowed = f"{allowed_at(Shape, key)} ({shape.shape} needs it)"
            raise KeyProblem((*path, key), "nothing", allowed)
        if key not in (*needed, *more) and value not in (None, False):
            raise KeyProblem((*path, key), shown(value), f"nothing ({shape.shape} does not use it: unset it)")
    if shape.shape == "plane" and not np.any(shape.normal):
        raise KeyProblem((*path, "normal"), shown(shape.normal), "a direction, outwards from the body")
    if shape.shape == "capsule" and shape.start == shape.end:
        raise KeyProblem((*path, "to"), "the point that is from", "another point; a sphere has one")
    if shape.shape == "sphere" and shape.inside and not shape.radius:
        raise KeyProblem((*path, "radius"), "0.0", "a number > 0 m, as it is touched from inside")
    if shape.mouth_radius is not None:
        least = (shape.bottom_radius or 0.0) * math.cos(shape.half_angle or 0.0)
        if not shape.mouth_radius > least:
            allowed = f"a number > {least:g} m, where the rounded bottom ends"
            raise KeyProblem((*path, "mouth_radius"), shown(shape.mouth_radius), allowed)
    if shape.shape == "box":
        smallest = min(shape.half_lengths or [0.0])
        if (shape.rounding or 0.0) > smallest:
            raise KeyProblem(
                (*path, "rounding"), shown(shape.rounding), f"at most half_lengths, {smallest:g} m"
            )


def _check_pair(path: Path, contact: Contact) -> None:
    chaser, target = contact.chaser, contact.target
    if chaser.shape == "drogue":
        raise KeyProblem(
            (*path, "chaser", "shape"), "drogue", "a drogue on the target, where it opens along +z"
        )
    balls = [one.shape == "sphere" and not one.inside for one in (chaser, target)]
    if not any(balls) and not chaser.shape == target.shape == "capsule":
        found = f"{target.shape} against the chaser's {chaser.shape}"
        raise KeyProblem((*path, "target", "shape"), found, "a sphere on either body, or two capsules")
    if target.mouth_radius is not None and not chaser.radius:
        allowed = "a number > 0 m: a drogue with a mouth is a thin shell"
        raise KeyProblem((*path, "chaser", "radius"), shown(chaser.radius), allowed)
    for body, ball, other in (("chaser", chaser, target), ("target", target, chaser)):
        narrow = other.bottom_radius if other.shape == "drogue" else other.radius if other.inside else None
        if narrow is not None and not (ball.radius or 0.0) < narrow:
            allowed = f"a number < {narrow:g} m, the radius that it is to fit into"
            raise KeyProblem((*path, body, "radius"), shown(ball.radius), allowed)


def _check_friction(path: Path, friction: Friction) -> None:
    for law, keys in KEYS_OF_FRICTION.items():
        for key in keys:
            value = getattr(friction, key)
            if law == friction.law and value is None and key != "damping":
                raise KeyProblem((*path, key), "nothing", f"{allowed_at(Friction, key)} ({law} needs it)")
            if law != friction.law and value is not None:
                raise KeyProblem((*path, key), shown(value), f"nothing ({friction.law} does not use it)")


def _given(shape: Shape) -> dict[str, Any]:
    """Every key but the shape's name, as the file calls it, with its value."""
    names = zip(shape.__struct_encode_fields__, shape.__struct_fields__, strict=True)
    return {key: getattr(shape, name) for key, name in names if name != "shape"}
