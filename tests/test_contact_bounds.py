"""Bounds on peak force and duration of the real contact relative to the ideal contact."""

import json
import math

import numpy as np
import pytest

import jaxhil
from jaxhil.simulation.contact_bounds import (
    is_contact_out_of_bounds,
    is_duration_out_of_bounds,
    is_peak_force_excessive,
)
from jaxhil.simulation.gain_file import check_document
from tuning.gain_file import build_document
from tuning.verification.runtime_replay import verify

PERIOD = 1e-3
LAW = "impulse_ledger"
FREQUENCY = "rig.simulator.natural_frequency"


@pytest.mark.parametrize("array", [float, np.array])
def test_contact_bounds_allow_twice_the_ideal_force_and_half_to_twice_the_duration(array):
    assert not is_peak_force_excessive(array(2.0), array(1.0)) and is_peak_force_excessive(
        array(2.001), array(1.0)
    )
    for duration, off in ((0.497, True), (0.499, False), (2.001, False), (2.003, True)):
        assert is_duration_out_of_bounds(array(duration), array(1.0), PERIOD) == off
    assert is_contact_out_of_bounds(array(3.0), array(1.0), array(1.0), array(1.0), PERIOD)
    assert is_contact_out_of_bounds(array(1.0), array(1.0), array(3.0), array(1.0), PERIOD)
    assert not is_contact_out_of_bounds(array(1.0), array(1.0), array(1.0), array(1.0), PERIOD)


def test_contact_bounds_ignore_unknown_peak_force_and_duration():
    assert not is_peak_force_excessive(math.nan, 1.0) and not is_peak_force_excessive(1.0, math.nan)
    assert not is_duration_out_of_bounds(math.nan, 1.0, PERIOD) and not is_duration_out_of_bounds(
        1.0, math.nan, PERIOD
    )
    # Bodies that stick to each other never separate.
    assert not is_duration_out_of_bounds(0.1, math.inf, PERIOD)


def test_duration_bound_of_short_contact_allows_rounding_to_control_periods():
    # Sampling shows an ideal contact of 2.4 periods as one to five ticks.
    assert not is_duration_out_of_bounds(1 * PERIOD, 2.4 * PERIOD, PERIOD)
    assert not is_duration_out_of_bounds(6 * PERIOD, 2.4 * PERIOD, PERIOD)
    assert is_duration_out_of_bounds(7 * PERIOD, 2.4 * PERIOD, PERIOD)


def test_undelayed_simulation_has_peak_force_and_duration_of_ideal_contact():
    # The remaining error is of the order of (omega T)^2 and of one control period.
    rig = {"rig.simulator": {"model": "ideal"}, "rig.force_sensor.delay": 0.0, "contact.damping": [0.0]}
    mechanism = jaxhil.load("claw-350kg", {**rig, "uncertainty": None})
    (contact,) = jaxhil.simulate(mechanism).contacts
    omega = math.sqrt(mechanism.contact.stiffness[0] / mechanism.bodies.mass)
    assert contact.reference_duration == pytest.approx(math.pi / omega, rel=1e-12)
    assert contact.peak_force_ratio == pytest.approx(1.0, abs=1e-4)
    assert abs(contact.duration - contact.reference_duration) <= mechanism.rig.control_period
    assert contact.duration_ratio == contact.duration / contact.reference_duration
    assert contact.peak_force_ratio == contact.peak_force / contact.reference_peak_force


@pytest.fixture(scope="module")
def slow_simulator():
    """Simulate with a slow motion simulator: right restitution, 15 times the force and duration."""
    return jaxhil.simulate(jaxhil.load("claw-350kg", {FREQUENCY: 0.2}), LAW)


def test_verdict_is_bad_for_correct_restitution_with_wrong_force(slow_simulator):
    (contact,) = slow_simulator.contacts
    assert contact.status == "ok" and abs(contact.error) < 0.01
    assert contact.peak_force_ratio > 10 and contact.duration_ratio > 10
    hard, long = slow_simulator.reasons()
    assert hard.startswith("contact 1: real peak force ") and hard.endswith("2 times the ideal contact's")
    assert long.startswith("contact 1: real contact of ") and long.endswith("2 times the ideal contact's")


def test_first_reason_of_verdict_is_status_or_error_of_the_contact(slow_simulator):
    plain = jaxhil.simulate("claw-350kg")
    (diverges,) = plain.reasons()
    assert diverges.startswith("the largest error is +") and "divergence" in diverges
    assert plain.reasons(limit=10.0) == []
    # The error beyond the limit is reported together with the deviations from the ideal contact.
    assert len(slow_simulator.reasons(limit=1e-6)) == 3


@pytest.mark.slow
def test_verify_reports_excessive_peak_force_of_closed_loop(slow_simulator):
    gains, mechanism = slow_simulator.gains, slow_simulator.mechanism
    report = verify(check_document(build_document(LAW, gains, mechanism, "0" * 64, {}, {}, 0, {})), 1)
    (contact,) = report.closed_loop
    (simulated,) = slow_simulator.contacts
    assert contact.peak_force_ratio == pytest.approx(simulated.peak_force_ratio, rel=1e-6)
    # The duration of the closed loop is a whole number of control periods.
    sample = mechanism.rig.control_period * simulated.duration_ratio / simulated.duration
    assert contact.duration_ratio == pytest.approx(simulated.duration_ratio, abs=sample)
    reason = f"closed loop, contact 1: found {contact.peak_force_ratio:.3g} times the peak force"
    assert not report.verdict and report.reasons[0].startswith(reason)


@pytest.mark.parametrize("frequency", [pytest.param(0.2, marks=pytest.mark.slow), 30.0])
def test_simulate_command_checks_peak_force_and_duration(jaxhil, frequency):
    asked = ("simulate", "claw-350kg", "--compensator", LAW, "--set", f"{FREQUENCY}={frequency}")
    json_run = jaxhil(*asked, "--json")
    document = json.loads(json_run.out)
    (contact,) = document["contacts"]
    wrong = contact["peak_force_ratio"] > 2 or not 0.5 < contact["duration_ratio"] < 2
    assert wrong == (frequency < 1), contact
    assert contact["peak_force_ratio"] == contact["peak_force"] / contact["reference_peak_force"]
    assert document["bounds"]["peak_force_ratio"] == 2.0
    bad = wrong or abs(contact["error"]) > 0.01 or contact["status"] != "ok"
    assert document["verdict"] == ("bad" if bad else "good") and json_run.code == bad
    assert bool(document["reasons"]) == bad
    text_run = jaxhil(*asked)
    assert text_run.code == bad and ("Bad: contact 1: real " in text_run.out) == wrong
    if not bad:
        assert "every peak force at most 2 times and every duration 0.5 to 2 times" in text_run.out
