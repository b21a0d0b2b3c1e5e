"""Construction of contact groups and latches from a six-axis mechanism file.

A candidate is a pair of shapes that may touch. A table of the file with a pattern (copies of a shape around
the z axis) gives one candidate for each copy. Candidates with the same kinds of shapes and laws form a group,
even if they come from different tables.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.contact.keys import ContactKey
from jaxhil.contact.laws import ContactLaw, ContactParameters, find_contact_law
from jaxhil.mechanism import six_axes
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.sixdof.candidates import Candidates, Capsules, ChaserSpheres, TargetSpheres
from jaxhil.sixdof.drawn_values import DrawnValues
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.friction import Bristle, Friction, Frictionless, Regularised
from jaxhil.sixdof.latch import Latch
from jaxhil.sixdof.rotations import compose
from jaxhil.sixdof.shapes import Ball, Box, Capsule, Cavity, Drogue, Plane, Shape, Shell
from jaxhil.sixdof.vectors import Vector


class Candidate(NamedTuple):
    """Pair of shapes that may touch, with its contact law and friction law; arrays (lanes,)."""

    name: str  # name of the file's table; for a pattern of several copies, with the copy's index
    pair: Candidates
    law: ContactLaw
    parameters: ContactParameters
    friction: Friction


def candidates(mechanism: SixAxisMechanism, numbers: DrawnValues) -> list[list[Candidate]]:
    """Return the pairs of shapes that may touch (candidates), grouped by the kinds of shapes and laws."""
    groups: dict[Any, list[Candidate]] = {}
    for name, contact in mechanism.contact.items():
        count = contact.pattern.count if contact.pattern else 1
        for copy in range(count):
            candidate = _candidate(contact, numbers, name, copy, count)
            structure = jax.tree.structure((candidate.pair, candidate.friction))
            groups.setdefault((candidate.law, len(contact.depths), structure), []).append(candidate)
    return list(groups.values())


def candidate_names(mechanism: SixAxisMechanism) -> tuple[str, ...]:
    """Return the names of all contact candidates, in the order in which `build_groups` returns them."""
    groups = candidates(mechanism, DrawnValues(mechanism, {}))
    return tuple(candidate.name for group in groups for candidate in group)


def build_groups(mechanism: SixAxisMechanism, numbers: DrawnValues) -> tuple[ContactGroup, ...]:
    """Build the groups of contact candidates (shape pairs), with arrays (..., candidates, lanes)."""

    def stacked(*leaves: Any) -> Any:
        # Slopes and depths have a leading axis for their segments, before the axis of the candidates.
        return numbers.np.stack(leaves, axis=max(leaves[0].ndim - 1, 0))

    return tuple(
        ContactGroup(
            jax.tree.map(stacked, *(candidate.pair for candidate in group)),
            group[0].law,
            jax.tree.map(stacked, *(candidate.parameters for candidate in group)),
            jax.tree.map(stacked, *(candidate.friction for candidate in group)),
        )
        for group in candidates(mechanism, numbers)
    )


def build_latches(mechanism: SixAxisMechanism, numbers: DrawnValues) -> tuple[Latch, ...]:
    """Build the latches of each [latch] table, with arrays (..., latches, lanes)."""
    return tuple(_latch(latch, numbers, f"latch.{name}") for name, latch in mechanism.latch.items())


def _latch(latch: six_axes.Latch, numbers: DrawnValues, path: str) -> Latch:
    """Build the latches of one [latch] table: one at each point of the table's pattern around the z axis."""
    count = latch.pattern.count if latch.pattern else 1

    def repeated(value: Any) -> Any:
        return numbers.np.repeat(value[..., None, :], count, axis=-2)

    def diagonal(value: Any) -> Any:
        return np.eye(6)[:, :, None] * value[None]

    first, point = numbers(f"{path}.pattern.phase", 0.0), numbers(f"{path}.chaser")
    points = [numbers.rotated_about_z(first + 2 * np.pi * copy / count, point) for copy in range(count)]
    spring = (
        numbers(f"{path}.stiffness_matrix")
        if latch.stiffness is None
        else diagonal(numbers(f"{path}.stiffness"))
    )
    holds: Any = np.full((count, numbers.number), latch.latched)
    return Latch(
        point=numbers.vector(numbers.np.stack(points, axis=1)),
        depth=repeated(numbers(f"{path}.depth", 0.0)),
        angle=repeated(numbers(f"{path}.angle", np.pi)),
        speed=repeated(numbers(f"{path}.speed")),
        stiffness=repeated(spring),
        damping=repeated(diagonal(numbers(f"{path}.damping"))),
        from_start=holds,
    )


