"""Command `jaxhil compare`; tests that run a comparison are slow."""

import json
import os
import signal
import subprocess
import sys
import time
from math import nan

import pytest

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.contact_plot import save_figure
from tuning import terminal
from tuning.benchmark.comparison import CompensatorMetrics
from tuning.benchmark.computing_time import measure_tick_time
from tuning.benchmark.tables import (
    METRIC_HEADINGS,
    build_leaderboard,
    build_mechanism_table,
    describe_least_errors,
    find_winners,
)
from tuning.plots.comparison import plot_errors, plot_transparency
from tuning.statistics.intervals import IntervalEstimate

COMMAND = [sys.executable, "-m", "tuning", "compare"]
# A non-interactive shell starts background jobs with SIGINT ignored.
HEEDING = (
    "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from tuning.__main__ import main; sys.exit(main())"
)
SMALL = [
    "rig-300kg",
    "--set",
    "approach.contacts=1",
    "--compensators",
    "none",
    "passivity",
    "--evaluated",
    "8",
]


def run(arguments, folder, **options):
    environment = {**os.environ, "JAXHIL_CACHE": str(folder / "cache"), "XLA_FLAGS": ""}
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, env=environment, cwd=folder, **options
    )


@pytest.mark.slow
def test_compare_command_is_reproducible_from_seed(tmp_path):
    first, second = (run([*SMALL, "--json", "-o", name], tmp_path) for name in ("a", "b"))
    assert (first.returncode, second.returncode) == (0, 0), first.stderr
    documents = [json.loads(run_result.stdout) for run_result in (first, second)]
    for name, document in zip("ab", documents, strict=True):
        assert json.loads((tmp_path / name / "compare.json").read_text()) == document
        assert (tmp_path / name / "errors.png").exists() and (tmp_path / name / "transparency.png").exists()
        costs = document.pop("timings")["microseconds_per_tick"]
        assert set(costs) == {"none", "passivity"} and all(cost > 0 for cost in costs.values())
    assert documents[0] == documents[1]
    assert documents[0]["transparency"].endswith("at 25 and 75 % of the ideal contact's duration")
    [mechanism] = documents[0]["mechanisms"]
    none, passivity = mechanism["laws"]
    assert none["knows"] == [] and set(none["figures"]) == {"literature"}
    rms = none["figures"]["literature"]["rms"]
    assert rms["low"] <= rms["value"] <= rms["high"]
    # The passivity law returns the energy taken: a small error, but no transparency.
    assert passivity["figures"]["literature"]["rms"]["high"] < 0.2 * rms["low"]
    assert abs(passivity["figures"]["literature"]["late"]["value"]) < 0.1
    assert mechanism["winners"]["rms"] == "passivity"
    table = run([*SMALL, "-o", "c", "--untuned"], tmp_path).stdout
    assert "* " in table and "passivity" in table and "wrote c/compare.json" in table


def figures(rms, **others):
    estimates = dict.fromkeys(METRIC_HEADINGS, IntervalEstimate(1.0, 0.9, 1.1))
    return {**estimates, "rms": IntervalEstimate(rms, 0.9 * rms, 1.1 * rms), **others}


FOUND = [
    CompensatorMetrics("none", "m", {"literature": {}}, {"literature": figures(0.5)}),
    CompensatorMetrics(
        "phase_lead",
        "m",
        {"literature": {"phase_lead": 0.1}, "tuned": {"phase_lead": 0.2}},
        {"literature": figures(0.4), "tuned": figures(0.1, worst=IntervalEstimate(nan, nan, nan))},
    ),
]


def test_compare_tables_mark_the_best_compensator(capsys):
    terminal.emit(
        build_mechanism_table("m", FOUND), build_leaderboard(["m", "n"], {"m": FOUND, "n": FOUND[:1]})
    )
    out = capsys.readouterr().out
    rows = [line.split() for line in out.splitlines() if line.strip()]
    assert ["none", "50"] in [row[:2] for row in rows] and ["phase_lead", "40"] in [row[:2] for row in rows]
    # Tuned gains win by more than the intervals; a missing value is a dash.
    assert ["tuned", "10*", "100", "-"] in [row[:4] for row in rows]
    assert ["m", "50", "10*"] in rows and ["n", "50", "-"] in rows
    assert find_winners(FOUND)["rms"] == "phase_lead" and find_winners(FOUND)["late"] is None


