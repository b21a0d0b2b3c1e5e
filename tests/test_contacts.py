"""Contact laws with integrated ideal contact or with memory: closed forms, SciPy, work, derivatives."""

from functools import partial

import continuous
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import IDEAL, MASS, QUICK, VELOCITY, first_contact, grid, mechanism, spread, validated

from jaxhil.contact.ideal_contact import ideal_hunt_crossley
from jaxhil.contact.ideal_contact_motion import integrate_contact
from jaxhil.contact.laws import CONTACT_LAWS, ContactParameters, compute_two_sided_force

STIFFNESS, LANES = 124355.0, 6
PERIODS = np.array([4e-3, 2e-3, 1e-3, 5e-4])


def contact(**values):
    """Return the parameters of every lane by name; unspecified parameters are nominal."""
    numbers = {"stiffness": STIFFNESS, "damping": 0.0, "exponent": 1.5}
    numbers |= {"reference_depth": 2e-4, "unloading_ratio": 1.0, "preload": 0.0, "friction": 0.0}
    lanes = {
        name: np.broadcast_to(np.asarray(values.get(name, n), float), LANES) for name, n in numbers.items()
    }
    return ContactParameters(**lanes, depths=np.zeros((0, LANES)), tension=np.zeros(LANES, bool))


def reference(name, **values):
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    run = jax.jit(CONTACT_LAWS[name].ideal_contact, compiler_options=QUICK)
    return run(contact(**values), mass, velocity)


def test_undamped_hardening_contact_matches_closed_form():
    """Expect e = 1, and k d^2/2 + k d^4/(4 d_0^2) = M v^2/2 at the peak force."""
    unit = np.array([1e-5, 5e-5, 1e-4, 2e-4, 1e-3, 10.0])
    result = reference("hardening", reference_depth=unit)
    square = np.sqrt(1 + 2 * MASS * VELOCITY**2 / (STIFFNESS * unit**2)) - 1
    np.testing.assert_allclose(result.restitution, 1.0, rtol=0, atol=1e-8)
    # For a spring that hardly stiffens, d^4 is dominated by rounding.
    peak = STIFFNESS * unit * np.sqrt(square) * (1 + square)
    np.testing.assert_allclose(result.peak_force[:-1], peak[:-1], rtol=1e-8)
    np.testing.assert_allclose(result.peak_force[-1], VELOCITY * np.sqrt(STIFFNESS * MASS), rtol=1e-8)
    np.testing.assert_allclose(result.duration[-1], np.pi * np.sqrt(MASS / STIFFNESS), rtol=1e-8)


@pytest.mark.parametrize("name", [name for name in CONTACT_LAWS if name != "piecewise_linear"])
def test_contact_with_single_surface_equals_two_surfaces_infinitely_apart(name):
    law, parameters = CONTACT_LAWS[name], contact(damping=260.0, preload=3.0, friction=2.0)
    position, velocity = np.array([-1e-3, -0.0, 1e-5, 2e-4, 2e-4, np.nan]), np.array([1, -1, 2, -3, 0, 1e-3])
    state = law.init(jnp.asarray(position))
    single, double = (
        compute_two_sided_force(
            law, parameters, state, jnp.asarray(position), jnp.asarray(velocity), clearance
        )
        for clearance in (None, jnp.full(LANES, jnp.inf))
    )
    jax.tree.map(np.testing.assert_array_equal, single, double)
    assert single[0][2] > 0


@pytest.mark.parametrize("exponent, damping", [(1.5, 0.0), (2.2, 0.0), (1.0, 600.0)])
def test_depth_damped_contact_equals_hunt_crossley_for_equal_parameters(exponent, damping):
    stiffness = 1e7 if exponent > 1 else STIFFNESS
    result = reference("depth_damped", stiffness=stiffness, exponent=exponent, damping=damping)
    parameters = MASS, stiffness, exponent, damping / (1.5 * 2e-4 * stiffness), VELOCITY
    expected = jax.jit(ideal_hunt_crossley, compiler_options=QUICK)(
        *(np.full(LANES, value) for value in parameters)
    )
    for got, wanted in zip(result, expected, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-8)


def test_elastoplastic_contact_closed_form_matches_integration():
    ratio = np.array([1.0, 1.1, 1.5, 2.0, 4.0, 25.0])
    result = reference("elastoplastic", unloading_ratio=ratio)
    np.testing.assert_allclose(result.restitution, ratio**-0.5, rtol=1e-15)
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    law = CONTACT_LAWS["elastoplastic"]
    run = jax.jit(partial(integrate_contact, law), compiler_options=QUICK)
    for got, wanted in zip(run(contact(unloading_ratio=ratio), mass, velocity)[:3], result, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-8)


# Preload and friction [N]: neither, only one of them, both, and more friction than preload.
PRELOADS = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 6.0], [10.0, 6.0], [3.0, 6.0], [200.0, 1.0]]).T


