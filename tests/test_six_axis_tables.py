"""Tables of the six-axis commands at 80 columns, with long names and wide numbers."""

from types import SimpleNamespace
from typing import NamedTuple

import pytest

from tuning import terminal
from tuning.benchmark.comparison import CompensatorMetrics
from tuning.benchmark.tables import SIX_AXIS_METRIC_HEADINGS, build_leaderboard, build_mechanism_table
from tuning.cli.commands import replay, simulate_six, sweep_tables, tune_tables
from tuning.cli.options import Tune
from tuning.statistics.intervals import IntervalEstimate

WIDE = -123.4567
LAW, MECHANISM = "phase_lead_per_axis", "hydraulic-hexapod"
ERRORS = SimpleNamespace(rms=WIDE, p99=WIDE, max=WIDE, mean=WIDE, peak_ratio=WIDE, failed=1023)
EPISODE = SimpleNamespace(
    **dict.fromkeys(("energy_error", "twist_error", "restitution", "reference_restitution"), WIDE),
    **dict.fromkeys(("peak_force", "reference_peak_force", "duration", "reference_duration"), 1234.5678),
    **dict.fromkeys(("peak_moment", "reference_peak_moment", "approach_velocity"), 123.45678),
    **dict.fromkeys(("normal_part", "lateral_part", "rotational_part"), WIDE),
    **{"touches": 12, "reference_touches": 12, "status": "not reached"},
)


class Shares(NamedTuple):
    """Sobol indices of an input with their intervals."""

    input: str
    first_order: float
    first_low: float
    first_high: float
    total: float
    total_low: float
    total_high: float


@pytest.fixture
def lines(monkeypatch, capsys):
    """Return a function that returns the lines printed so far, at 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    return lambda: capsys.readouterr().out.splitlines()


def test_rows_of_simulated_episodes_have_at_most_80_characters(lines):
    run = SimpleNamespace(
        mechanism=SimpleNamespace(name=MECHANISM), compensator=LAW, episodes=[EPISODE] * 2, status="miss"
    )
    simulate_six._print(SimpleNamespace(gains=None), 0.05, run, False)  # pyright: ignore
    assert max(map(len, lines())) <= 80


def test_rows_of_replayed_scenario_have_at_most_80_characters(lines):
    document = {
        **{"mechanism": MECHANISM, "compensator": LAW, "index": 1_000_000, "outcome": "rebounded"},
        **{"verdict": "good", "different": [], "unlike": [], "episodes": [vars(EPISODE)]},
        "inputs": {"rig.simulator.axes.2.natural_frequency": WIDE, "groups.1.friction.slip_speed": 1.25e-7},
    }
    replay._print(document)
    assert max(map(len, lines())) <= 80


def test_rows_of_tuned_gains_have_at_most_80_characters(lines):
    outcome = SimpleNamespace(is_scheduled=SimpleNamespace(sum=lambda: 2048))
    result = SimpleNamespace(
        mechanism=SimpleNamespace(name=MECHANISM),
        outcomes={"tuned": outcome},
        figures=dict.fromkeys(("before", "literature", "tuned"), ERRORS),
        starts=[SimpleNamespace(status="no longer decreasing", steps=1000, rms=WIDE)],
        settings=SimpleNamespace(probed=False),
        first=(),
        global_comparison=None,
    )
    error = dict.fromkeys(("before", "literature", "tuned"), ERRORS)
    entry = {"mechanism": MECHANISM, "better_than_literature": False, "energy_error": error}
    options = Tune(files=(MECHANISM,), compensator=LAW)
    terminal.emit(
        tune_tables._six_axis_error_table(options, result, entry | {"twist_error": error}),
        tune_tables._start_table(options, result),
    )
    tune_tables.print_overview(options, [result] * 2, [entry] * 2, True)
    assert max(map(len, lines())) <= 80


def test_rows_of_compared_compensators_have_at_most_80_characters(lines):
    metrics = dict.fromkeys(SIX_AXIS_METRIC_HEADINGS, IntervalEstimate(1.234, 1.2, 1.3))
    laws = "none", "phase_lead", LAW, "response_error", "impulse_ledger"
    results = [CompensatorMetrics(law, MECHANISM, {}, {"literature": metrics}, 6) for law in laws]
    terminal.emit(
        build_mechanism_table(MECHANISM, results), build_leaderboard([MECHANISM], {MECHANISM: results})
    )
    assert max(map(len, lines())) <= 80


def test_rows_of_sweeps_have_at_most_80_characters(lines):
    shares = Shares("rig.simulator.axes.2.natural_frequency", *[-0.123] * 6)
    rare = {
        **dict.fromkeys(("limit", "probability", "low", "high"), 1.234e-05),
        **dict.fromkeys(("coefficient_of_variation", "formula_coefficient_of_variation"), 0.123),
        "evaluations": 1_000_000,
    }
    quantile = dict.fromkeys(("order", "value", "low", "high"), 0.99999)
    document = {
        **{"mechanism": MECHANISM, "compensator": LAW, "scenarios": 1_000_000, "sampling": "independent"},
        **{"precision": "float64", "outcomes": {"unlike the ideal contact": 1_000_000}, "axes": 6},
        **{"rare": rare, "error_quantiles": [quantile] * 3},
        "worst": [{"index": 999_999, "outcome": "not reached", "worst_error": WIDE, "worst_contact": 12}],
        "drivers": {"cap": 1.0, "capped": 12, "evaluations": 100_000, "inputs": [shares]},
    }
    terminal.emit(*sweep_tables._build_tables(document))
    assert max(map(len, lines())) <= 80
