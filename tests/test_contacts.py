"""Contact laws whose reference is integrated or which remember: closed forms, SciPy, works, derivatives."""

from functools import partial

import continuous
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import IDEAL, MASS, QUICK, VELOCITY, first_contact, grid, mechanism, spread, validated

from jaxhil.contact.laws import LAWS, ContactParameters, two_sided
from jaxhil.contact.reference import hunt_crossley
from jaxhil.contact.reference_motion import integrate_contact

STIFFNESS, LANES = 124355.0, 6
PERIODS = np.array([4e-3, 2e-3, 1e-3, 5e-4])


def contact(**values):
    """Parameters of every lane, by name; what is not named is nominal."""
    numbers = {"stiffness": STIFFNESS, "damping": 0.0, "exponent": 1.5}
    numbers |= {"reference_depth": 2e-4, "unloading_ratio": 1.0, "preload": 0.0, "friction": 0.0}
    lanes = {
        name: np.broadcast_to(np.asarray(values.get(name, n), float), LANES) for name, n in numbers.items()
    }
    return ContactParameters(**lanes, depths=np.zeros((0, LANES)), tension=np.zeros(LANES, bool))


def reference(name, **values):
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    run = jax.jit(LAWS[name].reference, compiler_options=QUICK)
    return run(contact(**values), mass, velocity)


def test_undamped_hardening():
    """e = 1; k d^2/2 + k d^4/(4 d_0^2) = M v^2/2 where the force is largest; a soft spring stays linear."""
    unit = np.array([1e-5, 5e-5, 1e-4, 2e-4, 1e-3, 10.0])
    found = reference("hardening", reference_depth=unit)
    square = np.sqrt(1 + 2 * MASS * VELOCITY**2 / (STIFFNESS * unit**2)) - 1
    np.testing.assert_allclose(found.restitution, 1.0, rtol=0, atol=1e-8)
    # Of a spring that hardly stiffens the square is rounded.
    peak = STIFFNESS * unit * np.sqrt(square) * (1 + square)
    np.testing.assert_allclose(found.peak_force[:-1], peak[:-1], rtol=1e-8)
    np.testing.assert_allclose(found.peak_force[-1], VELOCITY * np.sqrt(STIFFNESS * MASS), rtol=1e-8)
    np.testing.assert_allclose(found.duration[-1], np.pi * np.sqrt(MASS / STIFFNESS), rtol=1e-8)


@pytest.mark.parametrize("name", [name for name in LAWS if name != "piecewise_linear"])
def test_one_surface_is_the_nearer_of_two_that_are_infinitely_apart(name):
    law, parameters = LAWS[name], contact(damping=260.0, preload=3.0, friction=2.0)
    position, velocity = np.array([-1e-3, -0.0, 1e-5, 2e-4, 2e-4, np.nan]), np.array([1, -1, 2, -3, 0, 1e-3])
    state = law.init(jnp.asarray(position))
    one, two = (
        two_sided(law, parameters, state, jnp.asarray(position), jnp.asarray(velocity), clearance)
        for clearance in (None, jnp.full(LANES, jnp.inf))
    )
    jax.tree.map(np.testing.assert_array_equal, one, two)
    assert one[0][2] > 0


@pytest.mark.parametrize("exponent, damping", [(1.5, 0.0), (2.2, 0.0), (1.0, 600.0)])
def test_depth_damped_that_is_hunt_and_crossley_s(exponent, damping):
    stiffness = 1e7 if exponent > 1 else STIFFNESS
    found = reference("depth_damped", stiffness=stiffness, exponent=exponent, damping=damping)
    parameters = MASS, stiffness, exponent, damping / (1.5 * 2e-4 * stiffness), VELOCITY
    expected = jax.jit(hunt_crossley, compiler_options=QUICK)(*(np.full(LANES, one) for one in parameters))
    for got, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-8)


def test_elastoplastic_in_closed_form_and_integrated():
    ratio = np.array([1.0, 1.1, 1.5, 2.0, 4.0, 25.0])
    found = reference("elastoplastic", unloading_ratio=ratio)
    np.testing.assert_allclose(found.restitution, ratio**-0.5, rtol=1e-15)
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    law = LAWS["elastoplastic"]
    run = jax.jit(partial(integrate_contact, law), compiler_options=QUICK)
    for got, wanted in zip(run(contact(unloading_ratio=ratio), mass, velocity)[:3], found, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-8)


# Preload and friction [N]: a spring alone, either, both, and more friction than preload.
PRELOADS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 6.0], [10.0, 6.0], [3.0, 6.0], [200.0, 1.0]]).T


def test_preloaded_in_closed_form_and_integrated():
    """The energy: M v^2/2 = k d^2/2 + (F_0 + F_r) d in, k d^2/2 + (F_0 - F_r) d out, but for what is left in
    the spring where friction holds the mechanism back."""
    preload, friction = PRELOADS
    found = reference("preloaded", preload=preload, friction=friction)
    energy, inward = MASS * VELOCITY**2 / 2, preload + friction
    deepest = 2 * energy / (inward + np.sqrt(inward**2 + 2 * STIFFNESS * energy))
    left = np.maximum(friction - preload, 0) ** 2 / (2 * STIFFNESS)
    out = STIFFNESS * deepest**2 / 2 + (preload - friction) * deepest + left
    np.testing.assert_allclose(found.restitution, np.sqrt(out / energy), rtol=1e-12)
    np.testing.assert_allclose(found.peak_force, inward + STIFFNESS * deepest, rtol=1e-12)
    np.testing.assert_allclose(found.duration[0], np.pi * np.sqrt(MASS / STIFFNESS), rtol=1e-12)
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    law = LAWS["preloaded"]
    run = jax.jit(partial(integrate_contact, law), compiler_options=QUICK)
    integrated = run(contact(preload=preload, friction=friction), mass, velocity)[:3]
    for got, wanted in zip(integrated, found, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-7)
    stuck = reference("preloaded", preload=0.0, friction=1e4)
    assert np.all(stuck.restitution == 0) and np.all(np.isinf(stuck.duration))


