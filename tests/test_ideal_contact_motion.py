"""Integrated motion of the ideal contact: closed forms, convergence, pushes, trajectories, derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK
from scipy.integrate import solve_ivp

from jaxhil.contact.ideal_contact_motion import STEP_TOLERANCE, integrate_contact
from jaxhil.contact.laws import CONTACT_LAWS, ContactParameters

MASS, STIFFNESS, VELOCITY = 350.0, 124355.0, 0.005
OMEGA = np.sqrt(STIFFNESS / MASS)
CRITICAL = 2 * np.sqrt(STIFFNESS * MASS)
LANES = 8

KELVIN_VOIGT = {"damping": CRITICAL * np.array([0.0, 1e-9, 0.03, 0.1, 0.4, 0.6, 1.0, 3.0])}
TENSION = {"damping": CRITICAL * np.linspace(0, 0.8, LANES), "tension": True}
HUNT_CROSSLEY = {
    "stiffness": 1e7,
    "damping": np.array([0.0, 0.0, 1.0, 10.0, 100.0, 1000.0, 2.0, 3.0]),
    "exponent": np.array([1.5, 1.1, 1.2, 1.0, 2.0, 3.0, 1.5, 1.5]),
}
LAYERS = {
    "stiffness": np.array([[8e4], [1.6e5], [3.2e5]]),
    "depths": np.array([[1e-4], [2e-4]]),
    "damping": np.linspace(0, 3000, LANES),
}
CASES = {
    "kelvin_voigt": ("kelvin_voigt", KELVIN_VOIGT),
    "tension": ("kelvin_voigt", TENSION),
    "hunt_crossley": ("hunt_crossley", HUNT_CROSSLEY),
    "piecewise_linear": ("piecewise_linear", LAYERS),
}


def contact(dtype=float, **values):
    """Return the parameters of every lane by name; unspecified parameters are nominal."""

    def lanes(value):
        return np.broadcast_to(np.asarray(value, dtype), (*np.shape(value)[:-1], LANES))

    defaults = {"stiffness": STIFFNESS, "damping": 0.0, "exponent": 1.5, "depths": np.zeros((0, 1))}
    defaults |= {"reference_depth": 1.0, "unloading_ratio": 1.0, "preload": 0.0, "friction": 0.0}
    numbers = {name: values.get(name, default) for name, default in defaults.items()}
    tension = np.full(LANES, values.get("tension", False))
    return ContactParameters(**{n: lanes(v) for n, v in numbers.items()}, tension=tension)


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def within(law, parameters, mass, velocity, tolerance):
    """Return the contact integrated to the given tolerance; all tolerances share one program per law."""
    return integrate_contact(law, parameters, mass, velocity, tolerance=tolerance)


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def has_closed_form(law, parameters, mass, velocity):
    """Return the contact by the closed form of the law."""
    return law.ideal_contact(parameters, mass, velocity)


def integrated(name, values, tolerance=STEP_TOLERANCE, **options):
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    law = CONTACT_LAWS[name]
    parameters = contact(**values)
    if options:
        run = jax.jit(lambda c, m, v: integrate_contact(law, c, m, v, **options), compiler_options=QUICK)
        result = run(parameters, mass, velocity)
    else:
        result = within(law, parameters, mass, velocity, np.asarray(tolerance, float))
    return result, has_closed_form(law, parameters, mass, velocity)


@pytest.mark.parametrize("case", CASES)
def test_integrated_contact_agrees_with_closed_forms(case):
    result, expected = integrated(*CASES[case])
    np.testing.assert_allclose(result.restitution, expected.restitution, rtol=0, atol=2e-8)
    np.testing.assert_allclose(result.peak_force, expected.peak_force, rtol=2e-8)
    np.testing.assert_allclose(result.duration, expected.duration, rtol=2e-8)


@pytest.mark.parametrize("case", [name for name in CASES if name != "piecewise_linear"])
def test_ideal_contact_integration_error_decreases_with_tolerance(case):
    """Expect errors proportional to E^(4/5).

    A fifth-order step with error E has a length proportional to E^(1/5), so that the sum of all step errors
    is proportional to E^(4/5).
    """
    tolerances = np.array([1e-5, 1e-7, 1e-9, 1e-11])
    errors = []
    for tolerance in tolerances:
        result, expected = integrated(*CASES[case], tolerance=float(tolerance))
        errors.append(np.sqrt(np.mean((result.restitution - expected.restitution) ** 2)))
    assert np.polyfit(np.log(tolerances), np.log(errors), 1)[0] > 0.75
    assert errors[-1] < 1e-9


def test_ideal_contact_of_sticking_bodies_never_ends():
    result, _ = integrated("kelvin_voigt", {"damping": 3 * CRITICAL, "tension": True})
    assert np.all(np.isinf(result.duration))
    assert np.all(result.restitution < 1e-6)


def pulse(start, length, height):
    """Return a half-sine push."""

    def push(time):
        inside = (time > start) & (time < start + length)
        return jnp.where(inside, height * jnp.sin(np.pi * (time - start) / length), 0.0)

    return push


def test_ideal_contact_with_external_push_agrees_with_scipy():
    starts, length, height = np.linspace(0.0, 0.21, LANES), 0.02, 6.0
    damping = 0.05 * CRITICAL
    push = pulse(jnp.asarray(starts), length, height)
    times = np.linspace(-0.01, 0.3, 63)[:, None] + np.linspace(0, 1e-3, LANES)
    result, _ = integrated(
        "kelvin_voigt",
        {"damping": damping},
        push=push,
        push_duration=jnp.asarray(starts + length),
        times=jnp.asarray(times),
    )
    for lane, start in enumerate(starts):

        def pushed(t, start=start):
            return height * np.sin(np.pi * (t - start) / length) if start < t < start + length else 0.0

        def motion(t, y, pushed=pushed):
            force = max(0.0, STIFFNESS * y[0] + damping * y[1]) if y[0] >= 0 else 0.0
            return [y[1], -(force + pushed(t)) / MASS]

        exact = solve_ivp(
            motion,
            (0, 0.31),
            [0, VELOCITY],
            "DOP853",
            rtol=1e-10,
            atol=1e-15,
            max_step=5e-4,
            dense_output=True,
        )
        assert result.restitution[lane] == pytest.approx(-exact.y[1, -1] / VELOCITY, abs=2e-7)
        position, speed = np.array(
            [exact.sol(t) if t > 0 else (VELOCITY * t, VELOCITY) for t in times[:, lane]]
        ).T
        np.testing.assert_allclose(result.position[:, lane], position, rtol=0, atol=2e-7 * VELOCITY / OMEGA)
        np.testing.assert_allclose(result.velocity[:, lane], speed, rtol=0, atol=1e-6 * VELOCITY)


def test_external_push_after_ideal_contact_adds_the_push_impulse():
    push = pulse(0.25, 0.02, 6.0)
    result, alone = integrated("kelvin_voigt", {}, push=push, push_duration=0.27)
    impulse = 6.0 * 0.02 * 2 / np.pi
    np.testing.assert_allclose(result.restitution, 1 + impulse / (MASS * VELOCITY), rtol=1e-8)
    np.testing.assert_allclose(result.duration, alone.duration, rtol=1e-9)


def test_trajectory_of_linear_contact_matches_closed_form():
    times = np.linspace(-0.1, 0.4, 97)[::-1].copy()
    times = times[:, None] * np.ones(LANES)
    result, _ = integrated("linear", {}, times=jnp.asarray(times))
    end = np.pi / OMEGA
    inside = (times > 0) & (times < end)
    position = np.where(inside, np.sin(OMEGA * times) / OMEGA, np.where(times > 0, end - times, times))
    speed = np.where(inside, np.cos(OMEGA * times), np.where(times > 0, -1.0, 1.0))
    np.testing.assert_allclose(result.position / VELOCITY, position, rtol=0, atol=1e-8 / OMEGA)
    np.testing.assert_allclose(result.velocity / VELOCITY, speed, rtol=0, atol=2e-7)


# For zero damping the derivative by damping is one-sided.
@pytest.mark.parametrize(
    "case, tolerance",
    [("kelvin_voigt", 1e-3), pytest.param("piecewise_linear", 1e-3, marks=pytest.mark.slow)],
)
def test_integrated_contact_derivatives_match_derivatives_of_closed_forms(case, tolerance):
    name, values = CASES[case]
    law, parameters = CONTACT_LAWS[name], contact(**values)
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))

    def derivatives(reference):
        def function(scales, parameters):
            stiffness = parameters.stiffness * (1 + scales[0])
            # For zero damping the derivative by damping is one-sided.
            damping = parameters.damping + 10 + CRITICAL * scales[1] / 10
            changed = parameters._replace(stiffness=stiffness, damping=damping)
            return jnp.stack(reference(changed, mass * (1 + scales[2]), velocity * (1 + scales[3]))[:3])

        return jax.jit(jax.jacfwd(function), compiler_options=QUICK)(np.zeros(4), parameters)

    result = derivatives(lambda c, m, v: integrate_contact(law, c, m, v))
    expected = derivatives(law.ideal_contact)
    size = has_closed_form(law, parameters._replace(damping=parameters.damping + 10), mass, velocity)
    np.testing.assert_array_less(np.abs(result - expected) / np.stack(size)[..., None], tolerance)


def test_integrated_contact_works_in_single_precision_and_under_vmap():
    law, parameters = CONTACT_LAWS["kelvin_voigt"], contact(np.float32, **KELVIN_VOIGT)
    mass, velocity = (np.full(LANES, value, np.float32) for value in (MASS, VELOCITY))

    def run(damping, mass, velocity):
        scalar = jax.tree.map(lambda leaf: leaf[..., 0], parameters)
        return integrate_contact(law, scalar._replace(damping=damping), mass, velocity)

    result = jax.jit(jax.vmap(run), compiler_options=QUICK)(parameters.damping, mass, velocity)
    assert result.restitution.dtype == np.float32
    expected = has_closed_form(law, parameters, mass, velocity)
    np.testing.assert_allclose(result.restitution, expected.restitution, atol=1e-4)
