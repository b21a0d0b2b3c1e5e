"""Random walk of the force sensor's bias, compared with independent rigs for the same sequence."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, run_oracle
from lanes import (
    IDEAL,
    PERIOD,
    QUICK,
    SECOND_ORDER,
    STIFFNESS,
    mechanism,
    nominal_gains,
    validated,
)
from rig_lock_step import closed_loop

import jaxhil
import tuning
from jaxhil import InputError
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios
from jaxhil.simulation.sensors import draw_bias_steps
from tuning.rig.plant import RigHardware

KEY, STRENGTH = "rig.force_sensor.bias_random_walk", 3.0
bias_steps = jax.jit(draw_bias_steps, compiler_options=QUICK)
LIST = {"stiffness": [STIFFNESS, 0.5 * STIFFNESS], "damping": [500.0, 100.0]}
NOISELESS = {"bias_random_walk": STRENGTH}


def case(law="phase_lead", simulator=SECOND_ORDER, contacts=1, contact=LIST, **sensor):
    return Case(mechanism(contact, simulator, 0.0041, contacts, force_sensor=NOISELESS | sensor), law)


CASES = {
    "none": case("none", IDEAL),
    "phase lead": case(),
    "response error": case("response_error"),
    "impulse ledger": case("impulse_ledger"),
    "lag and quantum": case(time_constant=0.0023, quantum=0.1, bias=-0.3),
    "dead zone": case(dead_zone=1.0, range=12.0),
    "two surfaces": case(contact={**LIST, "clearance": 0.004}),
    "two contacts": case("none", contacts=2),
}


def drawn_walk(parsed, contact=0, ticks=4000, first=0, number=1):
    """Return the change of the bias [N] at each tick of a contact, (ticks, scenarios)."""
    draws = {"approach.phase": np.full((number, 1), 1 / 3)}
    scenario = build_scenarios(parsed, draws, first=first)
    age = np.broadcast_to(np.arange(ticks, dtype=np.int32)[:, None], (ticks, number))
    index = np.full(number, contact, np.int32)
    walk, period = scenario.force_sensor.bias_walk, scenario.control_period
    return np.cumsum(bias_steps(walk, period, scenario.key, index, age), axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_contact_with_bias_walk_agrees_with_oracle(name):
    made = CASES[name]
    parsed, contacts = validated(made.mechanism), made.mechanism["approach"]["contacts"]
    walks = [drawn_walk(parsed, contact)[:, 0] for contact in range(contacts)]
    expected = run_oracle(made, contacts=contacts, force_noise=walks)
    (without, *_) = run_oracle(made, contacts=contacts)
    run = jaxhil.simulate(parsed, made.compensator, gains=nominal_gains(parsed, made.compensator))
    for contact, other in zip(run.contacts, expected, strict=True):
        assert contact.restitution == pytest.approx(other["restitution"], abs=1e-8)
        assert contact.peak_force == pytest.approx(other["peak_force"], rel=1e-8)
    assert abs(expected[0]["restitution"] - without["restitution"]) > 1e-4


def test_variance_of_bias_walk_grows_in_proportion_to_time():
    walk = drawn_walk(validated(CASES["none"].mechanism), ticks=201, number=500)
    assert np.all(walk[0] == 0.0)
    for ticks in (1, 100, 200):
        expected = STRENGTH**2 * ticks * PERIOD
        assert np.var(walk[ticks]) == pytest.approx(expected, rel=5 * (2 / 500) ** 0.5)
    steps = np.diff(walk, axis=0)
    for product in (steps, steps[1:] * steps[:-1], steps[:, 1:] * steps[:, :-1]):
        assert abs(np.mean(product)) < 5 * np.std(product) / product.size**0.5


def test_rehearsal_has_bias_walk_of_simulation_in_each_contact_and_scenario():
    parsed = validated(CASES["two contacts"].mechanism)
    plant = RigHardware(parsed)
    for contact, scenario in ((0, 0), (1, 0), (0, 1)):
        plant.begin(-1.0, 0.0, -1.0, contact, scenario)
        readings = []
        for _ in range(50):
            # Reading twice at a tick does not change the bias.
            readings.append((plant.read()[0], plant.read()[0]))
            plant.move(-1.0)
        expected = drawn_walk(parsed, contact, 50, scenario)
        np.testing.assert_allclose(readings, np.repeat(expected, 2, axis=1), rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["phase lead", "impulse ledger", "two surfaces"])
def test_rehearsal_with_bias_walk_gives_restitution_of_simulate(name):
    made = CASES[name]
    parsed = validated(made.mechanism)
    gains = nominal_gains(parsed, made.compensator)
    [contact], _ = closed_loop(parsed, made.compensator, gains)
    run = jaxhil.simulate(parsed, made.compensator, gains=gains)
    assert contact.restitution == pytest.approx(run.contacts[0].restitution, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["none", "impulse ledger"])
def test_derivative_by_bias_walk_equals_central_difference(name):
    made = CASES[name]
    parsed = validated(made.mechanism)
    gains = jax.tree.map(jnp.asarray, nominal_gains(parsed, made.compensator))
    scenario = jax.tree.map(
        jnp.asarray, build_scenarios(parsed, {"approach.phase": np.linspace(0, 1, 32)[:, None]})
    )
    loop = build_loop(parsed, made.compensator, scenario)

    @jax.jit
    def restitution(walk):
        sensor = scenario.force_sensor._replace(bias_walk=walk + jnp.zeros(32))
        return rollout(loop, gains, scenario._replace(force_sensor=sensor)).restitution[0]

    slope = jax.jit(lambda walk: jax.jvp(restitution, (walk,), (1.0,))[1])(0.5)
    central = (restitution(0.5 + 1e-6) - restitution(0.5 - 1e-6)) / 2e-6
    agree = np.abs(slope - central) <= 1e-4 * np.max(np.abs(central))
    print(name, np.asarray(slope), np.asarray(slope - central))
    assert np.mean(agree) >= 0.95 and np.min(np.abs(slope)) > 0.0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("varying", -0.1, "bias_random_walk: found -0.1, expected a number >= 0 N/sqrt(s)"),
        ("varying", [1.0], "bias_random_walk: found [1.0], expected a number >= 0 N/sqrt(s)"),
        ("probe-drogue", -1.0, "expected a number >= 0 N/sqrt(s), N m/sqrt(s)"),
        ("probe-drogue", {"force": 1.0}, "expected"),
    ],
)
def test_mechanism_file_rejects_invalid_bias_walk_in_one_line(name, value, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_any(name, {KEY: value})
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_sweep_with_uncertain_bias_walk_repeats_its_scenarios_and_gains_are_verified():
    uncertain = {KEY: {"distribution": "uniform", "low": 0.0, "high": 5.0}}
    parsed = jaxhil.load("suite-noisy", {"uncertainty": uncertain})
    result = tuning.tune(parsed, "phase_lead", scenarios=8, starts=1, steps=2, validation=8)
    study = tuning.sweep(result, scenarios=64, limit=0.01)
    walk, error = np.array(study.table[KEY]), np.array(study.table["error_1"])
    assert np.std(error[walk > 2.5]) > np.std(error[walk < 2.5])
    assert tuning.sweep(result, scenarios=64, limit=0.01).table.equals(study.table)
    assert tuning.verify(result).good