def test_preloaded_contact_closed_form_matches_integration():
    """Energy balance: M v^2/2 = k d^2/2 + (F_0 + F_r) d inwards, k d^2/2 + (F_0 - F_r) d outwards."""
    preload, friction = PRELOADS
    result = reference("preloaded", preload=preload, friction=friction)
    energy, inward = MASS * VELOCITY**2 / 2, preload + friction
    deepest = 2 * energy / (inward + np.sqrt(inward**2 + 2 * STIFFNESS * energy))
    stored_energy = np.maximum(friction - preload, 0) ** 2 / (2 * STIFFNESS)
    out = STIFFNESS * deepest**2 / 2 + (preload - friction) * deepest + stored_energy
    np.testing.assert_allclose(result.restitution, np.sqrt(out / energy), rtol=1e-12)
    np.testing.assert_allclose(result.peak_force, inward + STIFFNESS * deepest, rtol=1e-12)
    np.testing.assert_allclose(result.duration[0], np.pi * np.sqrt(MASS / STIFFNESS), rtol=1e-12)
    mass, velocity = (np.full(LANES, value) for value in (MASS, VELOCITY))
    law = CONTACT_LAWS["preloaded"]
    run = jax.jit(partial(integrate_contact, law), compiler_options=QUICK)
    integrated = run(contact(preload=preload, friction=friction), mass, velocity)[:3]
    for got, wanted in zip(integrated, result, strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-7)
    stuck = reference("preloaded", preload=0.0, friction=1e4)
    assert np.all(stuck.restitution == 0) and np.all(np.isinf(stuck.duration))


def test_elastoplastic_contact_loads_unloads_reloads_and_resets():
    law, parameters = CONTACT_LAWS["elastoplastic"], contact(unloading_ratio=2.0)
    state, forces = law.init(jnp.zeros(LANES)), []
    depths = np.array([1.0, 3.0, 2.0, 1.6, 1.0, 2.5, 4.0, 3.0, 0.0, 1.0])
    for depth in depths:
        force, state = law.step(parameters, state, jnp.full((LANES,), depth), jnp.zeros(LANES))
        forces.append(force[0] / STIFFNESS)
    np.testing.assert_allclose(forces, [1, 3, 1, 0.2, 0, 2, 4, 2, 0, 1], rtol=0, atol=1e-12)


def test_integrated_ideal_contact_derivatives_match_finite_differences():
    values = {"damping": np.linspace(50.0, 900.0, LANES)}

    for name in ("hardening", "depth_damped"):
        law = CONTACT_LAWS[name]
        parameters = contact(**values, stiffness=1e7 if name == "depth_damped" else STIFFNESS)

        def function(scales, parameters, law=law):
            changed = parameters._replace(
                stiffness=parameters.stiffness * (1 + scales[0]), damping=parameters.damping * (1 + scales[1])
            )
            velocity = jnp.full((LANES,), VELOCITY) * (1 + scales[2])
            result = law.ideal_contact(changed, jnp.full((LANES,), MASS), velocity)
            return jnp.stack(result)

        both = jax.jit(
            lambda *arguments, function=function: (function(*arguments), jax.jacfwd(function)(*arguments)),
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
        result = reference(name, stiffness=stiffness, preload=5.0, friction=2.0)
        return float(result.restitution[0]), float(result.peak_force[0])
    laws = {
        "hardening": lambda d, r: stiffness * d * (1 + (d / unit) ** 2) + damping * r,
        "depth_damped": lambda d, r: stiffness * max(d, 0.0) ** 1.5 + damping * r * d / unit,
    }
    return continuous.contact(MASS, VELOCITY, laws[values["law"]])


@pytest.mark.parametrize("name, order", list(zip(LAWS_ALONE, [2, 1, 1, 2, 1], strict=True)))
def test_undelayed_contact_converges_to_ideal_contact(name, order):
    expected, expected_peak = limit(name)
    parsed = validated(mechanism(LAWS_ALONE[name], IDEAL, 0.0))
    period, phase = grid(PERIODS, (np.arange(16) + 0.5) / 16)
    result = first_contact(
        parsed, spread(parsed, len(period), control_period=period, phase=phase), energies=True
    )
    restitution = result["restitution"].reshape(len(PERIODS), -1)
    error = np.sqrt(np.mean((restitution - expected) ** 2, axis=1))
    assert np.polyfit(np.log(PERIODS), np.log(error), 1)[0] > order - 0.3
    assert error[-1] < (1e-4 if order == 2 else 1e-3)
    assert result["peak_force"][-16:] == pytest.approx(expected_peak, rel=1e-3)
    balance = result["work_out"] / result["work_in"] - result["restitution"] ** 2
    assert np.abs(balance[-16:]).max() < (5e-4 if order == 2 else 2e-3)
    values = {key: np.squeeze(value) for key, value in LAWS_ALONE[name].items() if key != "law"}
    reference_of_law = reference(parsed.contact.law, **values)
    np.testing.assert_allclose(reference_of_law.restitution, expected, rtol=0, atol=2e-8)
    # SciPy's peak is the largest of samples a millisecond apart.
    np.testing.assert_allclose(reference_of_law.peak_force, expected_peak, rtol=2e-4)