def test_elastoplastic_loads_unloads_reloads_and_forgets():
    law, parameters = LAWS["elastoplastic"], contact(unloading_ratio=2.0)
    state, forces = law.init(jnp.zeros(LANES)), []
    depths = np.array([1.0, 3.0, 2.0, 1.6, 1.0, 2.5, 4.0, 3.0, 0.0, 1.0])
    for depth in depths:
        force, state = law.step(parameters, state, jnp.full((LANES,), depth), jnp.zeros(LANES))
        forces.append(force[0] / STIFFNESS)
    np.testing.assert_allclose(forces, [1, 3, 1, 0.2, 0, 2, 4, 2, 0, 1], rtol=0, atol=1e-12)


def test_derivatives_of_integrated_references():
    """By stiffness, damping and velocity, against differences."""
    values = {"damping": np.linspace(50.0, 900.0, LANES)}

    for name in ("hardening", "depth_damped"):
        law = LAWS[name]
        parameters = contact(**values, stiffness=1e7 if name == "depth_damped" else STIFFNESS)

        def function(scales, parameters, law=law):
            changed = parameters._replace(
                stiffness=parameters.stiffness * (1 + scales[0]), damping=parameters.damping * (1 + scales[1])
            )
            velocity = jnp.full((LANES,), VELOCITY) * (1 + scales[2])
            found = law.reference(changed, jnp.full((LANES,), MASS), velocity)
            return jnp.stack(found)

        both = jax.jit(
            lambda *given, function=function: (function(*given), jax.jacfwd(function)(*given)),
            compiler_options=QUICK,
        )
        value, derivative = both(np.zeros(3), parameters)
        for index in range(3):
            step = np.zeros(3)
            step[index] = 1e-3
            up, down = (both(sign * step, parameters)[0] for sign in (1, -1))
            error = np.abs((up - down) / 2e-3 - derivative[..., index]) / value
            assert error.max() < 1e-5


# Restitution and peak force for T -> 0, and the order of convergence.
LAWS_ALONE = {
    "hardening": {"law": "hardening", "stiffness": [STIFFNESS], "reference_depth": 2e-4},
    "damped hardening": {
        "law": "hardening", "stiffness": [STIFFNESS], "reference_depth": 2e-4, "damping": [500.0]
    },
    "depth-damped": {
        "law": "depth_damped", "stiffness": [1e7], "reference_depth": 2e-4, "damping": [900.0]
    },
    "elastoplastic": {"law": "elastoplastic", "stiffness": [STIFFNESS], "unloading_ratio": 1.6},
    "preloaded": {"law": "preloaded", "stiffness": [STIFFNESS], "preload": 5.0, "friction": 2.0},
}  # fmt: skip


def limit(name):
    values = LAWS_ALONE[name]
    (stiffness,), (damping,) = values["stiffness"], values.get("damping", [0.0])
    unit = values.get("reference_depth", 1.0)
    if name == "elastoplastic":
        return 1.6**-0.5, VELOCITY * np.sqrt(stiffness * MASS)
    if name == "preloaded":
        found = reference(name, stiffness=stiffness, preload=5.0, friction=2.0)
        return float(found.restitution[0]), float(found.peak_force[0])
    laws = {
        "hardening": lambda d, r: stiffness * d * (1 + (d / unit) ** 2) + damping * r,
        "depth_damped": lambda d, r: stiffness * max(d, 0.0) ** 1.5 + damping * r * d / unit,
    }
    return continuous.contact(MASS, VELOCITY, laws[values["law"]])


@pytest.mark.parametrize("name, order", list(zip(LAWS_ALONE, [2, 1, 1, 2, 1], strict=True)))
def test_contact_without_delay_converges_to_the_reference(name, order):
    """Restitution to that of SciPy's or the closed form, which is also the law's own; W_out/W_in to e^2."""
    expected, expected_peak = limit(name)
    parsed = validated(mechanism(LAWS_ALONE[name], IDEAL, 0.0))
    period, phase = grid(PERIODS, (np.arange(16) + 0.5) / 16)
    found = first_contact(
        parsed, spread(parsed, len(period), control_period=period, phase=phase), energies=True
    )
    restitution = found["restitution"].reshape(len(PERIODS), -1)
    error = np.sqrt(np.mean((restitution - expected) ** 2, axis=1))
    assert np.polyfit(np.log(PERIODS), np.log(error), 1)[0] > order - 0.3
    assert error[-1] < (1e-4 if order == 2 else 1e-3)
    assert found["peak_force"][-16:] == pytest.approx(expected_peak, rel=1e-3)
    balance = found["work_out"] / found["work_in"] - found["restitution"] ** 2
    assert np.abs(balance[-16:]).max() < (5e-4 if order == 2 else 2e-3)
    values = {key: np.squeeze(value) for key, value in LAWS_ALONE[name].items() if key != "law"}
    own = reference(parsed.contact.law, **values)
    np.testing.assert_allclose(own.restitution, expected, rtol=0, atol=2e-8)
    # SciPy's is the largest of samples a millisecond apart.
    np.testing.assert_allclose(own.peak_force, expected_peak, rtol=2e-4)
