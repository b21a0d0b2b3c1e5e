"""Rejected runs of mechanism files: too many ticks, too fast poles, or too low a velocity limit."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from plausibility_rigs import SPEED, behind, rig
from scipy.linalg import expm

import jaxhil
import tuning
from jaxhil.simulation.motion_simulator import matrix_exponential
from jaxhil.simulation.plausibility import MAX_POLE, check_run


def refusal(mechanism, **options):
    with pytest.raises(jaxhil.InputError) as refused:
        check_run(mechanism, **options)
    message = str(refused.value)
    assert message.isprintable() and message.startswith(f"{mechanism.name}: ")
    return message


def test_mechanism_whose_run_needs_too_many_ticks_is_rejected():
    message = (
        "found 1e-09 s, expected at most 1e+07 ticks per contact and 1e+09 per run: "
        "contact 1 takes about 0.195 s"
    )
    assert f"rig.control_period: {message}, 1.9e+08 ticks" in refusal(rig(rig__control_period=1e-9))
    check_run(rig(rig__control_period=2e-8))
    assert "contact 1 takes" in refusal(rig(rig__control_period=1.9e-8))
    # A contact that never ends takes 10 s.
    endless = {"contact.stiffness": [1e-9]}
    check_run(rig(endless, rig__control_period=1.01e-6))
    assert "contact 1 takes about 10 s" in refusal(rig(endless, rig__control_period=0.99e-6))
    many = {"approach.contacts": 1000, "rig.control_period": 1e-7}
    assert "contact 1 takes about 0.195 s, 1.9e+06 ticks" in refusal(rig(many))


def test_mechanism_with_endless_approach_is_rejected():
    gap = {"contact.clearance": 40.0, "approach.contacts": 2}
    check_run(rig(gap))
    message = refusal(rig(gap, contact__clearance=100.0))
    assert "contact.clearance: found 100 m, expected at most 1e+07 ticks per contact" in message
    assert "contact 2 takes about 2e+04 s, 2e+07 ticks" in message
    assert "contact.clearance: found 1e+30 m" in refusal(rig(gap, contact__clearance=1e30))
    # There is no flight after the last contact.
    check_run(rig(contact__clearance=1e30))


def test_limit_on_number_of_ticks_applies_to_uncertain_values():
    wide = {"distribution": "loguniform", "factor": [1e-6, 1.0]}
    uncertain = rig({"uncertainty": {"rig.control_period": wide}})
    check_run(uncertain)
    assert "found 1e-09 s" in refusal(uncertain, drawn=True)
    speeds = {"contact.clearance": 1.0, "approach.contacts": 2}
    slow = rig({**speeds, "uncertainty": {"approach.velocity": {**wide, "factor": [1e-3, 1.0]}}})
    check_run(slow)
    assert "contact 2 takes about 2e+05 s" in refusal(slow, drawn=True)
    normal = {"distribution": "normal", "std": 2e-4}
    check_run(rig({"uncertainty": {"rig.control_period": normal}}), drawn=True)


@pytest.mark.parametrize(
    "simulator",
    [
        {"model": "first_order", "time_constant": 1.5e-5},
        {"model": "second_order", "natural_frequency": 1.02e4, "damping_ratio": 0.8},
        {"model": "second_order", "natural_frequency": 1e100, "damping_ratio": 1e-100},
        {"model": "third_order", "coefficients": [1e-5, 1e-9, 1e-15]},
        {"model": "transfer_function", "numerator": [1e100], "denominator": [1e-100, 1.0, 1e100]},
    ],
    ids=str,
)
def test_motion_simulator_too_fast_for_control_period_is_rejected(simulator):
    message = refusal(behind(**simulator))
    assert (
        ": rig.simulator: found a pole of " in message and "expected at most 64 / control_period" in message
    )


@pytest.mark.parametrize("angle", [0.0, 0.6, np.pi / 2])
def test_fastest_accepted_simulator_poles_are_propagated_exactly(angle):
    """Use two poles of magnitude 64 / T at an angle to the negative axis."""
    damping = 2 * MAX_POLE * math.cos(angle)
    matrix = np.array([[0.0, MAX_POLE], [-MAX_POLE, -damping]])
    whole = np.zeros((4, 4))
    whole[:2, :2], whole[:2, 2], whole[2, 3] = matrix, (3.0, -2.0), 0.7
    result = matrix_exponential(jnp.asarray(whole[:2]), jnp.asarray(0.7))
    np.testing.assert_allclose(result, expm(whole)[:3], rtol=0, atol=2e-9)


def test_limit_on_simulator_poles_applies_to_uncertain_values():
    drawn = {"rig.simulator.natural_frequency": {"distribution": "uniform", "factor": [1.0, 1e3]}}
    check_run(rig(uncertainty=drawn))
    assert "rig.simulator: found a pole of " in refusal(rig(uncertainty=drawn), drawn=True)


def test_velocity_limit_check_applies_to_uncertain_values():
    normal = {"approach.velocity": {"distribution": "normal", "std": 1e-4}}
    narrow = rig({"uncertainty": normal}, rig__simulator__velocity_limit=1.1 * SPEED)
    check_run(narrow)
    message = "rig.simulator.velocity_limit: found 0.0055, expected a number >= 0.00559978 m/s"
    assert message in refusal(narrow, drawn=True)
    check_run(rig({"uncertainty": normal}, rig__simulator__velocity_limit=2 * SPEED), drawn=True)


def test_every_public_function_rejects_endless_run():
    endless = rig(rig__control_period=1e-9)
    for function in (jaxhil.simulate, tuning.tune, tuning.compare):
        with pytest.raises(jaxhil.InputError, match="at most 1e\\+07 ticks per contact"):
            function(endless)
    with pytest.raises(jaxhil.InputError, match="at most 1e\\+07 ticks per contact"):
        jaxhil.jacobian(endless, by="approach.velocity")


@pytest.mark.parametrize("command", ["simulate", "tune", "compare"])
def test_every_command_rejects_endless_run_with_one_line_message(jaxhil, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = jaxhil(command, "rig-300kg", "--set", "rig.control_period=1e-9")
    assert ran.code == 2 and ran.out == "" and ran.err.count("\n") == 1
    assert ran.err.startswith("jaxhil: rig-300kg: rig.control_period: found 1e-09 s, expected at most")
