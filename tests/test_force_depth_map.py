"""The force-depth map of the retrospective laws: what it learns, its force, the peak force it predicts."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK
from scipy import stats

from jaxhil.compensators import force_depth_map as in_jax
from jaxhil.runtime.laws.force_depth_map import (
    KNOTS,
    PARAMETERS,
    SEGMENTS,
    Curve,
    ForceDepthMap,
    Prior,
    positive_mean,
    wandered,
)

PRIOR = {
    "stiffness": 254.0,
    "common": 668.0,
    "wandering": 249.0,
    "damping": 0.9,
    "depth_damping": 0.4,
    "unloading": 60.0,
    "friction": 1.2,
    "preload": 2.0,
}
LOST = ("damping", "depth_damping", "unloading", "friction")
# Slopes of a map that pulls down to 15 ms and pushes from there on [1/s^2].
LATE = np.where(np.array(KNOTS) < 0.015, -50.0, 400.0)


def quickly(function):
    """As one program, not operation by operation."""
    return jax.jit(function, compiler_options=QUICK)


def turning(speed):
    return speed / np.hypot(speed, 0.03)


def features(depth, speed, deepest):
    """The regressor, as the equation has it."""
    widths = np.append(np.diff(KNOTS), np.inf)
    pressed = np.clip(depth - np.array(KNOTS), 0, widths)
    return np.r_[pressed, speed, depth * speed / 0.03, depth - deepest, turning(speed), 1.0]


def prior():
    """Mean and covariance, as the equation has them."""
    depths = np.array([wandered(knot) for knot in KNOTS])
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    covariance[:SEGMENTS, :SEGMENTS] = PRIOR["common"] ** 2
    covariance[:SEGMENTS, :SEGMENTS] += PRIOR["wandering"] ** 2 * np.minimum.outer(depths, depths) / 0.03
    for place, name in enumerate((*LOST, "preload"), start=SEGMENTS):
        covariance[place, place] = PRIOR[name] ** 2
    return np.r_[np.full(SEGMENTS, PRIOR["stiffness"]), np.zeros(PARAMETERS - SEGMENTS)], covariance


def some_readings(number=120):
    """Depths, speeds, deepest points and forces of a contact that stiffens and dissipates, noisy."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0.02, math.pi - 0.02, number)
    depths, speeds = 0.06 * np.sin(phase), np.cos(phase)
    deepest = np.maximum.accumulate(depths)
    forces = 250 * depths + 400 * np.maximum(depths - 0.03, 0) + 1.5 * speeds + 20 * depths * speeds
    forces += 4.0 - 40 * (deepest - depths) + 0.8 * turning(speeds)
    return depths, speeds, deepest, forces + 0.05 * rng.standard_normal(number)


def curve_of(slopes, preload=0.0, **lost):
    """What counts of a map that is known."""
    curve = Curve()
    curve.slopes = list(slopes)
    curve.at_knots = (preload + np.append(0.0, np.cumsum(np.diff(KNOTS) * slopes[:-1]))).tolist()
    for name, value in lost.items():
        setattr(curve, name, value)
    return curve


def in_lanes(slopes, preload=0.0):
    """The same for JAX, one lane."""
    zero = jnp.zeros(())
    return in_jax.Curve(jnp.asarray(slopes), zero, zero, zero, zero, zero + preload)


