"""Jitter, lost frames and missed ticks, compared with the oracle for the same sequence of effects."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, run_oracle
from lanes import IDEAL, PERIOD, SECOND_ORDER, STIFFNESS, mechanism, nominal_gains, validated

import jaxhil
import tuning
from jaxhil import InputError
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.plausibility import check_run
from jaxhil.simulation.scenario import build_scenarios
from jaxhil.simulation.timing import draw_timing
from tuning.bundle.fmu.rig import rig_fmu
from tuning.rig.plant import RigHardware
from tuning.rig.rig_task import build_simulated_rig
from tuning.transparency.probes import build_probed_scenarios

LIST = {"stiffness": [STIFFNESS, 0.5 * STIFFNESS], "damping": [500.0, 100.0]}
AVERAGE = {"model": "moving_average", "window": 0.0144, "delay": 0.0021}
FIRST_ORDER = {"model": "first_order", "time_constant": 0.009, "delay": 0.0013}
JITTER, LOSS = {"jitter": 0.0037}, {"loss_probability": 0.1}
MISSED: dict[str, Any] = {"missed_tick_probability": 0.05}


def case(
    law="phase_lead", simulator=SECOND_ORDER, delay=0.0041, contacts=1, sensor=None, contact=LIST, **rig
):
    return Case(mechanism(contact, simulator, delay, contacts, force_sensor=sensor, **rig), law)


CASES = {
    "jitter": case(sensor=JITTER),
    "jitter, zoh, latency": case(sensor=JITTER, command_hold="zoh", command_latency=1),
    "jitter, ideal": case("phase_lead", IDEAL, sensor=JITTER),
    "jitter, moving average": case("phase_lead", AVERAGE, sensor=JITTER),
    "jitter, first order": case("none", FIRST_ORDER, 0.0041, 2, sensor=JITTER),
    "lost frames": case(sensor={**LOSS, "time_constant": 0.0023}),
    "lost frames, two surfaces": case(sensor=LOSS, contact={**LIST, "clearance": 0.004}),
    "missed ticks": case(**MISSED),
    "missed ticks, response error": case("response_error", **MISSED),
    "missed ticks before contact": case("response_error", delay=0.0401, missed_tick_probability=0.5),
    "all": case("response_error", sensor={**JITTER, **LOSS}, **MISSED),
}


def effects(parsed, contact=0, seed=0, ticks=4000):
    """Return jitter [s], lost ticks and missed ticks of a contact."""
    scenario = jax.tree.map(jnp.asarray, build_scenarios(parsed, seed=seed))
    age = jnp.arange(ticks, dtype=jnp.int32)[:, None]
    draws = draw_timing(scenario.timing, scenario.key, jnp.array([contact], jnp.int32), age)
    assert draws is not None
    sets = [set() if kind is None else set(np.flatnonzero(kind).tolist()) for kind in draws[1:]]
    jitter = None if draws.jitter is None else np.asarray(draws.jitter)[:, 0]
    return {"jitter": jitter, "lost": sets[0], "missed": sets[1]}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_contact_with_timing_effects_agrees_with_oracle(name):
    made = CASES[name]
    parsed = validated({**made.mechanism, "approach": {**made.mechanism["approach"], "contacts": 1}})
    gains = dict(nominal_gains(parsed, made.compensator))
    (expected,) = run_oracle(made, contacts=1, **effects(parsed))
    (without,) = run_oracle(made, contacts=1)
    run = jaxhil.simulate(parsed, made.compensator, gains=gains)
    [contact] = run.contacts
    assert contact.restitution == pytest.approx(expected["restitution"], abs=1e-8)
    assert contact.peak_force == pytest.approx(expected["peak_force"], rel=1e-8)
    assert abs(expected["restitution"] - without["restitution"]) > 1e-4


@pytest.mark.parametrize("name", [name for name in CASES if "jitter" in name])
def test_rehearsal_without_jitter_reads_the_same_force_as_with_tiny_jitter(name):
    """A jitter of 1 ns uses the other method, so that both methods are compared."""
    document = to_plain_data(validated(CASES[name].mechanism))
    document["rig"]["force_sensor"]["jitter"] = 1e-9
    late = RigHardware(from_plain_data(document, "case"))
    document["rig"]["force_sensor"]["jitter"] = 0.0
    exact = RigHardware(from_plain_data(document, "case"))
    start, velocity, largest = -1e-5, 0.005, 0.0
    for plant in (late, exact):
        plant.begin(start, velocity, start - PERIOD * velocity, 0)
    for tick in range(100):
        force = exact.read()[0]
        assert late.read()[0] == pytest.approx(force, abs=1e-3)
        command = start + 2e-4 * np.sin(15.0 * tick * PERIOD)
        for plant in (late, exact):
            plant.move(command)
        largest = max(largest, force)
    assert largest > 10.0


def test_rehearsal_loses_stated_share_of_readings_and_repeats_the_last():
    plant = RigHardware(validated(mechanism({}, force_sensor={"loss_probability": 0.3, "noise_std": 1.0})))
    plant.begin(-1.0, 0.0, -1.0, 0)
    readings = []
    for _ in range(4000):
        readings.append(plant.read()[0])
        plant.move(-1.0)
    assert np.mean(np.diff(readings) == 0.0) == pytest.approx(0.3, abs=5 * (0.21 / 4000) ** 0.5)


def test_drawn_timing_effects_have_stated_distribution_and_no_effect_at_first_tick():
    parsed = validated(CASES["all"].mechanism)
    draws = effects(parsed)
    jitter = draws["jitter"]
    assert abs(jitter).max() < 0.0037 and np.std(jitter) == pytest.approx(0.0037 / 3**0.5, rel=0.05)
    assert len(draws["lost"]) / 4000 == pytest.approx(0.1, abs=0.02)
    assert len(draws["missed"]) / 4000 == pytest.approx(0.05, abs=0.02)
    assert not {0} & (draws["lost"] | draws["missed"])
    other = effects(parsed, contact=1)
    assert abs(np.corrcoef(jitter, other["jitter"])[0, 1]) < 0.1 and other["lost"] != draws["lost"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensor": {"jitter": 0.005}}, "jitter: found 0.005, expected at most 0.0041 s, the smallest"),
        (
            {"sensor": {**JITTER, "time_constant": 0.001}},
            "jitter: found 0.0037, expected 0, because jitter is not supported with a time_",
        ),
        (
            {"sensor": JITTER, "contact": {**LIST, "clearance": 0.01}},
            "expected 0, because jitter is not supported with a clearance",
        ),
        (
            {"contact": {**LIST, "clearance": 0.01}, **MISSED},
            "missed_tick_probability: found 0.05, expected 0",
        ),
        ({"sensor": {"loss_probability": 1.0}}, "loss_probability: found 1.0, expected a number"),
    ],
)
def test_mechanism_file_rejects_unsupported_timing_effect(change, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        from_plain_data(case(**change).mechanism, "case")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["rig.force_sensor.jitter", "rig.missed_tick_probability"])
def test_message_about_an_uncertain_timing_effect_states_its_largest_value(key):
    raw = case(contact={**LIST, "clearance": 0.01}).mechanism
    uncertain = {key: {"distribution": "uniform", "low": 0.0, "high": 0.001}}
    with pytest.raises(InputError, match=re.escape(f"{key}: found 0.001, expected 0, because")):
        from_plain_data(raw | {"uncertainty": uncertain}, "case")


def test_jitter_of_fast_motion_simulator_is_rejected_in_one_line():
    fast = {"model": "first_order", "time_constant": 0.001}
    with pytest.raises(InputError, match=re.escape("at most 1 / control_period for rig.force_sensor.jitter")):
        check_run(validated(case("none", fast, sensor=JITTER).mechanism))


def test_rehearsal_and_rig_fmu_reject_missed_ticks_in_one_line():
    parsed = validated(CASES["missed ticks"].mechanism)
    with pytest.raises(InputError, match=r"found 0[.]05, expected 0 for a rehearsal"):
        build_simulated_rig(parsed)
    with pytest.raises(InputError, match=r"found 0[.]05, expected 0"):
        rig_fmu({"mechanism": to_plain_data(parsed)}, 3)


@pytest.mark.slow
def test_sweep_with_timing_effects_equals_single_runs_and_states_that_the_rig_is_unsafe():
    document = to_plain_data(validated(case("none", sensor={**JITTER, **LOSS}, **MISSED).mechanism))
    document["approach"]["contacts"] = 1
    document["uncertainty"] = {
        "rig.missed_tick_probability": {"distribution": "uniform", "low": 0, "high": 0.5}
    }
    result = tuning.tune(from_plain_data(document, "case"), "phase_lead", scenarios=8, starts=2, seed=0)
    study = tuning.sweep(result, scenarios=32, limit=0.01)
    assert study.failure_probability > 0.5
    errors = np.array(study.table["error_1"])
    probability = np.array(study.table["rig.missed_tick_probability"])
    assert np.std(errors[probability > 0.25]) > np.std(errors[probability < 0.25])
    again = tuning.sweep(result, scenarios=32, limit=0.01)
    assert again.table.equals(study.table)


@pytest.mark.slow
def test_gains_of_rig_with_timing_effects_are_verified():
    parsed = validated(case("response_error", sensor={**JITTER, **LOSS}, **MISSED).mechanism)
    result = tuning.tune(parsed, "phase_lead", scenarios=4, starts=1, validation=4)
    assert tuning.verify(result).good


@pytest.mark.slow
def test_reading_with_jitter_contains_the_push_of_a_probe():
    """Without the push, a compensator would seem to ignore it."""
    errors = []
    for sensor in ({}, {"jitter": 1e-12}):
        uncertainty = {"contact.stiffness": {"distribution": "loguniform", "factor": [0.5, 2.0]}}
        parsed = validated({**case(sensor=sensor).mechanism, "uncertainty": uncertainty})
        scenarios = build_probed_scenarios(parsed, draw(parsed, 4, 0)).scenarios
        errors.append(np.asarray(evaluate(build_loop(parsed, "none", scenarios), {}, scenarios).error[0]))
    np.testing.assert_allclose(errors[1], errors[0], rtol=0, atol=1e-9)
