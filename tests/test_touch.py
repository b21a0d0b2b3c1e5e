"""Contact shapes: signed distances, normals, penetration rates, and nearest points of segments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from jaxhil.sixdof.candidates import Capsules, ChaserSpheres, TargetSpheres, motion_at
from jaxhil.sixdof.relative import Pose, Twist
from jaxhil.sixdof.rotations import Quaternion, exponential, identity, rotate
from jaxhil.sixdof.shapes import Ball, Box, Capsule, Cavity, Drogue, Plane, Rim
from jaxhil.sixdof.vectors import Vector, components, norm, vector

SEEDED = np.random.default_rng(3)
POINTS = SEEDED.uniform(-1, 1, size=(3, 200))


def numbers(*values):
    return [jnp.asarray([float(value)]) for value in values]


def place(*values):
    return Vector(*numbers(*values))


TURN = Quaternion(*numbers(0.8), place(0.36, 0.0, 0.48))
SHAPES = {
    "plane": Plane(place(0.1, 0, 0), place(0.6, 0, 0.8)),
    "ball": Ball(place(0.1, 0.2, 0.3), *numbers(0.4)),
    "cavity": Cavity(place(0.1, 0.2, 0.3), *numbers(0.4)),
    "drogue": Drogue(*numbers(0.75, 0.2, -0.1)),
    "rim": Rim(*numbers(0.5, 0.1, 0.05)),
    "capsule": Capsule(place(-0.3, 0, 0), place(0.2, 0.3, 0.1), *numbers(0.1)),
    "box": Box(place(0.1, 0, 0), TURN, place(0.5, 0.3, 0.1), *numbers(0.05)),
}
SLANT = (np.cos(0.75), 0, -np.sin(0.75))
# The ray from the first point in the direction of the second meets the surface at the given distance.
MET = {
    "plane": ((1.1, 0, 0), (-0.6, 0, -0.8), 0.6),
    "ball": ((0.1, 0.2, 1.3), (0, 0, -1), 0.6),
    "cavity": ((0.1, 0.3, 0.3), (0, 1, 0), 0.3),
    "drogue": ((0.1, 0, 0.3), SLANT, 0.2 + 0.4 * np.sin(0.75) - 0.1 * np.cos(0.75)),
    "rim": ((0.7, 0, 0.1), (-1, 0, 0), 0.15),
    "capsule": ((0.2, 0.3, 1.1), (0, 0, -1), 0.9),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_signed_distance_has_unit_slope_along_its_normal(name):
    """The gradient is the normal, and a step along the normal ends on the surface."""
    shape = SHAPES[name]

    def distance(points):
        return shape.surface(vector(points)).distance

    @jax.jit
    def seen(points):
        slopes = jax.grad(lambda points: distance(points).sum())(points)
        result = shape.surface(vector(points))
        normal = components(result.normal)
        return result.distance, normal, slopes, distance(points - result.distance[None] * normal)

    distances, normals, slopes, landed = seen(jnp.asarray(POINTS))
    # No test point has two nearest points on a surface, where the gradient does not exist.
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, rtol=1e-12)
    np.testing.assert_allclose(np.broadcast_to(normals, slopes.shape), slopes, atol=1e-9)
    beyond = np.asarray(distances) > -0.02
    np.testing.assert_allclose(np.asarray(landed)[beyond], 0, atol=1e-12)
    assert np.sum(beyond) >= 10
    if name in MET:
        start, ray, far = (np.asarray(part) for part in MET[name])
        at = shape.surface(vector(jnp.asarray(start)[:, None]))
        np.testing.assert_allclose(at.distance, far, atol=1e-12)
        np.testing.assert_allclose(components(at.normal)[:, 0], -ray, atol=1e-12)


@pytest.mark.slow
def test_signed_distance_at_singular_points_is_not_nan():
    singular = {
        "ball": (0.1, 0.2, 0.3), "cavity": (0.1, 0.2, 0.3), "drogue": (0, 0, -0.1), "rim": (0.5, 0, 0.1),
        "capsule": (-0.3, 0, 0), "box": (0.1, 0, 0),
    }  # fmt: skip
    for name, point in singular.items():
        at = jnp.asarray(point)[:, None]
        shape = SHAPES[name]
        result = jax.jacfwd(lambda at, shape=shape: shape.surface(vector(at)))(at)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result)), name
    on_axis = jnp.asarray([[0.0], [0.0], [0.5]])
    for name in ("drogue", "rim"):
        result = jax.jacfwd(lambda at, name=name: SHAPES[name].surface(vector(at)).distance)(on_axis)
        assert np.isfinite(result).all(), name


def pose_and_twist():
    pose = Pose(place(0.05, -0.1, 0.9), exponential(place(0.4, 0.1, -0.2)))
    return pose, Twist(place(0.3, -0.2, -0.5), place(0.7, 0.1, -0.4))


def move_pose(pose, twist, time):
    """Return the pose a short time later."""
    turn = exponential(time * twist.angular)
    w = turn.w * pose.attitude.w - jnp.sum(components(turn.v) * components(pose.attitude.v), axis=0)
    u, v = components(turn.v)[:, 0], components(pose.attitude.v)[:, 0]
    part = turn.w * v + pose.attitude.w * u + jnp.cross(u, v)
    return Pose(pose.position + time * twist.linear, Quaternion(w, vector(part[:, None])))


BAR = Capsule(place(0.1, -0.3, 0), place(-0.2, 0.4, 0.4), *numbers(0.1))
CANDIDATES = {
    "sphere on drogue": ChaserSpheres(place(0.1, 0.05, -0.8), *numbers(0.1), SHAPES["drogue"]),
    "ball on sphere": ChaserSpheres(place(0.1, 0.05, -0.4), *numbers(0.1), SHAPES["ball"]),
    "target's sphere": TargetSpheres(place(0.1, 0.05, 0.4), *numbers(0.1), SHAPES["box"]),
    "capsules": Capsules(SHAPES["capsule"], BAR),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CANDIDATES)
def test_penetration_rate_is_derivative_of_depth_and_slip_is_tangential(name):
    candidates = CANDIDATES[name]
    pose, twist = pose_and_twist()
    touch = candidates.touch(pose)
    rate, slip = motion_at(touch, pose, twist)
    _, slope = jax.jvp(lambda time: candidates.touch(move_pose(pose, twist, time)).depth, (0.0,), (1.0,))
    np.testing.assert_allclose(rate, slope, rtol=1e-9)
    assert abs(np.sum(components(slip) * components(touch.normal))) < 1e-15


@pytest.mark.slow
def test_contact_is_unchanged_if_the_two_shapes_are_exchanged():
    pose, _ = pose_and_twist()
    one = CANDIDATES["ball on sphere"].touch(pose)
    ball = Ball(place(0.1, 0.05, -0.4), *numbers(0.1))
    other = TargetSpheres(SHAPES["ball"].centre, SHAPES["ball"].radius, ball).touch(pose)
    exchanged = one._replace(point=one.point - one.depth * one.normal)
    for a, b in zip(jax.tree.leaves(exchanged), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    far = rotate(pose.attitude, ball.centre) + pose.position - SHAPES["ball"].centre
    np.testing.assert_allclose(one.depth, 0.5 - norm(far), rtol=1e-12)


@pytest.mark.slow
def test_nearest_points_of_segments_agree_with_least_squares():
    """Parallel segments touch at the centre of their overlap."""
    for _ in range(40):
        ends = SEEDED.normal(size=(4, 3))
        radii = numbers(0.1)[0], numbers(0.2)[0]
        chaser = Capsule(place(*ends[0]), place(*ends[1]), radii[0])
        target = Capsule(place(*ends[2]), place(*ends[3]), radii[1])
        still = Pose(place(0.0, 0.0, 0.0), identity(jnp.zeros(1)))
        result = Capsules(chaser, target).touch(still)

        along = np.stack([ends[1] - ends[0], ends[2] - ends[3]], axis=1)
        best = lsq_linear(along, ends[2] - ends[0], (0, 1), method="bvls", tol=1e-14)
        np.testing.assert_allclose(0.3 - result.depth, np.linalg.norm(best.fun), rtol=1e-8)
    chaser = Capsule(place(-1.0, 0, 1), place(1.0, 0, 1), numbers(0.1)[0])
    target = Capsule(place(-1.0, 0, 0), place(1.0, 0, 0), numbers(0.2)[0])
    result = Capsules(chaser, target).touch(still)
    np.testing.assert_allclose(components(result.point)[:, 0], [0, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(result.depth, -0.7, rtol=1e-12)
