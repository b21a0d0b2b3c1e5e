"""What is said of the watchdog's alarms: good, bad or unknown, which sweep would tell, what is noticed."""

import numpy as np
import pytest

from tuning.statistics.intervals import binomial_interval, number_to_decide
from tuning.watchdog.alarms import noticed_from
from tuning.watchdog.verdict import ALLOWED, Allowed, judged


def rates(false, missed, held_out=1000):
    """As of so many alarms among so many runs, either kind."""
    found = {"held_out_runs": held_out}
    for kind, (alarms, runs) in (("false_alarms", false), ("missed_alarms", missed)):
        _, low, high = binomial_interval(alarms, runs)
        found[kind] = {"alarms": alarms, "runs": runs, "low": float(low), "high": float(high)}
    return found


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
def test_the_verdict_follows_from_the_ends_of_the_intervals(false, missed, verdict, bad, unknown):
    found = judged(rates(false, missed), ALLOWED, 2000)
    assert found["verdict"] == verdict
    assert [text.split()[0] for text in found["reasons"]] == bad
    assert [text.split()[0] for text in found["unknown"]] == unknown
    assert found["false_alarms"]["allowed"] == 0.01 and found["missed_alarms"]["allowed"] == 0.02


def test_what_is_allowed_is_the_callers():
    found = rates((30, 100), (0, 200))
    assert judged(found, Allowed(0.5, 0.02), 400)["verdict"] == "good"
    assert judged(found, Allowed(0.1, 0.02), 400)["verdict"] == "bad"
    assert judged(found, Allowed(0.3, 0.001), 400)["verdict"] == "unknown"
    assert judged(found, Allowed(1.0, 1.0), 400)["verdict"] == "good"


@pytest.mark.parametrize(
    ("missed", "words"),
    [
        # 183 runs decide if none is missed: of 2000 scenarios 40 made judged ones.
        ((0, 40), "at this rate a sweep of about 9200 scenarios tells"),
        ((0, 0), "no such run among 1000: a sweep of at least 50000 scenarios tells"),
        ((1, 50), "at this rate no sweep would tell"),
    ],
)
def test_it_is_said_which_sweep_would_tell(missed, words):
    (text,) = judged(rates((0, 500), missed), ALLOWED, 2000)["unknown"]
    assert text.endswith(f"allowed 0.02; {words}")


@pytest.mark.parametrize("allowed", [0.001, 0.02, 0.3])
@pytest.mark.parametrize(("failures", "number"), [(0, 0), (0, 30), (1, 200), (3, 60), (40, 100)])
def test_so_many_decide_and_fewer_do_not(failures, number, allowed):
    found = number_to_decide(failures, number, allowed)
    share = failures / max(number, 1)
    assert found is not None

    def decided(runs):
        _, low, high = binomial_interval(round(share * runs), runs)
        return high <= allowed if share < allowed else low > allowed

    fewer = range(max(0, int(0.97 * found) - 3), found)
    assert decided(found) and not all(decided(runs) for runs in fewer)


def test_the_error_from_which_on_contacts_are_noticed():
    rng = np.random.default_rng(0)
    error = rng.normal(0.0, 0.01, 4000)
    found = noticed_from(error, np.abs(error) + rng.normal(0.0, 0.001, 4000) > 0.02)
    size = np.abs(error)
    within = size >= found["error"]
    assert 0.018 < found["error"] < 0.022 and found["contacts"] == np.sum(within)
    assert found["largest"] == np.max(size)
    noticed = np.abs(error) > 0.02
    assert noticed_from(error, noticed)["error"] < 0.02
    # The next smaller one is not noticed often enough.
    found, order = noticed_from(error, noticed), np.sort(size)[::-1]
    below = order[found["contacts"]]
    assert np.mean(noticed[size >= found["error"]]) >= 0.95 > np.mean(noticed[size >= below])


@pytest.mark.parametrize(("contacts", "noticed"), [(0, True), (19, True), (200, False)])
def test_no_such_error_is_made_up(contacts, noticed):
    error = np.linspace(0.0, 0.05, contacts)
    found = noticed_from(error, np.full(contacts, noticed))
    assert found == {"error": None, "contacts": 0, "largest": 0.05 if contacts else None}
