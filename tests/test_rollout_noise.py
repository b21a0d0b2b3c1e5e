"""Sensor noise in rollouts: independent of the batch, white, and equal to noise of the oracle."""

import cases
import jax
import numpy as np
import pytest
from cases import Case
from lanes import (
    QUICK,
    STIFFNESS,
    as_arrays,
    join,
    mechanism,
    nominal_gains,
    run_record,
    run_rollout,
    validated,
)

from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.scenario import build_scenarios
from jaxhil.simulation.sensors import draw_noise

NOISY = mechanism(
    {"law": "linear", "stiffness": [STIFFNESS, 2 * STIFFNESS]},
    {"model": "ideal"},
    0.004,
    2,
    force_sensor={"noise_std": 2.0, "bias": 0.7},
    position_sensor={"noise_std": 1e-6},
)
NOISY_GAINS = {"contact_threshold": 8.0}


def noisy_batch(number, first=0, seed=5):
    parsed = validated(NOISY)
    draws = {"approach.phase": np.linspace(0, 1, 9)[first : first + number, None]}
    scenario = join([build_scenarios(parsed, draws, seed=seed, first=first)])
    gains = nominal_gains(parsed, "response_error", **NOISY_GAINS)
    return build_loop(parsed, "response_error", scenario), as_arrays(gains), scenario


@pytest.fixture(scope="module")
def noisy_run():
    return jax.tree.map(np.asarray, run_rollout(*noisy_batch(6)))


@pytest.fixture(scope="module")
def noise():
    """Return the noise added to force [N] and position [m], each (contacts, ticks, lanes)."""
    scenario = noisy_batch(6)[2]
    age = np.broadcast_to(np.arange(400)[:, None], (400, 6))
    contact_pairs = jax.jit(draw_noise, static_argnums=(0, 1), compiler_options=QUICK)
    drawn = [contact_pairs(True, True, scenario, np.full(6, contact), age)[:2] for contact in range(2)]
    return tuple(np.stack(values) for values in zip(*drawn, strict=True))


def test_sensor_noise_of_a_scenario_does_not_depend_on_its_batch(noisy_run):
    together = noisy_run
    assert len(set(together.restitution[0])) == 6 and np.all(together.status[0] == OK)
    shifted = jax.tree.map(np.asarray, run_rollout(*noisy_batch(6, first=3)))
    for result, expected in zip(shifted, together, strict=True):
        np.testing.assert_array_equal(result[:, :3], expected[:, 3:])
    again = jax.tree.map(np.asarray, run_rollout(*noisy_batch(6)))
    np.testing.assert_array_equal(again.restitution, together.restitution)
    other = jax.tree.map(np.asarray, run_rollout(*noisy_batch(6, seed=6)))
    assert np.all(np.abs(other.restitution[0] - together.restitution[0]) > 1e-6)


def test_sensor_noise_is_white(noise):
    for values, deviation in zip(noise, (2.0, 1e-6), strict=True):
        count = values.size
        assert values.std() == pytest.approx(deviation, rel=4 / np.sqrt(2 * count))
        scaled = values / deviation
        neighbours = (
            scaled[:, 1:] * scaled[:, :-1],
            scaled[..., 1:] * scaled[..., :-1],
            scaled[1] * scaled[0],
        )
        for product in (scaled, *neighbours):
            assert abs(product.mean()) < 4 / np.sqrt(product.size)
    assert abs(np.mean(noise[0] * noise[1]) / 2e-6) < 4 / np.sqrt(count)


def test_sensor_noise_of_a_contact_does_not_depend_on_previous_contact_duration(noise):
    loop, gains, scenario = noisy_batch(6)
    begins = []
    for softer in (1.0, 0.5):
        contact = scenario.contact._replace(stiffness=softer * scenario.contact.stiffness)
        _, seen = run_record(loop, gains, scenario._replace(contact=contact), 480)
        age, contact = np.asarray(seen.signals.age), np.asarray(seen.contact)
        # The approach takes 20 ms.
        tick, lane = np.nonzero((contact == 1) & (age < 10))
        read = np.asarray(seen.signals.force_measured)[tick, lane] - 0.7
        np.testing.assert_allclose(read, noise[0][1, age[tick, lane], lane], rtol=0, atol=1e-13)
        begins.append(np.argmax(contact == 1, axis=0))
    assert np.all(begins[0] > 0) and np.all(begins[0] != begins[1])


@pytest.mark.parametrize("lane", [0, 3])
def test_rollout_of_noisy_contacts_agrees_with_oracle(noisy_run, noise, lane):
    phase = np.linspace(0, 1, 9)[lane]
    case = Case({**NOISY, "approach": {**NOISY["approach"], "phase": phase}}, "response_error", NOISY_GAINS)
    force, position = (list(values[..., lane]) for values in noise)
    contacts = cases.run_oracle(case, force_noise=force, position_noise=position)
    assert len(contacts) == 2
    for number, expected in enumerate(contacts):
        assert expected["status"] == "over" and expected["end_tick"] < 400
        assert noisy_run.restitution[number, lane] == pytest.approx(expected["restitution"], abs=1e-11)
        assert noisy_run.approach_velocity[number, lane] == pytest.approx(
            expected["approach_velocity"], rel=1e-11
        )
