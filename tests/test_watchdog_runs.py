"""Watchdog of the C controller on new scenarios: no missed bad runs and no false stops.

Limits are calibrated on draws of one seed, and evaluated on draws of a different seed (`fresh_runs.py`).
"""

from typing import Any

import pytest
from c99_cases import COMPILER
from cases import SECOND_ORDER, mechanism, nominal_gains, validated
from fresh_runs import counted, export, gains
from sweep_cases import NOISY, UNCERTAIN

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import DEFAULT_MECHANISM, load
from jaxhil.rig.faults import RESTITUTION, fault_names
from jaxhil.rig.limits import LIMITS
from jaxhil.simulation.gain_file import LoadedGains
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.calibration import DEFAULT_DRAWS, DEFAULT_ERROR_LIMIT

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc) on this machine")
CHOSEN = {
    "literature": {},
    # These gains were tuned for the default mechanism, and rounded.
    "tuned": {
        "phase_lead": 0.00529,
        "response_error": 0.898,
        "response_error_damping": 0.228,
        "identification_delay": 0.0199,
        "stiffness_covariance": 4.9e8,
    },
}


def coarse_mechanism(contact: dict[str, Any], **parts: Any) -> LoadedGains:
    """Return damped contacts at a coarse control period, with both good and bad runs."""
    contact = {"damping": [400.0], **contact}
    raw = mechanism(contact, {**SECOND_ORDER, "natural_frequency": 20.0}, **parts)
    parsed = validated({**raw, "uncertainty": UNCERTAIN})
    return gains(parsed, nominal_gains(parsed, "response_error"))


def test_c_watchdog_misses_no_bad_run_and_stops_no_good_run(tmp_path):
    loaded = coarse_mechanism({}, contacts=2)
    one, _ = export(loaded, 0.05, tmp_path, scenarios=256, lanes=128)
    (count,) = counted(loaded, [one], 384, lanes=128, in_python=12)
    assert count.lanes == 384 and not count.missed and not count.false, str(count)
    assert count.bad > 50 and count.good > 50 and set(count.causes) >= {"restitution"}, str(count)


@pytest.mark.slow
def test_watchdog_for_noisy_contacts_at_two_surfaces_performs_as_calibrated(tmp_path):
    loaded = coarse_mechanism({"clearance": 0.001}, contacts=3, force_sensor=NOISY)
    both = [export(loaded, limit, tmp_path, scenarios=1024, lanes=128) for limit in (0.05, 0.1)]
    narrow, wide = counted(loaded, [one for one, _ in both], 1024, lanes=128, in_python=12)
    assert narrow.bad > 100 and wide.bad > 4
    for (_, rates), count in zip(both, (narrow, wide), strict=True):
        result = {"false_alarms": (count.false, count.good), "missed_alarms": (count.missed, count.bad)}
        for kind, (alarms, runs) in result.items():
            _, low, high = binomial_interval(len(alarms), runs)
            stated = rates[kind]
            assert low <= stated["high"] and high >= stated["low"], f"{stated}\n{count}"
        assert count.good > 300 and len(count.false) <= 0.01 * count.good, str(count)
    (_, widened), (_, usual) = both
    assert widened["widened_from"] and usual["widened_from"] is None
    assert not narrow.missed and not wide.missed


def test_bad_run_that_is_not_stopped_in_time_is_counted_as_missed(tmp_path):
    loaded = coarse_mechanism({}, contacts=2)
    one, _ = export(loaded, 0.02, tmp_path, scenarios=256, lanes=128)
    margin = list(one.parameters).index(one.gain_file.limits["restitution_margin"])
    blind, strict = (one.parameters.copy() for _ in range(2))
    blind[margin], strict[margin] = LIMITS["restitution_margin"].highest, 0.0
    both = [one._replace(parameters=values) for values in (blind, strict)]
    seeing_nothing, seeing_all = counted(loaded, both, 128, lanes=128, in_python=0)
    assert len(seeing_nothing.missed) == seeing_nothing.bad > 10 and not seeing_nothing.false
    assert len(seeing_all.false) == seeing_all.good > 5 and not seeing_all.missed
    assert {text for _, _, text in seeing_all.false} == {"restitution"} == set(fault_names(RESTITUTION))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("chosen", "exports"),
    [
        (
            "tuned",
            [
                (DEFAULT_ERROR_LIMIT, DEFAULT_DRAWS),
                (DEFAULT_ERROR_LIMIT, 8192),
                (2 * DEFAULT_ERROR_LIMIT, DEFAULT_DRAWS),
                (2 * DEFAULT_ERROR_LIMIT, 8192),
            ],
        ),
        ("literature", [(0.02, 8192), (0.03, DEFAULT_DRAWS), (0.03, 8192)]),
    ],
)
def test_watchdog_misses_no_bad_run_in_a_hundred_thousand_new_runs(chosen, exports, tmp_path):
    parsed = load(DEFAULT_MECHANISM).mechanism
    loaded = gains(parsed, literature_gains(parsed, "response_error") | CHOSEN[chosen])
    exported = [export(loaded, limit, tmp_path, scenarios)[0] for limit, scenarios in exports]
    counts = counted(loaded, exported, 100_000, lanes=1024, in_python=32)
    for one, count in zip(exported, counts, strict=True):
        print(f"{parsed.name}, {chosen}, {one.name}, {count.lanes} fresh runs\n{count}", flush=True)
    for count in counts:
        assert count.lanes == 100_000 and count.bad > 1000 and count.good > 20_000
        assert not count.missed and not count.false, str(count)
    assert any(binomial_interval(0, count.good).high < 1e-4 for count in counts)