def test_map_is_the_posterior_of_all_readings():
    """Normal equations against both recursions."""
    readings = some_readings()
    variance = 0.14**2
    phi = np.array([features(*reading[:3]) for reading in zip(*readings, strict=True)])
    forces = readings[3]
    mean, covariance = prior()
    spread = phi @ covariance @ phi.T + variance * np.eye(len(phi))
    share = np.linalg.solve(spread, phi @ covariance).T
    expected, left = mean + share @ (forces - phi @ mean), covariance - share @ phi @ covariance

    contact = ForceDepthMap(Prior(**PRIOR))
    like = jnp.zeros(())
    ours = quickly(in_jax.prior)(*(like + value for value in PRIOR.values()))
    regressors, update, force_of = map(quickly, (in_jax.features, in_jax.update, in_jax.force))
    np.testing.assert_allclose(ours.mean, mean, rtol=1e-14)
    np.testing.assert_allclose(ours.covariance, covariance, rtol=1e-13)
    for depth, speed, deepest, force in zip(*readings, strict=True):
        contact.update(float(depth), float(speed), float(deepest), float(force), variance)
        regressor = regressors(like + depth, like + speed, like + deepest)
        ours = update(
            ours, regressor, like + force, like + variance, jnp.asarray(True), jnp.asarray(speed > 0)
        )
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(ours.mean, expected, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(contact.curve.slopes, expected[:SEGMENTS], rtol=0, atol=1e-9 * scale)
    assert contact.curve.at_knots[0] == pytest.approx(expected[-1], abs=1e-9 * scale)
    counts = quickly(in_jax.curve)(ours)
    for place, name in enumerate(LOST, start=SEGMENTS):
        value = positive_mean(expected[place], left[place, place])
        assert getattr(contact.curve, name) == pytest.approx(value, rel=1e-6)
        assert float(getattr(counts, name)) == pytest.approx(value, rel=1e-6)
    theta = [*expected[:SEGMENTS], *(float(getattr(counts, name)) for name in (*LOST, "preload"))]
    for depth, speed, deepest in ((0.004, 0.9, 0.004), (0.03, -0.2, 0.05), (0.3, 0.5, 0.3)):
        value = features(depth, speed, deepest) @ theta
        assert contact.curve.force(depth, speed, deepest) == pytest.approx(value, rel=1e-6)
        seen = force_of(counts, like + depth, like + speed, like + deepest)
        assert float(seen) == pytest.approx(value, rel=1e-6)
    assert contact.curve.force(-0.001, 1.0, 0.0) == 0
    assert float(force_of(counts, like - 0.001, like + 1, like)) == 0


def test_slopes_wander_ever_less_far_out():
    """As the integral of (92 ms/kappa)^4 beyond 92 ms."""
    for depth in (0.05, 0.092, 0.14, 0.2):
        beyond = np.linspace(0.092, max(depth, 0.092), 20001)
        expected = min(depth, 0.092) + np.trapezoid((0.092 / beyond) ** 4, beyond)
        assert wandered(depth) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(
    ("slopes", "preload", "peak"),
    [
        (np.full(12, 400.0), 0.0, 20.0),
        # f^2 = F_0^2 + 2 k E.
        (np.full(12, 400.0), 3.0, math.sqrt(9 + 400)),
        # 100 up to 34 ms, 500 beyond: the energy left at 34 ms is 1/2 - 0.0578.
        (np.where(np.array(KNOTS) < 0.034, 100.0, 500.0), 0.0, math.sqrt(3.4**2 + 1000 * (0.5 - 0.0578))),
        # It pulls down to 15 ms, where it would be at -0.75, and stands at 2.85 at 24 ms.
        (LATE, 0.0, math.sqrt(2.85**2 + 2 * 400 * (0.5 - 0.009 * 2.85 / 2))),
        # It pulls from 17 ms on, and never again pushes.
        (np.where(np.array(KNOTS) < 0.008, 1000.0, -900.0), 0.0, 1.0),
        (np.full(12, -5.0), 0.0, 1.0),
    ],
    ids=["linear", "preload", "two slopes", "pulls first", "pulls then", "only pulls"],
)
def test_predicted_peak_force(slopes, preload, peak):
    assert curve_of(slopes, preload).peak_force() == pytest.approx(peak, rel=1e-12)
    both = jax.tree.map(
        lambda a, b: jnp.stack([a, b], axis=-1), in_lanes(slopes, preload), in_lanes(np.full(12, 400.0))
    )
    np.testing.assert_allclose(quickly(in_jax.peak_force)(both), [peak, 20.0], rtol=1e-12)


def test_derivative_of_the_predicted_peak_force_beyond_knots_that_pull():
    found = quickly(jax.grad(lambda slopes: in_jax.peak_force(in_lanes(slopes))))(jnp.asarray(LATE))
    each = 1e-4 * np.eye(12)
    steps = [curve_of(LATE + step).peak_force() - curve_of(LATE - step).peak_force() for step in each]
    np.testing.assert_allclose(found, np.array(steps) / 2e-4, rtol=1e-6, atol=1e-9)
    assert np.count_nonzero(found) == 8  # up to 76 ms


@pytest.mark.parametrize("depth", [0.001, 0.02, 0.07, 0.3])
def test_derivatives_of_the_elastic_force_are_the_slope_there_and_how_far_segments_are_pressed_in(depth):
    slopes = np.linspace(100.0, 320.0, SEGMENTS)

    def elastic(slopes, depth):
        return in_jax.elastic(in_jax.Curve(slopes, *jnp.zeros(5)), depth)

    by_slopes, by_depth = quickly(jax.jacfwd(elastic, argnums=(0, 1)))(jnp.array(slopes), jnp.array(depth))
    ends = np.append(KNOTS[1:], np.inf)
    np.testing.assert_allclose(by_slopes, np.clip(np.minimum(depth, ends) - KNOTS, 0, None), atol=1e-15)
    assert by_depth == slopes[np.searchsorted(KNOTS, depth) - 1]


@pytest.mark.parametrize("ratio", [-30.0, -3.0, -0.5, 0.0, 0.3, 1.0, 2.5, 8.0])
def test_damping_that_counts_is_the_truncated_mean(ratio):
    density, share = stats.norm.pdf(ratio), stats.norm.cdf(ratio)
    expected = ratio + density / share if ratio > -20 else -1 / ratio
    assert positive_mean(0.4 * ratio, 0.16) == pytest.approx(0.4 * expected, rel=0.03)
