"""Alarm rates of the watchdog on new scenarios, compared with the verdict of `jaxhil export`.

Cases: every built-in mechanism, and one whose damping and delay are both uncertain, at the literature's
gains. About a third of the runs exceed the error limit, so that good and bad runs are frequent enough to
estimate both rates. Limits and verdict come from draws of one seed, the new rates from draws of another seed,
with the C controller. Run with `pytest -m slow -s tests/test_alarm_rates.py`.
"""

import numpy as np
import pytest
from c99_cases import COMPILER
from fresh_runs import counted, export, gains

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import builtin_names, load, suite_names
from jaxhil.simulation.metrics import OK
from tuning.statistics.intervals import binomial_interval
from tuning.watchdog.recording import ScenarioSelection, record_selection

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMPILER is None, reason="no C compiler (cc) on this machine"),
]
LANES, CALIBRATED, FRESH = 512, 2048, 1024
DOUBTFUL = (
    'uncertainty."contact.damping"={distribution = "loguniform", factor = [0.5, 2.0]}',
    'uncertainty."rig.force_sensor.delay"={distribution = "normal", std = 0.0005}',
)
CASES = {
    **{name: (name, (), "response_error") for name in (*builtin_names(), *suite_names())},
    "damping and delay": ("claw-350kg", DOUBTFUL, "response_error"),
}


def error_that_a_third_exceed(loaded):
    """Return an error that about a third of the runs exceed, to two digits."""
    (chunk,) = record_selection(loaded, ScenarioSelection("random", 1, LANES))
    error = np.where(chunk.contacts.status == OK, np.abs(chunk.contacts.error), np.inf)
    return float(f"{np.quantile(np.max(error, axis=0), 2 / 3):.1e}")


@pytest.mark.parametrize("case", CASES)
def test_alarm_rates_on_new_scenarios_lie_within_stated_intervals(case, tmp_path):
    name, overrides, compensator = CASES[case]
    parsed = load(name, overrides).mechanism
    loaded = gains(parsed, literature_gains(parsed, compensator), compensator)
    limit = error_that_a_third_exceed(loaded)
    gain_file, rates = export(loaded, limit, tmp_path, CALIBRATED, LANES)
    (count,) = counted(loaded, [gain_file], FRESH, LANES, in_python=2)
    print(f"\n{case}, {compensator}: limit {limit:g}, margin {rates['restitution_margin']:.2g}", end="")
    print(f" widened from {rates['widened_from']:.2g}" if rates["widened_from"] else "", end="")
    noticed = rates["noticed_from"]["error"]
    print(f", 95 % noticed from {noticed:.2g}" if noticed else ", no error noticed", rates["verdict"])
    missed = len(count.missed)
    # It is unknown whether the watchdog would have raised an alarm in a run that another guard stopped.
    counts = {
        "false_alarms": (len(count.false), len(count.false), count.good),
        "missed_alarms": (missed, missed + count.guarded, count.bad),
    }
    for kind, (alarms, most, runs) in counts.items():
        stated = rates[kind]
        low, high = binomial_interval(alarms, runs)[1], binomial_interval(most, runs)[2]
        print(
            f"  {kind}: stated {stated['alarms']} of {stated['runs']} ({stated['low']:.2g} to "
            f"{stated['high']:.2g}), fresh {alarms} to {most} of {runs} ({low:.2g} to {high:.2g})",
            flush=True,
        )
        assert low <= stated["high"] and high >= stated["low"], f"{kind}: {stated}\n{count}"
        if stated["high"] <= stated["allowed"]:
            assert low <= stated["allowed"], f"{kind}: {stated}\n{count}"
        if stated["low"] > stated["allowed"]:
            assert high > stated["allowed"], f"{kind}: {stated}\n{count}"
