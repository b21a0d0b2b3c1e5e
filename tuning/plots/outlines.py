"""Outlines, as lines in space, of the contact shapes of a six-axis mechanism, for its plots."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxhil.sixdof.candidates import Candidates, Capsules, ChaserSpheres, TargetSpheres
from jaxhil.sixdof.forces import ContactGroup
from jaxhil.sixdof.rotations import Quaternion
from jaxhil.sixdof.shapes import Ball, Box, Capsule, Cavity, Drogue, Plane, Rim, Shape, Shell
from jaxhil.sixdof.vectors import Vector

Polyline = np.ndarray  # (points, 3) [m]

CIRCLE_ANGLES = np.linspace(0, 2 * np.pi, 49)  # angles of the points of a circle [rad]
MERIDIAN_COUNT = 24  # number of meridians drawn on a surface of revolution
DRAWN_CONE_SIZE = 3.0  # smallest drawn radius of a cone without a mouth, divided by its bottom radius [1]
POINT_MARK_SIZE = 0.02  # half size of the cross that marks a point, divided by the size of the mechanism


def outlines(groups: Sequence[ContactGroup]) -> tuple[list[Polyline], list[Polyline]]:
    """Return the outlines of target and chaser as lines, each (points, 3) [m].

    The frames are T (docking interface of the target) and C (of the chaser). Only the shapes of the first
    batch element are used. A line that several shapes share occurs once.
    """
    pairs = [pair for group in groups for pair in _shape_pairs(group.candidates)]
    corners = np.concatenate([np.zeros((0, 3)), *(_corners(shape) for pair in pairs for shape in pair)])
    size = float(np.max(np.linalg.norm(corners, axis=1), initial=1e-3))
    bodies = []
    for shapes in ([target for _, target in pairs], [chaser for chaser, _ in pairs]):
        lines = {line.round(9).tobytes(): line for shape in shapes for line in _shape_outline(shape, size)}
        bodies.append(list(lines.values()))
    return bodies[0], bodies[1]


def _shape_pairs(candidates: Candidates) -> list[tuple[Shape, Shape]]:
    """Return the pairs of shapes (chaser, target) that may touch, for the first batch element."""

    def unstack(shape: Any) -> list[Any]:
        leaves, structure = jax.tree.flatten(shape)
        rows = np.asarray([np.broadcast_arrays(*leaves)], float)[0, :, :, 0]
        return [structure.unflatten(list(row)) for row in rows.T]

    if isinstance(candidates, Capsules):
        return list(zip(unstack(candidates.chaser), unstack(candidates.target), strict=True))
    assert isinstance(candidates, (ChaserSpheres, TargetSpheres))
    balls, shapes = unstack(Ball(candidates.centre, candidates.radius)), unstack(candidates.shape)
    ball_on_chaser = isinstance(candidates, ChaserSpheres)
    return list(zip(balls, shapes, strict=True) if ball_on_chaser else zip(shapes, balls, strict=True))


def _corners(shape: Any) -> np.ndarray:
    """Return points (n, 3) [m] that span a shape; no points (0, 3) for a plane."""
    if isinstance(shape, (Ball, Cavity)):
        reach = 0.0 if isinstance(shape, Cavity) else float(shape.radius)
        return _as_point(shape.centre)[None] + reach * np.eye(3)
    if isinstance(shape, Capsule):
        return np.stack([_as_point(shape.start), _as_point(shape.end)])
    if isinstance(shape, Shell):
        return np.array([[float(shape.mouth_radius), 0.0, 0.0]])
    if isinstance(shape, Drogue):
        return np.array([[DRAWN_CONE_SIZE * float(shape.bottom_radius), 0.0, 0.0]])
    if isinstance(shape, Box):
        return _as_point(shape.centre)[None] + _as_point(shape.half_lengths)
    return np.zeros((0, 3))


def _shape_outline(shape: Any, size: float) -> list[Polyline]:
    """Return the outline of a shape as lines; infinite shapes are cut off near the mechanism's `size` [m]."""
    if isinstance(shape, (Ball, Cavity)):
        radius = float(shape.radius)
        circles = [radius * np.roll(_circle(), turn, axis=1) for turn in range(3)] if radius else _cross(size)
        return [_as_point(shape.centre) + circle for circle in circles]
    if isinstance(shape, Plane):
        return _plane(shape, size)
    if isinstance(shape, Drogue):
        return _drogue(shape, size)
    if isinstance(shape, Rim):
        return [float(shape.ring_radius) * _circle() + [0, 0, float(shape.height)]]
    if isinstance(shape, Capsule):
        return _capsule(shape)
    assert isinstance(shape, Box)
    return _box(shape)


def _circle() -> Polyline:
    return np.stack([np.cos(CIRCLE_ANGLES), np.sin(CIRCLE_ANGLES), 0 * CIRCLE_ANGLES], axis=1)


def _cross(size: float) -> list[Polyline]:
    return [POINT_MARK_SIZE * size * np.outer([-1, 1], axis) for axis in np.eye(3)]


def _plane(plane: Plane, size: float) -> list[Polyline]:
    normal = _as_point(plane.normal)
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    sides = np.stack([across, np.cross(normal, across)])
    corners = 1.2 * size * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [1, 1]]) @ sides
    return [_as_point(plane.point) + corners]


def _drogue(drogue: Drogue, size: float) -> list[Polyline]:
    """Return meridians and parallels of a drogue: spherical bottom, and cone up to the mouth."""
    angle, bottom = float(drogue.half_angle), float(drogue.bottom_radius)
    mouth = float(drogue.mouth_radius) if isinstance(drogue, Shell) else 1.2 * size
    below = np.linspace(0, np.pi / 2 - angle, 9)
    radius, height = bottom * np.sin(below), -bottom * np.cos(below)
    end = (mouth * np.cos(angle) - bottom) / np.sin(angle)
    radius, height = np.append(radius, mouth), np.append(height, end) + float(drogue.bottom)
    meridian = np.stack([radius, 0 * radius, height], axis=1)
    lines = [
        meridian @ _rotation_about_z(turn).T
        for turn in np.linspace(0, 2 * np.pi, MERIDIAN_COUNT, endpoint=False)
    ]
    return lines + [r * _circle() + [0, 0, z] for r, z in zip(radius[-2:], height[-2:], strict=True)]


def _capsule(capsule: Capsule) -> list[Polyline]:
    start, end, radius = _as_point(capsule.start), _as_point(capsule.end), float(capsule.radius)
    along = (end - start) / np.linalg.norm(end - start)
    across = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    across *= radius / np.linalg.norm(across)
    sides = [across, np.cross(along, across), -across, -np.cross(along, across)]
    return [np.stack([start, end]), *(np.stack([start + side, end + side]) for side in sides)]


def _box(box: Box) -> list[Polyline]:
    half = _as_point(box.half_lengths)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    edges = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]
    points = (corners * half) @ rotation_matrix(box.attitude).T + _as_point(box.centre)
    return [points[list(edge)] for edge in edges]


def rotation_matrix(attitude: Quaternion) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a unit quaternion."""
    w, (x, y, z) = float(attitude.w), _as_point(attitude.v)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def _rotation_about_z(angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _as_point(vector: Vector) -> np.ndarray:
    return np.array([float(vector.x), float(vector.y), float(vector.z)])
