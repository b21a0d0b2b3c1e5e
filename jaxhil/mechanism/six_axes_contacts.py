"""Validation rules for the contacts and latches of a six-axis mechanism file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import format_value
from jaxhil.mechanism.conversion import KeyPath, KeyProblem, describe_allowed_at, raise_problems
from jaxhil.mechanism.rules import check_contact_law
from jaxhil.mechanism.six_axes import (
    KEYS_IN_SIX_AXES,
    Contact,
    Friction,
    Latch,
    Shape,
    SixAxisMechanism,
)

__all__ = ["check_contact", "check_latch"]

# Required keys and optional keys of each kind of shape.
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
    """Raise `KeyProblem` unless a contact's shapes form a supported pair and have their required keys."""
    path: KeyPath = ("contact", name)
    for body in ("chaser", "target"):
        _check_shape((*path, body), getattr(contact, body))
    _check_pair(path, contact)
    if contact.target_pattern is not None and contact.pattern is None:
        raise KeyProblem((*path, "target_pattern"), "a table", "nothing, or pattern = { count = N } as well")
    check_contact_law(path, contact, mechanism.uncertainty, KEYS_IN_SIX_AXES.values())
    law = find_contact_law(contact.law)
    if not (law.is_damped or law.dissipation_process) and contact.damping:
        expected = f'0 (law {law.name} has no damping), or law = "{law.damped_law}"'
        raise KeyProblem((*path, "damping"), format_value(contact.damping), expected)
    if contact.friction is not None:
        _check_friction((*path, "friction"), contact.friction)


def check_latch(mechanism: SixAxisMechanism, name: str, latch: Latch) -> None:
    """Raise `KeyProblem` unless a latch has exactly one key for its stiffness, and conditions for catching.

    A latch that holds from the start on needs no conditions.
    """
    path: KeyPath = ("latch", name)
    if latch.latched and mechanism.approach is not None:
        expected = "false, because an approach begins unlatched (use [start] instead)"
        raise KeyProblem((*path, "latched"), "true", expected)
    for key in ("depth", "angle"):
        if not latch.latched and getattr(latch, key) is None:
            expected = f"{describe_allowed_at(Latch, key)}, or latched = true to hold from the start on"
            raise KeyProblem((*path, key), "nothing", expected)
    if (latch.stiffness is None) == (latch.stiffness_matrix is None):
        found = "nothing" if latch.stiffness is None else "stiffness_matrix as well"
        raise KeyProblem((*path, "stiffness"), found, "six numbers, or stiffness_matrix instead")
    if latch.stiffness_matrix is not None:
        matrix = np.asarray(latch.stiffness_matrix)
        scale = np.max(np.abs(matrix))
        if np.any(np.abs(matrix - matrix.T) > 1e-12 * scale) or np.linalg.eigvalsh(matrix)[0] < -1e-9 * scale:
            found = "a matrix that is not symmetric or has an eigenvalue below 0"
            expected = "the matrix of a spring: symmetric, without eigenvalues below 0"
            raise KeyProblem((*path, "stiffness_matrix"), found, expected)


def _check_shape(path: KeyPath, shape: Shape) -> None:
    """Raise `KeyProblem` unless a shape has the keys of its kind, with valid values."""
    required, optional = KEYS_OF_SHAPES[shape.shape]
    problems = []
    for key, value in _file_values(shape).items():
        if key in required and value is None:
            expected = f"{describe_allowed_at(Shape, key)} ({shape.shape} needs it)"
            problems.append(KeyProblem((*path, key), "nothing", expected))
        if key not in (*required, *optional) and value not in (None, False):
            expected = f"nothing ({shape.shape} does not use it: unset it)"
            problems.append(KeyProblem((*path, key), format_value(value), expected))
    raise_problems(problems)
    if shape.shape == "plane" and not np.any(shape.normal):
        raise KeyProblem((*path, "normal"), format_value(shape.normal), "a nonzero outward vector")
    if shape.shape == "capsule" and shape.start == shape.end:
        raise KeyProblem((*path, "to"), "the same point as from", "a different point, or the shape sphere")
    if shape.shape == "sphere" and shape.inside and not shape.radius:
        raise KeyProblem((*path, "radius"), "0.0", "a number > 0 m, because inside = true")
    if shape.mouth_radius is not None:
        smallest = (shape.bottom_radius or 0.0) * math.cos(shape.half_angle or 0.0)
        if not shape.mouth_radius > smallest:
            expected = f"a number > {smallest:g} m, the radius at which the rounded bottom ends"
            raise KeyProblem((*path, "mouth_radius"), format_value(shape.mouth_radius), expected)
    if shape.shape == "box":
        smallest = min(shape.half_lengths or [0.0])
        if (shape.rounding or 0.0) > smallest:
            expected = f"at most {smallest:g} m, the smallest of half_lengths"
            raise KeyProblem((*path, "rounding"), format_value(shape.rounding), expected)


def _check_pair(path: KeyPath, contact: Contact) -> None:
    """Raise `KeyProblem` unless a pair of shapes is supported, and a sphere fits into a hollow shape."""
    chaser, target = contact.chaser, contact.target
    if chaser.shape == "drogue":
        raise KeyProblem(
            (*path, "chaser", "shape"), "drogue", "another shape (only the target can be a drogue)"
        )
    is_ball = [shape.shape == "sphere" and not shape.inside for shape in (chaser, target)]
    if not any(is_ball) and not chaser.shape == target.shape == "capsule":
        found = f"{target.shape} against the chaser's {chaser.shape}"
        raise KeyProblem((*path, "target", "shape"), found, "a sphere on either body, or two capsules")
    if target.mouth_radius is not None and not chaser.radius:
        expected = "a number > 0 m, because a drogue with mouth_radius is a thin shell"
        raise KeyProblem((*path, "chaser", "radius"), format_value(chaser.radius), expected)
    for body, ball, socket in (("chaser", chaser, target), ("target", target, chaser)):
        inner_radius = (
            socket.bottom_radius if socket.shape == "drogue" else socket.radius if socket.inside else None
        )
        if inner_radius is not None and not (ball.radius or 0.0) < inner_radius:
            expected = f"a number < {inner_radius:g} m, the radius of the shape around it"
            raise KeyProblem((*path, body, "radius"), format_value(ball.radius), expected)


def _check_friction(path: KeyPath, friction: Friction) -> None:
    """Raise `KeyProblem` unless a table `friction` has the keys of its friction law."""
    for law, keys in KEYS_OF_FRICTION.items():
        for key in keys:
            value = getattr(friction, key)
            if law == friction.law and value is None and key != "damping":
                raise KeyProblem(
                    (*path, key), "nothing", f"{describe_allowed_at(Friction, key)} ({law} needs it)"
                )
            if law != friction.law and value is not None:
                raise KeyProblem(
                    (*path, key), format_value(value), f"nothing ({friction.law} does not use it)"
                )


def _file_values(shape: Shape) -> dict[str, Any]:
    """Return the values of a shape's keys except `shape`, by the key's name in a mechanism file."""
    names = zip(shape.__struct_encode_fields__, shape.__struct_fields__, strict=True)
    return {key: getattr(shape, name) for key, name in names if name != "shape"}
