"""Derivatives of six-axis energy and twist errors with respect to parameters of rig and contact.

Half of the lanes are a probe in a drogue, half a ring of three points on a plane, in one program. The first
lane of each is aligned with the axis, without rotation and slip.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICK
from six_axes import ideal_sensor, lanes, meeting, place, plain_body, second_order, spheres, springs

from jaxhil.sixdof.approach import find_touching_height
from jaxhil.sixdof.friction import Regularised
from jaxhil.sixdof.ideal_contact_integration import IdealContactModel, sample_ideal_contact
from jaxhil.sixdof.kinematics import TaskSpace
from jaxhil.sixdof.loop import build_loop
from jaxhil.sixdof.metrics import evaluate
from jaxhil.sixdof.relative import Pair
from jaxhil.sixdof.rotations import exponential
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.shapes import Drogue, Plane
from jaxhil.sixdof.vectors import vector

pytestmark = pytest.mark.slow
DRAWS, PERIOD = 256, 1e-3
LANES = 2 * DRAWS  # first the lanes with a probe, then those with a ring
STEP = 2e-5  # relative step; so small that few touches move to another tick
BY = ("stiffness", "dissipation", "friction", "force delay", "axes' delays", "axes' frequencies")
POINTS = np.array([[1.0, -0.5, -0.5], [0.0, 0.866, -0.866], [0.0, 0.0, 0.0]])  # on the ring
HALF_ANGLE = 0.75  # half cone angle of the drogue [rad]
AWAY = 10.0  # distance of shapes that are unused in a lane [m]


def contact(scales):
    """Return the pairs of shapes with scaled stiffness, dissipation and friction."""
    stiffness, dissipation, friction = scales
    is_ring = np.arange(LANES) >= DRAWS

    def group(points, absent, shape):
        one = jnp.ones((points.shape[1], LANES))
        centre = points[:, :, None] + np.array([0, 0, AWAY])[:, None, None] * absent
        law = springs(3e6 * stiffness * one, 1.5 * dissipation * one, 1.5 * one)
        rubbing = Regularised(0.15 * friction * one, 2e-3 * one)
        return spheres(jnp.asarray(centre), 0.02 * one, shape, "hunt_crossley", law, rubbing)

    one = jnp.ones((1, LANES))
    return (
        group(np.zeros((3, 1)), is_ring, Drogue(HALF_ANGLE * one, 0.04 * one, 0 * one)),
        group(0.3 * POINTS, ~is_ring, Plane(place([0, 0, 0], (3, LANES)), place([0, 0, 1], (3, LANES)))),
    )


def bodies():
    return Pair(
        plain_body(1800.0, np.diag([1400.0, 1100.0, 800.0]), (0, 0, 1.2), (LANES,)),
        plain_body(420.0, np.diag([150.0, 180.0, 110.0]), (0, 0, -1.0), (LANES,)),
    )


def draw_touches():
    """Draw offsets (2), attitudes (3) and twists (6) at the first touch, (components, lanes)."""
    seeded = np.random.default_rng(7)
    offset = seeded.uniform(-0.04, 0.04, (2, LANES))
    theta = seeded.uniform(-0.03, 0.03, (3, LANES))
    velocity = seeded.uniform(-2e-3, 2e-3, (3, LANES))
    velocity[2] = seeded.uniform(-0.03, -0.02, LANES)
    angular = seeded.uniform(-3e-3, 3e-3, (3, LANES))
    for part in (offset, theta, velocity[:2], angular):
        part[:, ::DRAWS] = 0
    return offset, theta, np.concatenate([velocity, angular])


@jax.jit
def start_states(offset, theta, twist):
    """Return states shortly before the first touch."""
    height = find_touching_height(contact(np.ones(3)), *offset, exponential(vector(theta)))
    pose = jnp.concatenate([offset, height[None], theta])
    return meeting(bodies(), pose, twist, (0.02 + PERIOD / 3) * jnp.ones(LANES))


def scenario(scales, start):
    one = jnp.ones(LANES)
    force, axes, frequency = scales[3:]
    delays = axes * lanes([4.3e-3, 4.3e-3, 3.4e-3, 5.3e-3, 5.3e-3, 4.4e-3], (LANES,))
    frequencies = frequency * lanes([14.0] * 3 + [11.0] * 3, (LANES,))
    return Scenario(
        bodies(), start, contact(scales[:3]), (), second_order(frequencies, 0.8 + 0 * delays, delays),
        TaskSpace(), ideal_sensor(3.7e-3 * force * one), PERIOD * one, 0.6 * one,
        jnp.zeros((2, LANES), jnp.uint32),
    )  # fmt: skip


@jax.jit
def passes_over(start):
    """Return the lanes whose probe passes from the drogue's bottom to its wall, or back, in ideal contact.

    The surface's curvature jumps there, and the integration conserves energy only to 1e-8, a hundred times
    worse than elsewhere.
    """
    contact_model = IdealContactModel(bodies(), contact(np.ones(3)), ())
    _, seen = sample_ideal_contact(
        contact_model, start, jnp.full(LANES, PERIOD), 300, jnp.full(LANES, 2 * PERIOD)
    )
    at, (probe, _) = seen.pose.position, seen.forces
    on_wall = jnp.hypot(at.x, at.y) * np.sin(HALF_ANGLE) + at.z * np.cos(HALF_ANGLE) > 0
    touches = probe.touch.depth[:, 0] > 0
    return (touches & on_wall).any(axis=0) & (touches & ~on_wall).any(axis=0)


def test_six_axis_error_derivatives_match_finite_differences():
    """Compare with fourth-order central differences, to 1e-4 on 98 % of lanes.

    The other lanes have a known discrete event; no derivative is NaN.
    """
    ones, start = jnp.ones(len(BY)), start_states(*draw_touches())
    static = {"integrator": "semi_implicit_euler", "hold": "linear", "latency": 0}
    loop = build_loop(scenario(ones, start), **static)

    def errors(scales, start):
        result = jax.tree.map(lambda figure: figure[0], evaluate(loop, {}, scenario(scales, start)).metrics)
        touched = jnp.round(result.duration / PERIOD).astype(result.touches.dtype)
        counts = jnp.stack([result.touches, touched, result.reference_touches, result.status])
        return jnp.stack([result.energy_error, result.twist_error]), counts

    forward = jax.jit(errors, compiler_options=QUICK)
    values, counts = map(np.asarray, forward(ones, start))
    assert np.isfinite(values).all() and np.median(values[0]) > 0.1
    slopes, _ = jax.jit(jax.jacfwd(errors, has_aux=True), compiler_options=QUICK)(ones, start)
    slopes = np.asarray(slopes)
    assert np.isfinite(slopes).all()
    good, same = np.ones(LANES, bool), np.ones(LANES, bool)
    for index, by in enumerate(BY):
        expected = 0
        for step, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
            moved, now = forward(ones.at[index].add(step * STEP), start)
            expected += weight * np.asarray(moved) / (12 * STEP)
            same &= (np.asarray(now) == counts).all(axis=0)
        size = np.maximum(np.abs(expected), 1e-2 * np.abs(values))
        fault = (np.abs(slopes[..., index] - expected) / size).max(axis=0)
        print(f"{by}: fault at most {np.max(fault):.1e}, median {np.median(fault):.1e}")
        good &= fault < 1e-4
    over = np.asarray(passes_over(start))
    assert np.sum(over) < 8
    for name, part in (("probe", slice(DRAWS)), ("ring", slice(DRAWS, None))):
        share, bad = np.mean(good[part]), ~good[part]
        moved, passed = np.sum(bad & ~same[part]), np.sum(bad & same[part] & over[part])
        print(f"{name}: within 1e-4 on {share:.1%} of {DRAWS}; of {np.sum(bad)} others a touch moved on "
              f"{moved}, and {passed} passed over from the drogue's bottom to its wall")  # fmt: skip
        assert share >= 0.98 and moved + passed == np.sum(bad)