def _candidate(
    contact: six_axes.Contact, numbers: DrawnValues, name: str, copy: int, count: int
) -> Candidate:
    """Build the contact candidate (pair of shapes) for one copy in the pattern of a `[contact]` table.

    `count` is the number of copies, and `copy` is the index of this copy.
    """
    path = f"contact.{name}"
    turn = numbers(f"{path}.pattern.phase", 0.0) + 2 * np.pi * copy / count
    turns = {"chaser": turn, "target": turn + numbers(f"{path}.target_pattern.phase", 0.0)}
    chaser, target = (
        _shape(getattr(contact, body), numbers, f"{path}.{body}", turns[body]) for body in turns
    )
    return Candidate(
        name if count == 1 else f"{name}[{copy}]",
        _pair(chaser, target),
        _law(contact, numbers, path),
        _parameters(contact, numbers, path),
        _friction(contact.friction, numbers, f"{path}.friction"),
    )


def _pair(chaser: Shape, target: Shape) -> Candidates:
    if isinstance(chaser, Ball):
        return ChaserSpheres(chaser.centre, chaser.radius, target)
    if isinstance(target, Ball):
        return TargetSpheres(target.centre, target.radius, chaser)
    assert isinstance(chaser, Capsule) and isinstance(target, Capsule)
    return Capsules(chaser, target)


def _shape(shape: six_axes.Shape, numbers: DrawnValues, path: str, turn: Any) -> Shape:
    """Build a shape, rotated by `turn` [rad] about the z axis of its body's frame (C or T)."""

    def of(key: str) -> Any:
        return jnp.asarray(numbers(f"{path}.{key}"))

    def point(key: str) -> Vector:
        return numbers.vector(numbers.rotated_about_z(turn, numbers(f"{path}.{key}")))

    if shape.shape == "plane":
        return Plane(
            point("point"), numbers.direction(numbers.rotated_about_z(turn, numbers(f"{path}.normal")))
        )
    if shape.shape == "capsule":
        return Capsule(point("from"), point("to"), of("radius"))
    if shape.shape == "drogue":
        cone = of("half_angle"), of("bottom_radius"), of("bottom")
        return Drogue(*cone) if shape.mouth_radius is None else Shell(*cone, of("mouth_radius"))
    if shape.shape == "box":
        attitude = numbers.rotation(numbers(f"{path}.rotation", [0.0, 0.0, 0.0]))
        about_z = numbers.rotation(numbers.np.stack([0 * turn, 0 * turn, turn]))
        attitude = compose(about_z, attitude)
        return Box(point("centre"), attitude, numbers.vector(of("half_lengths")), of("rounding"))
    return (Cavity if shape.inside else Ball)(point("centre"), of("radius"))


def _law(contact: six_axes.Contact, numbers: DrawnValues, path: str) -> ContactLaw:
    """Return the contact law, specialised for the values in the file."""
    return find_contact_law(contact.law).specialise(contact, lambda key: numbers.is_drawn(f"{path}.{key}"))


def _parameters(contact: six_axes.Contact, numbers: DrawnValues, path: str) -> ContactParameters:
    """Return a contact law's parameters: a number as an array (lanes,), a list as (entries, lanes)."""

    def of_law(key: ContactKey) -> Any:
        if isinstance(key.default, bool):
            return np.full(numbers.number, getattr(contact, key.name))
        return numbers(f"{path}.{key.name}", key.neutral)

    return ContactParameters(
        stiffness=numbers(f"{path}.stiffness"),
        damping=numbers(f"{path}.damping"),
        **{name: of_law(key) for name, key in six_axes.KEYS_IN_SIX_AXES.items()},
    )


def _friction(friction: six_axes.Friction | None, numbers: DrawnValues, path: str) -> Friction:
    if friction is None:
        return Frictionless()
    keys = ("slip",) if friction.law == "regularised" else ("stiffness", "damping")
    parts = (jnp.asarray(numbers(f"{path}.{key}", 0.0)) for key in ("coefficient", *keys))
    return (Regularised if friction.law == "regularised" else Bristle)(*parts)