def test_compare_leaderboard_lists_all_compensators_and_settings(capsys):
    ours = CompensatorMetrics(
        "impulse_ledger", "m", {}, {"literature": figures(0.05), "gentle": figures(0.06)}
    )
    many = [
        *FOUND,
        ours,
        *(CompensatorMetrics(f"law_{n}", "m", {}, {"literature": figures(0.5)}) for n in range(12)),
    ]
    better = [*FOUND, CompensatorMetrics("impulse_ledger", "n", {}, {"literature": figures(0.2)})]
    board = {"m": many, "n": better}
    terminal.emit(build_leaderboard(["m", "n"], board), wrap=False)
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["m", "50", "10", "5*", "6", *["50"] * 12] in rows
    assert ["n", "50", "10*", "20", "-", *["-"] * 12] in rows
    assert describe_least_errors(["m", "n"], board) == "Least rms error: impulse_ledger (m); phase_lead (n)."
    assert describe_least_errors(["m"], {"m": FOUND[:1]}) == ""


def test_compare_tables_have_no_rows_for_tuned_gains_without_tuning(capsys):
    both = {"literature": figures(0.4), "gentle": figures(0.3)}
    result = [FOUND[0], CompensatorMetrics("impulse_ledger", "m", {}, both)]
    terminal.emit(build_mechanism_table("m", result), build_leaderboard(["m"], {"m": result}))
    out = capsys.readouterr().out
    assert "tuned" not in out and "  gentle  " in out
    assert out.count("with the literature's gains") == 2


def test_compare_plots_are_written(tmp_path):
    both = {"m": FOUND, "n": FOUND}
    save_figure(plot_errors(["m", "n"], both, 0.01), tmp_path / "errors.png")
    save_figure(plot_transparency(["m", "n"], both), tmp_path / "transparency.png")
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("errors.png", "transparency.png"))


@pytest.mark.slow
def test_compare_reports_positive_computing_time_per_tick():
    for name in ("rig-300kg", "probe-drogue"):
        mechanism = load_any(name).mechanism
        gains = literature_gains(mechanism, "impulse_ledger")
        assert 0 < measure_tick_time(mechanism, "impulse_ledger", gains) < 1e3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--compensators", "magic"], "--compensators: found 'magic', expected none, dead_zone_observer"),
        (["no-such-file"], "no-such-file"),
        (["varying", "varying"], "name: found varying, expected a name that differs from that of varying"),
        (["--evaluated", "1"], "--evaluated: found 1, expected an integer >= 2"),
        (["--scenarios", "0"], "--scenarios: found 0, expected an integer >= 1"),
        (["--limit", "nan"], "--limit: found nan, expected a number >= 0"),
    ],
)
def test_compare_rejects_bad_input_with_one_line_message(jaxhil, arguments, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ran = jaxhil("compare", *arguments)
    assert ran.code == 2 and message in ran.err and ran.err.count("\n") == 1
    assert not ran.out and not list(tmp_path.iterdir())


@pytest.mark.slow
def test_compare_keeps_finished_results_after_interrupt(tmp_path):
    environment = {**os.environ, "JAXHIL_CACHE": str(tmp_path / "cache"), "XLA_FLAGS": ""}
    process = subprocess.Popen(
        [sys.executable, "-c", HEEDING, "compare", *SMALL, "--json", "-o", "out"],
        text=True, env=environment, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    time.sleep(6)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    document = json.loads(out)
    assert document["interrupted"] and document == json.loads((tmp_path / "out" / "compare.json").read_text())
    assert "interrupted" in err and "Traceback" not in err


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_compare_leaves_no_workers_after_kill(tmp_path, number):
    environment = {**os.environ, "JAXHIL_CACHE": str(tmp_path / "cache"), "XLA_FLAGS": ""}
    process = subprocess.Popen(
        [*COMMAND, *SMALL, "--json", "-o", "out"], env=environment, cwd=tmp_path,
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    time.sleep(6)
    process.send_signal(number)
    # Every worker holds a copy of the pipe, so the pipe closes after the last worker has ended.
    out, _ = process.communicate(timeout=20)
    assert process.returncode == -number and out == b""
