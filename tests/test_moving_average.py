"""Moving-average motion simulators, compared with the oracle and with finite differences."""

import re

import numpy as np
import pytest
from cases import Case, run_oracle
from lanes import PERIOD, STIFFNESS, mechanism, nominal_gains, validated
from rig_lock_step import closed_loop

import jaxhil
import tuning
from jaxhil import InputError
from jaxhil.mechanism.file import from_plain_data, to_plain_data
from tuning.bundle.fmu.rig import rig_fmu
from tuning.identification.unmodelled_effects import reject_unmodelled_effects
from tuning.rig.plant import RigHardware

AVERAGE = {"model": "moving_average", "window": 0.0344, "delay": 0.0021}
LIST = {"stiffness": [STIFFNESS, 0.5 * STIFFNESS], "damping": [500.0, 100.0]}
SHORT = {**AVERAGE, "window": 0.3 * PERIOD}
WHOLE = {"model": "moving_average", "window": 30 * PERIOD}
RATTLING = {"stiffness": [STIFFNESS], "damping": [900.0], "clearance": 0.004}
ELASTOPLASTIC = {"law": "elastoplastic", "stiffness": [STIFFNESS], "unloading_ratio": 1.6}
LAG = {"time_constant": 0.0023}
CASES = {
    "linear hold": Case(mechanism(LIST, AVERAGE, contacts=2), "phase_lead"),
    "zoh": Case(mechanism(LIST, AVERAGE, command_hold="zoh", command_latency=1), "phase_lead"),
    "whole periods": Case(mechanism(LIST, WHOLE, 2 * PERIOD)),
    "shorter than a period": Case(mechanism(LIST, SHORT, command_hold="zoh", force_sensor=LAG)),
    "lag": Case(mechanism(LIST, AVERAGE, force_sensor=LAG)),
    "response error": Case(mechanism(LIST, AVERAGE, contacts=2), "response_error"),
    "elastoplastic": Case(mechanism(ELASTOPLASTIC, AVERAGE), "phase_lead"),
    "two surfaces": Case(mechanism(RATTLING, AVERAGE, 0.003, 3, velocity=0.01), "phase_lead"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_moving_average_agrees_with_oracle_in_every_contact(name):
    case = CASES[name]
    parsed = validated(case.mechanism)
    run = jaxhil.simulate(parsed, case.compensator, gains=dict(nominal_gains(parsed, case.compensator)))
    expected = run_oracle(case)
    assert len(run.contacts) == len(expected) == parsed.approach.contacts
    for contact, oracle in zip(run.contacts, expected, strict=True):
        assert contact.restitution == pytest.approx(oracle["restitution"], abs=1e-8)
        assert contact.peak_force == pytest.approx(oracle["peak_force"], rel=1e-8)
        assert contact.duration == pytest.approx(oracle["duration"], abs=1e-8)


# The rehearsal uses a cubic for the motion in an interval, for a lag or a dent.
@pytest.mark.parametrize("name", [name for name in CASES if name != "shorter than a period"])
def test_moving_average_of_rehearsal_agrees_with_oracle(name):
    case = CASES[name]
    parsed = validated(case.mechanism)
    result, _ = closed_loop(parsed, case.compensator, nominal_gains(parsed, case.compensator))
    for contact, oracle in zip(result, run_oracle(case), strict=True):
        accuracy = 1e-6 if name in ("lag", "elastoplastic") else 1e-10
        assert contact.restitution == pytest.approx(oracle["restitution"], abs=accuracy)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear hold", "zoh", "lag", "response error"])
def test_restitution_derivative_for_moving_average_window_equals_central_difference(name):
    case, path, step = CASES[name], "rig.simulator.window", 1e-7
    parsed = validated(case.mechanism)
    gains = dict(nominal_gains(parsed, case.compensator))
    slope = jaxhil.jacobian(parsed, case.compensator, gains, of="restitution", by=[path])[path]

    def restitution(change):
        return run_at({"window": parsed.rig.simulator.window + change})

    def run_at(simulator):
        document = to_plain_data(parsed)
        document["rig"]["simulator"] |= simulator
        run = jaxhil.simulate(from_plain_data(document, "case"), case.compensator, gains=gains)
        return np.array([contact.restitution for contact in run.contacts])

    difference = (restitution(step) - restitution(-step)) / (2 * step)
    np.testing.assert_allclose(slope, difference, rtol=1e-5)


@pytest.mark.slow
def test_sweep_and_tune_with_uncertain_window_agree_with_single_runs():
    document = to_plain_data(validated(CASES["linear hold"].mechanism))
    document["uncertainty"] = {"rig.simulator.window": {"distribution": "uniform", "factor": [0.5, 1.5]}}
    uncertain = from_plain_data(document, "case")
    result = tuning.tune(uncertain, "phase_lead", scenarios=8, starts=2, seed=0)
    study = tuning.sweep(result, scenarios=16, limit=0.05)
    table = study.table.to_pydict()
    for index in range(4):
        document["rig"]["simulator"]["window"] = table["rig.simulator.window"][index]
        document["approach"] |= {"phase": table["approach.phase_1"][index], "contacts": 1}
        single = from_plain_data(document, "one")
        run = jaxhil.simulate(single, "phase_lead", gains=result.gains)
        assert run.contacts[0].restitution == pytest.approx(table["restitution_1"][index], abs=1e-9)


@pytest.mark.parametrize(
    "simulator, message",
    [
        ({"model": "moving_average"}, "rig.simulator.window: found nothing, expected a number > 0 s"),
        ({"model": "ideal", "window": 0.03}, "rig.simulator.window: found 0.03, expected nothing"),
        ({"model": "moving_average", "window": 0.0}, "rig.simulator.window: found 0.0, expected a number"),
    ],
)
def test_mechanism_file_rejects_window_of_wrong_model(simulator, message):
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        from_plain_data(mechanism({}, simulator), "case")
    assert "\n" not in str(caught.value)


def test_monitor_rejects_moving_average_in_one_line():
    with pytest.raises(InputError, match=r"simulator\.model: found a moving average over 0\.0344 s"):
        reject_unmodelled_effects(validated(CASES["linear hold"].mechanism))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["linear hold", "zoh"])
def test_rig_fmu_with_moving_average_has_readings_of_python_plant(name, tmp_path):
    fmus = pytest.importorskip("fmus", reason="FMPy is not installed")
    parsed = validated(CASES[name].mechanism)
    archive = fmus.write_fmu(tmp_path / "rig.fmu", rig_fmu({"mechanism": to_plain_data(parsed)}, 3))
    rig, plant = fmus.RunningFmu(fmus.extract(archive)), RigHardware(parsed)
    velocity, start = parsed.approach.velocity, rig.get("position")["position"]
    plant.begin(start, velocity, start - PERIOD * velocity, 0)
    touched = 0
    for tick in range(400):
        force, position = plant.read()
        touched += force > 0
        outputs = rig.get("force_measured", "position_measured")
        assert outputs == pytest.approx({"force_measured": force, "position_measured": position}, rel=1e-9)
        command = start + 2e-3 * np.sin(5.0 * tick * PERIOD)
        rig.set({"position_command": command, "force_command": force})
        rig.step()
        plant.move(command)
    assert touched > 50
    rig.close()
