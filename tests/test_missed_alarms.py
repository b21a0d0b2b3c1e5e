"""Missed alarms in runs with an injected fault that causes an error slightly above the limit."""

import math

import pytest

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.simulation.gain_file import check_document
from tuning.bundle.summary import describe_alarm_rates
from tuning.gain_file import build_document
from tuning.reporting.verdict_sections import _error_margin
from tuning.watchdog.calibration import calibrate
from tuning.watchdog.fault_injection import (
    INJECTED_FAULTS,
    MAX_FAULT_ERROR,
    MAX_FAULT_SCENARIOS,
    count_fault_scenarios,
)
from tuning.watchdog.verdict import DEFAULT_ALLOWED_RATES, add_verdict

LIMIT, NUMBER = 0.02, 64
# Undelayed, undamped contact: any error comes from the injected fault.
EXACT = (
    'rig.simulator={model = "ideal"}',
    "rig.force_sensor.delay=0",
    "contact.damping=[0]",
    'uncertainty={"contact.stiffness" = {distribution = "loguniform", factor = [0.8, 1.25]}}',
)


def loaded_gains(compensator, overrides=EXACT, name="claw-350kg"):
    parsed = load(name, overrides).mechanism
    gains = literature_gains(parsed, compensator)
    return check_document(build_document(compensator, gains, parsed, "0" * 64, {}, {}, 0, {}))


def calibrated(compensator="none", **replaced):
    loaded = loaded_gains(compensator)
    return calibrate(loaded, scenarios=64, limit=LIMIT, lanes=64, replaced=replaced, faulty=NUMBER).rates


@pytest.fixture(scope="module")
def rates():
    return calibrated()


def fault(rates, name):
    (result,) = [one for one in rates["fault_runs"] if one["name"] == name]
    return result


def test_injected_delay_that_reaches_error_limit_matches_theory(rates):
    """For a force delay tau, e = exp(pi omega tau/2); errors are LIMIT to BAND times LIMIT."""
    mechanism = load("claw-350kg", EXACT).mechanism
    omega = math.sqrt(mechanism.contact.stiffness[0] / mechanism.bodies.mass)
    for name in ("force_delay", "simulator_delay"):
        one = fault(rates, name)
        assert one["runs"] == one["scenarios"] == NUMBER and one["counted"] and one["unit"] == "s"
        assert LIMIT < one["error"] <= MAX_FAULT_ERROR * LIMIT
        # Use the median run; stiffness is spread evenly about the nominal value.
        assert one["size"] == pytest.approx(2 / (math.pi * omega) * math.log1p(one["error"]), rel=0.05)


def test_injected_fault_without_effect_is_not_counted(rates):
    # Without a compensator the position is not read, and there are no gains to remove.
    one = fault(rates, "position_delay")
    assert one["runs"] == 0 and not one["counted"] and one["size"] is None
    assert {one["name"] for one in rates["fault_runs"]} == {
        "force_delay",
        "position_delay",
        "simulator_delay",
    }
    assert any("not counted" in text for text in describe_alarm_rates(rates))


def test_watchdog_that_detects_every_error_misses_no_injected_fault(rates):
    for name in ("force_delay", "simulator_delay"):
        assert fault(rates, name)["alarms"] == 0 and fault(rates, name)["high"] < 0.06
    assert rates["missed_alarms"]["runs"] == 0  # no draw is bad, so none can be missed


def test_watchdog_without_restitution_check_misses_every_injected_fault():
    blind = calibrated(restitution_margin=None)
    for name in ("force_delay", "simulator_delay"):
        one = fault(blind, name)
        assert one["alarms"] == one["runs"] > 0 and one["low"] > 0.9
    assert blind["verdict"] == "bad"
    start = "missed alarms with an unmodelled delay of the force sensor"
    assert any(text.startswith(start) for text in blind["reasons"])


def test_neutral_gains_are_an_injected_fault_only_if_they_differ_from_tuned_gains(rates):
    result = calibrated("phase_lead")
    # There is no delay here, so the literature's lead is already 0.
    names = [kind.name for kind in INJECTED_FAULTS if kind.name != "gains"]
    assert [run["name"] for run in result["fault_runs"]] == names
    assert fault(result, "force_delay")["runs"] == NUMBER


@pytest.mark.parametrize(
    ("alarms", "runs", "counted", "verdict"),
    [
        (0, 183, True, "good"),
        (0, 182, True, "unknown"),
        (20, 183, True, "bad"),
        (0, 10, False, "unknown"),
    ],
)
def test_verdict_on_missed_alarms_depends_on_runs_with_injected_faults(alarms, runs, counted, verdict):
    from tuning.statistics.intervals import binomial_interval

    def rate(alarms, runs):
        _, low, high = binomial_interval(alarms, runs)
        return {"alarms": alarms, "runs": runs, "low": float(low), "high": float(high)}

    one = {**rate(alarms, runs), "name": "force_delay", "meaning": "an unmodelled delay of the force sensor"}
    rates = {
        "held_out_runs": 1000,
        "false_alarms": rate(0, 500),
        "missed_alarms": rate(0, 0),
        "fault_runs": [{**one, "counted": counted}],
    }
    result = add_verdict(rates, DEFAULT_ALLOWED_RATES, 2048)
    assert (
        result["verdict"] == verdict
        and result["fault_runs"][0]["allowed"] == DEFAULT_ALLOWED_RATES.missed_alarms
    )
    if verdict == "unknown":
        tells = "about 190 such runs would decide; there are 182" if counted else "a sweep of "
        assert tells in result["unknown"][0]
    # If too many drawn runs are missed, the result is bad, whatever the injected runs give.
    missed = add_verdict({**rates, "missed_alarms": rate(50, 100)}, DEFAULT_ALLOWED_RATES, 2048)
    assert missed["verdict"] == "bad"


def test_number_of_fault_scenarios_follows_from_allowed_missed_alarm_rate():
    assert count_fault_scenarios(0.02) == 2 * 183
    assert count_fault_scenarios(0.5) == 64 == count_fault_scenarios(1.0) and count_fault_scenarios(
        1e-6
    ) == MAX_FAULT_SCENARIOS == count_fault_scenarios(0.0)


def test_reported_error_margin_is_limit_minus_largest_error():
    assert _error_margin(0.01, -0.004) == "+0.006 of the error"
    assert _error_margin(None, 0.1) == "none"
