"""Verdicts on the watchdog's alarm rates, required numbers of scenarios, and smallest detectable error."""

import numpy as np
import pytest

from tuning.statistics.intervals import binomial_interval, estimate_deciding_scenarios
from tuning.watchdog.alarms import find_detectable_error
from tuning.watchdog.verdict import DEFAULT_ALLOWED_RATES, AllowedAlarmRates, add_verdict


def rates(false, missed, held_out=1000):
    """Return alarm rates for these numbers (alarms, runs) of false and of missed alarms."""
    result = {"held_out_runs": held_out}
    for kind, (alarms, runs) in (("false_alarms", false), ("missed_alarms", missed)):
        _, low, high = binomial_interval(alarms, runs)
        result[kind] = {"alarms": alarms, "runs": runs, "low": float(low), "high": float(high)}
    return result


@pytest.mark.parametrize(
    ("false", "missed", "verdict", "bad", "unknown"),
    [
        ((0, 368), (0, 183), "good", [], []),
        ((0, 367), (0, 183), "unknown", [], ["false"]),
        ((0, 368), (0, 182), "unknown", [], ["missed"]),
        ((2, 12), (0, 183), "bad", ["false"], []),
        ((0, 368), (50, 1000), "bad", ["missed"], []),
        ((200, 400), (3, 4), "bad", ["false", "missed"], []),
        ((9, 10), (0, 0), "bad", ["false"], ["missed"]),
        ((0, 0), (0, 0), "unknown", [], ["false", "missed"]),
    ],
)
def test_alarm_verdict_follows_from_confidence_interval_of_rate(false, missed, verdict, bad, unknown):
    result = add_verdict(rates(false, missed), DEFAULT_ALLOWED_RATES, 2000)
    assert result["verdict"] == verdict
    assert [text.split()[0] for text in result["reasons"]] == bad
    assert [text.split()[0] for text in result["unknown"]] == unknown
    assert result["false_alarms"]["allowed"] == 0.01 and result["missed_alarms"]["allowed"] == 0.02


def test_alarm_verdict_uses_allowed_rates_given_by_caller():
    result = rates((30, 100), (0, 200))
    assert add_verdict(result, AllowedAlarmRates(0.5, 0.02), 400)["verdict"] == "good"
    assert add_verdict(result, AllowedAlarmRates(0.1, 0.02), 400)["verdict"] == "bad"
    assert add_verdict(result, AllowedAlarmRates(0.3, 0.001), 400)["verdict"] == "unknown"
    assert add_verdict(result, AllowedAlarmRates(1.0, 1.0), 400)["verdict"] == "good"


@pytest.mark.parametrize(
    ("missed", "words"),
    [
        # 183 runs decide if no alarm is missed; 40 of 2000 scenarios were evaluated.
        ((0, 40), "at this rate, a sweep of about 9200 scenarios would decide"),
        ((0, 0), "1000 runs contain no such run: a sweep of 50000 scenarios may decide"),
        ((1, 50), "at this rate, no sweep would decide"),
    ],
)
def test_unknown_alarm_verdict_states_number_of_scenarios_needed(missed, words):
    (text,) = add_verdict(rates((0, 500), missed), DEFAULT_ALLOWED_RATES, 2000)["unknown"]
    assert text.endswith(f"limit 0.02; {words}")


@pytest.mark.parametrize("allowed", [0.001, 0.02, 0.3])
@pytest.mark.parametrize(("failures", "number"), [(0, 0), (0, 30), (1, 200), (3, 60), (40, 100)])
def test_stated_number_of_scenarios_is_smallest_that_decides_alarm_verdict(failures, number, allowed):
    number_found = estimate_deciding_scenarios(failures, number, allowed)
    share = failures / max(number, 1)
    assert number_found is not None

    def decided(runs):
        _, low, high = binomial_interval(round(share * runs), runs)
        return high <= allowed if share < allowed else low > allowed

    fewer = range(max(0, int(0.97 * number_found) - 3), number_found)
    assert decided(number_found) and not all(decided(runs) for runs in fewer)


def test_detectable_error_raises_alarm_in_at_least_95_percent_of_contacts():
    rng = np.random.default_rng(0)
    error = rng.normal(0.0, 0.01, 4000)
    result = find_detectable_error(error, np.abs(error) + rng.normal(0.0, 0.001, 4000) > 0.02)
    size = np.abs(error)
    within = size >= result["error"]
    assert 0.018 < result["error"] < 0.022 and result["contacts"] == np.sum(within)
    assert result["largest"] == np.max(size)
    noticed = np.abs(error) > 0.02
    assert find_detectable_error(error, noticed)["error"] < 0.02
    # The next smaller error is not detected often enough.
    result, order = find_detectable_error(error, noticed), np.sort(size)[::-1]
    below = order[result["contacts"]]
    assert np.mean(noticed[size >= result["error"]]) >= 0.95 > np.mean(noticed[size >= below])


@pytest.mark.parametrize(("contacts", "noticed"), [(0, True), (19, True), (200, False)])
def test_detectable_error_is_none_without_enough_alarms(contacts, noticed):
    error = np.linspace(0.0, 0.05, contacts)
    result = find_detectable_error(error, np.full(contacts, noticed))
    assert result == {"error": None, "contacts": 0, "largest": 0.05 if contacts else None}
