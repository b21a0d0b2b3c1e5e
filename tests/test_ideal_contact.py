"""Ideal contact: comparison with numerical integration, limits and finite differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.special import beta

from jaxhil.contact.ideal_contact import (
    IdealContact,
    ideal_hunt_crossley,
    ideal_kelvin_voigt,
    ideal_piecewise_linear,
)

MASS, STIFFNESS, VELOCITY = 325.0, 124355.0, 0.01
PERIOD = np.sqrt(MASS / STIFFNESS)


@functools.cache
def compiled(law):
    return jax.jit(law)


def evaluate(law, *parameters):
    """Compute the ideal contact from lists or floats; compile once per law and shape."""
    arrays = [jnp.asarray(p) if np.asarray(p).dtype == bool else jnp.asarray(p, float) for p in parameters]
    return jax.device_get(compiled(law)(*arrays))


class Terminal:
    """Event that ends the integration when its value falls through 0."""

    terminal, direction = True, -1

    def __init__(self, value):
        self.value = value

    def __call__(self, time, state):
        return self.value(time, state)


def integrate(force, mass, velocity, time_scale, separation="force"):
    """Integrate the contact; return restitution, peak force and duration in units of v and the given time."""
    length = velocity * time_scale

    def acceleration(depth, speed):
        return -force(depth * length, speed * velocity) * time_scale / (mass * velocity)

    def motion(_, state):
        return [state[1], acceleration(*state)]

    @Terminal
    def turns(_, state):
        return state[1]

    @Terminal
    def separates(_, state):
        return -acceleration(*state) if separation == "force" else state[0]

    start, time, peak = [0.0, 1.0], 0.0, 0.0
    for event in (turns, separates):
        way = solve_ivp(
            motion, (time, time + 1e4), start, "DOP853", events=event, dense_output=True,
            rtol=3e-14, atol=1e-17, max_step=0.1,
        )  # fmt: skip
        assert way.status == 1

        def pull(instant, way=way):
            return acceleration(*way.sol(instant))

        # Refine the search instead of interpolating: the force may peak at a kink.
        low, high = time, way.t[-1]
        for points in (101, *[11] * 12):
            grid = np.linspace(low, high, points)
            forces = [-pull(t) for t in grid]
            best = int(np.argmax(forces))
            low, high = grid[max(best - 1, 0)], grid[min(best + 1, points - 1)]
            peak = max(peak, forces[best])
        time, start = way.t[-1], way.y[:, -1]
    return IdealContact(-start[1], peak * mass * velocity / time_scale, time * time_scale)


def assert_close(result, expected, tolerance):
    for name, value, target in zip(IdealContact._fields, result, expected, strict=True):
        np.testing.assert_allclose(value, target, rtol=tolerance, atol=0, err_msg=name)


def damping_of(ratio):
    return 2 * ratio * np.sqrt(MASS * STIFFNESS)


def staircase(slopes, depths, damping):
    """Return the piecewise-linear force, written as a sum of ramps."""
    edges = [0.0, *depths]
    rises = np.diff([0.0, *slopes])

    def force(depth, speed):
        ramps = sum(r * max(depth - e, 0.0) for r, e in zip(rises[1:], edges[1:], strict=True))
        return slopes[0] * depth + ramps + damping * speed

    return force


KELVIN_VOIGT = [0.0, 1e-6, 0.05, 0.49, 0.5, 0.51, 0.9, 0.97, 0.985, 1.0, 1.015, 1.3, 5.0, 100.0]


@pytest.mark.parametrize("ratio", KELVIN_VOIGT)
def test_kelvin_voigt_contact_agrees_with_integration(ratio):
    damping = damping_of(ratio)
    expected = integrate(lambda d, w: STIFFNESS * d + damping * w, MASS, VELOCITY, PERIOD / max(1.0, ratio))
    result = evaluate(ideal_kelvin_voigt, MASS, STIFFNESS, damping, VELOCITY, False)
    assert_close(result, expected, 1e-10)


@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.6, 0.95])
def test_kelvin_voigt_contact_with_tension_agrees_with_integration(ratio):
    damping = damping_of(ratio)
    expected = integrate(lambda d, w: STIFFNESS * d + damping * w, MASS, VELOCITY, PERIOD, separation="depth")
    result = evaluate(ideal_kelvin_voigt, MASS, STIFFNESS, damping, VELOCITY, True)
    assert_close(result, expected, 1e-10)


@pytest.mark.parametrize("ratio", [1.0, 1.0 + 1e-12, 3.0, 1e8])
def test_overdamped_contact_with_tension_sticks(ratio):
    result = evaluate(ideal_kelvin_voigt, 1.0, 1.0, 2 * ratio, VELOCITY, True)
    assert result.restitution == 0
    assert result.duration == np.inf
    np.testing.assert_allclose(result.peak_force, 2 * ratio * VELOCITY, rtol=1e-15)


def test_kelvin_voigt_contact_is_smooth_through_critical_damping():
    # e = exp(-2 xi g): at xi = 1, g = 1 and g' = -1/3, so that d(log e)/d(xi) = -4/3.
    ratios = [1 - 1e-9, 1.0, 1 + 1e-9, 0.98 - 1e-13, 0.98 + 1e-13, 1.02 - 1e-13, 1.02 + 1e-13]
    values, columns = zip(*(FREE(np.array([1.0, 1.0, 2 * r, 1.0])) for r in ratios), strict=True)
    restitution = np.array([value[0] for value in values])
    slope = np.array([2 * column[2, 0] for column in columns])
    np.testing.assert_allclose((slope / restitution)[:3], -4 / 3, rtol=1e-8)
    for below, above in ((3, 4), (5, 6)):
        np.testing.assert_allclose(restitution[below], restitution[above], rtol=2e-12)
        np.testing.assert_allclose(slope[below], slope[above], rtol=2e-12)


# Cases: exponent, and onset q = 1.5 chi v [1].
HUNT_CROSSLEY = [
    (1.5, 0.0), (1.5, 1e-9), (1.5, 1e-3), (1.5, 0.3), (1.5, 0.5), (1.5, 3.0), (1.5, 10.0),
    (1.0, 0.0), (1.0, 0.2), (1.2, 0.05), (2.0, 0.8), (3.0, 5.0),
]  # fmt: skip


def integrate_hunt_crossley(exponent, onset, stiffness, velocity):
    factor = onset / velocity
    depth = ((exponent + 1) * MASS * velocity**2 / (2 * stiffness)) ** (1 / (exponent + 1))
    return integrate(
        lambda d, w: stiffness * max(d, 0.0) ** exponent * (1 + factor * w),
        MASS,
        velocity,
        depth / velocity / max(1.0, onset),
        separation="depth",
    )


@pytest.mark.parametrize(("exponent", "onset"), HUNT_CROSSLEY)
def test_hunt_crossley_contact_agrees_with_integration(exponent, onset):
    expected = integrate_hunt_crossley(exponent, onset, 1e8, VELOCITY)
    result = evaluate(ideal_hunt_crossley, MASS, 1e8, exponent, onset / (1.5 * VELOCITY), VELOCITY)
    assert_close(result, expected, 1e-9)


@pytest.mark.parametrize("onset", [1e-14, 1e-9, 1e-4, 0.1, 1.0, 10.0, 1e3, 1e8])
def test_hunt_crossley_restitution_solves_the_first_integral(onset):
    e = evaluate(ideal_hunt_crossley, 1.0, 1.0, 1.5, onset / 1.5, 1.0).restitution
    if onset < 1e-3:
        np.testing.assert_allclose(1 - e, 2 * onset / 3, rtol=onset, atol=2e-16)
    elif onset < 30:
        lost = e * onset
        np.testing.assert_allclose(-lost - np.log1p(-lost), onset - np.log1p(onset), rtol=1e-11)
    else:
        np.testing.assert_allclose(e * onset, 1.0, rtol=1e-13)


def test_undamped_hertz_contact_has_closed_form_duration():
    # Duration 2.9432 (M^2 / (k^2 v))^(1/5) (5/4)^(2/5): the classical Beta-function integral.
    depth = (2.5 * MASS * VELOCITY**2 / 2 / 1e8) ** 0.4
    result = evaluate(ideal_hunt_crossley, MASS, 1e8, 1.5, 0.0, VELOCITY)
    expected = (1.0, 1e8 * depth**1.5, 2 * depth / VELOCITY * beta(0.4, 0.5) / 2.5)
    assert_close(result, expected, 2e-13)


# Cases: slopes / STIFFNESS, depths / (v PERIOD), and damping ratio of the first segment.
PIECEWISE_LINEAR = [
    ([1, 3, 5], [0.5, 0.7], 0.0),
    ([1, 3, 5], [0.5, 0.7], 1e-8),
    ([1, 3, 5], [0.5, 0.7], 0.05),
    ([1, 0.2, 1], [0.3, 5.0], 0.1),
    ([1, 50, 2], [0.3, 0.5], 0.2),
    ([5, 0.5, 20], [0.2, 0.3], 0.3),
    ([1, 0.1, 4], [0.2, 0.3], 0.8),
    ([1, 9, 1], [0.1, 0.15], 2.0),
    ([1, 0.01, 1], [1e-3, 2e-3], 10.0),
    ([1, 3, 5], [5.0, 6.0], 0.1),
]


@pytest.mark.parametrize(("slopes", "depths", "ratio"), PIECEWISE_LINEAR)
def test_piecewise_linear_contact_agrees_with_integration(slopes, depths, ratio):
    slopes = STIFFNESS * np.array(slopes)
    depths = VELOCITY * PERIOD * np.array(depths)
    damping = damping_of(ratio)
    expected = integrate(staircase(slopes, depths, damping), MASS, VELOCITY, PERIOD / max(1.0, ratio))
    result = evaluate(ideal_piecewise_linear, MASS, slopes, depths, damping, VELOCITY)
    assert_close(result, expected, 1e-9)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.floats(1.0, 3.0), st.floats(-3, 0.8), st.floats(-3, 0))
def test_random_hunt_crossley_contact_agrees_with_integration(exponent, onset, velocity):
    onset, velocity = 10**onset, 10**velocity
    expected = integrate_hunt_crossley(exponent, onset, 1e7, velocity)
    result = evaluate(ideal_hunt_crossley, MASS, 1e7, exponent, onset / (1.5 * velocity), velocity)
    assert_close(result, expected, 1e-9)


three_slopes = st.lists(st.floats(-1, 1), min_size=3, max_size=3)
two_steps = st.lists(st.floats(0.05, 0.6), min_size=2, max_size=2)


@settings(max_examples=12, deadline=None, derandomize=True)
@given(three_slopes, two_steps, st.floats(-3, 0.3))
def test_random_piecewise_linear_contact_agrees_with_integration(slopes, steps, ratio):
    slopes = STIFFNESS * 10 ** np.array(slopes)
    depths = VELOCITY * PERIOD * np.cumsum(steps)
    damping = damping_of(10**ratio)
    expected = integrate(staircase(slopes, depths, damping), MASS, VELOCITY, PERIOD / 2)
    result = evaluate(ideal_piecewise_linear, MASS, slopes, depths, damping, VELOCITY)
    assert_close(result, expected, 1e-9)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(two_steps, st.floats(-9, 4))
def test_piecewise_linear_contact_with_equal_slopes_equals_kelvin_voigt(steps, ratio):
    damping = damping_of(10**ratio)
    depths = VELOCITY * PERIOD * np.cumsum(steps) / max(1.0, 10**ratio)
    whole = evaluate(ideal_kelvin_voigt, MASS, STIFFNESS, damping, VELOCITY, False)
    chained = evaluate(ideal_piecewise_linear, MASS, [STIFFNESS] * 3, depths, damping, VELOCITY)
    assert_close(chained, whole, 1e-12)


@pytest.mark.parametrize("ratio", [0.0, 1e-12, 1e-3, 0.5, 1 - 1e-9, 1.0, 1 + 1e-9, 7.0, 1e5])
def test_piecewise_linear_contact_with_one_segment_equals_kelvin_voigt(ratio):
    damping = damping_of(ratio)
    whole = evaluate(ideal_kelvin_voigt, MASS, STIFFNESS, damping, VELOCITY, False)
    chained = evaluate(ideal_piecewise_linear, MASS, [STIFFNESS], [], damping, VELOCITY)
    assert_close(chained, whole, 1e-12)


@pytest.mark.parametrize("depth", [0.999999999, 1 - 1e-15, 1.0, 1 + 1e-15, 1.000000001])
def test_piecewise_linear_contact_is_exact_if_peak_depth_equals_segment_limit(depth):
    depths = VELOCITY * PERIOD * np.array([0.5, depth])
    result = evaluate(ideal_piecewise_linear, MASS, [STIFFNESS] * 3, depths, 0.0, VELOCITY)
    assert_close(result, (1.0, VELOCITY * np.sqrt(MASS * STIFFNESS), np.pi * PERIOD), 1e-12)
    _, columns = BUFFER(np.array([MASS, *[STIFFNESS] * 3, *depths, 0.0, VELOCITY]))
    assert np.all(np.isfinite(columns))


def packed(law, *shapes):
    """Return the law as a function of one vector of its parameters, in the order of its arguments."""
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])

    def function(vector):
        parts = jnp.split(vector, ends[:-1])
        return jnp.stack(law(*(p.reshape(s) for p, s in zip(parts, shapes, strict=True))))

    def with_jacobian(vector):
        columns = jax.vmap(lambda t: jax.jvp(function, (vector,), (t,))[1])(jnp.eye(vector.size))
        return function(vector), columns

    return jax.jit(with_jacobian)


FREE = packed(lambda m, k, b, v: ideal_kelvin_voigt(m, k, b, v, jnp.array(False)), (), (), (), ())
HELD = packed(lambda m, k, b, v: ideal_kelvin_voigt(m, k, b, v, jnp.array(True)), (), (), (), ())
POWER = packed(ideal_hunt_crossley, (), (), (), (), ())
BUFFER = packed(ideal_piecewise_linear, (), (3,), (2,), (), ())
UNIT = [1.0, 1.0, 1.0, 3.0, 0.5, 0.3, 0.5]

DERIVATIVES = [
    *[(FREE, [2.0, 3.0, 2 * ratio * np.sqrt(6), 0.5]) for ratio in (0.1, 0.45, 0.6, 1.0, 4.0, 300.0)],
    *[(HELD, [2.0, 3.0, 2 * ratio * np.sqrt(6), 0.5]) for ratio in (0.1, 0.6, 0.9)],
    *[(POWER, [2.0, 3.0, n, chi, 0.5]) for n, chi in ((1.5, 1e-3), (1.5, 0.4), (2.2, 3.0), (1.2, 40.0))],
    *[
        (BUFFER, [2.0, *slopes, *depths, damping, 0.5])
        for slopes, depths, damping in (
            ([3.0, 9.0, 20.0], [0.1, 0.25], 1e-3),
            ([3.0, 9.0, 20.0], [0.1, 0.2], 0.5),
            ([3.0, 1.0, 5.0], [0.1, 0.3], 1.5),
            ([3.0, 30.0, 2.0], [0.03, 0.05], 20.0),
            ([3.0, 30.0, 2.0], [0.3, 0.5], 2 * np.sqrt(6.0)),
        )
    ],
]


@pytest.mark.parametrize(("function", "parameters"), DERIVATIVES)
def test_ideal_contact_derivatives_match_finite_differences(function, parameters):
    parameters = np.array(parameters)
    _, columns = function(parameters)
    for index, column in enumerate(np.asarray(columns)):
        step = np.zeros_like(parameters)
        step[index] = 3e-4 * parameters[index]
        up, down, up2, down2 = (np.asarray(function(parameters + c * step)[0]) for c in (1, -1, 2, -2))
        difference = (8 * (up - down) - (up2 - down2)) / (12 * step[index])
        scale = np.abs(function(parameters)[0]) / parameters[index]
        np.testing.assert_array_less(np.abs(column - difference), 2e-9 * scale + 1e-30)


@pytest.mark.parametrize(
    ("function", "parameters", "index"),
    [
        (FREE, [2.0, 3.0, 0.0, 0.5], 2),
        (HELD, [2.0, 3.0, 0.0, 0.5], 2),
        (POWER, [2.0, 3.0, 1.5, 0.0, 0.5], 3),
        (BUFFER, [2.0, 3.0, 9.0, 20.0, 0.1, 0.2, 0.0, 0.5], 6),
    ],
)
def test_undamped_ideal_contact_has_derivative_with_respect_to_damping(function, parameters, index):
    parameters = np.array(parameters)
    value, columns = function(parameters)
    np.testing.assert_allclose(value[0], 1.0, rtol=1e-14)
    assert np.all(np.isfinite(columns))
    # One-sided differences of fourth order.
    steps = parameters + 2e-3 * np.arange(5)[:, None] * np.eye(parameters.size)[index]
    values = np.stack([function(p)[0] for p in steps])
    difference = np.array([-25, 48, -36, 16, -3]) @ values / (12 * 2e-3)
    np.testing.assert_allclose(columns[index], difference, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("function", [FREE, HELD, POWER, BUFFER])
@pytest.mark.parametrize("damping", [0.0, 1e-300, 1e-16, 1e-8, 0.5, 1.0, 2 - 1e-15, 2.0, 2 + 4e-15, 1e3, 1e6])
def test_ideal_contact_results_are_never_nan(function, damping):
    parameters = {
        FREE: [1.0, 1.0, damping, 1.0],
        HELD: [1.0, 1.0, damping, 1.0],
        POWER: [1.0, 1.0, 1.5, damping, 1.0],
        BUFFER: [1.0, 1.0, 1.0, 3.0, 0.5, 0.6, damping, 1.0],
    }[function]
    value, columns = function(np.array(parameters))
    assert not np.any(np.isnan(value))
    assert np.all(np.isfinite(columns))
    assert 0 <= value[0] <= 1 + 1e-14


def test_ideal_contact_preserves_batch_shape_and_single_precision():
    batch = jnp.linspace(0.0, 3.0, 6, dtype=jnp.float32).reshape(2, 3)
    one = jnp.ones_like(batch)
    segments, edges = jnp.stack([one, 3 * one, 5 * one]), jnp.stack([0.3 * one, 0.5 * one])
    calls = (
        (ideal_kelvin_voigt, (one, one, batch, one, batch > 1)),
        (ideal_hunt_crossley, (one, one, 1.5 * one, batch, one)),
        (ideal_piecewise_linear, (one, segments, edges, batch, one)),
    )
    results = []
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        for law, arguments in calls:
            result = compiled(law)(*arguments)
            for field in result:
                assert field.shape == batch.shape
                assert field.dtype == jnp.float32
            results.append(result)
    for (law, arguments), result in zip(calls, results, strict=True):
        single = evaluate(law, *(np.asarray(a)[..., 1, 2] for a in arguments))
        assert_close([field[1, 2] for field in result], single, 1e-5)
