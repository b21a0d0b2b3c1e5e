"""Six axes in `jaxhil compare` and `jaxhil map`: metrics, tables, plots, agreement with single runs."""

import json

import jax
import numpy as np
import pytest

import jaxhil as package
import tuning
from jaxhil.simulation import metrics
from jaxhil.simulation.outcome import Outcome
from jaxhil.sixdof.six_axes import SIX_AXES, SixAxes
from tuning.benchmark.comparison import CompensatorMetrics
from tuning.benchmark.six_axis_runs import SixAxisScenarioSet, build_six_axis_scenario_set
from tuning.benchmark.tables import build_mechanism_table
from tuning.plots.comparison import plot_errors
from tuning.stability_map import grid
from tuning.terminal import emit

FILE = "probe-drogue"


def outcome_with_errors(energy, twist, status, peak_ratio):
    """Return the outcome of scenarios with one episode: first the energy errors, then the twist errors."""
    status = np.array([status, status])
    ones = np.ones(status.shape)
    values = dict.fromkeys(metrics.Metrics._fields, ones) | {"status": status}
    return Outcome(
        metrics=metrics.Metrics(**values),
        reference_restitution=ones,
        reference_peak_force=ones,
        reference_duration=ones,
        error=np.array([energy, twist]),
        peak_ratio=np.array([peak_ratio, peak_ratio]),
        chatter=0 * ones,
        is_scheduled=status != metrics.NOT_REACHED,
        good=status == metrics.OK,
        is_unlike_ideal=ones < 0,
    )


@pytest.fixture
def evaluated(monkeypatch):
    """Return the metrics of four scenarios: two good ones, one that did not end, and one without a touch."""
    status = [metrics.OK, metrics.OK, metrics.TIMEOUT, metrics.NOT_REACHED]
    outcome = outcome_with_errors([0.3, -0.4, 9.0, 9.0], [0.03, 0.1, 9.0, 9.0], status, [1.0, 1.5, 9.0, 9.0])
    monkeypatch.setattr(SixAxes, "evaluate", lambda *_: outcome)
    mechanism = package.load(FILE)
    scenes = SixAxisScenarioSet(mechanism, SIX_AXES.scenarios(mechanism, {"target.mass": np.ones(4)}))
    return scenes.evaluate("none", {}, 0.05, 0)


def test_six_axis_comparison_states_energy_and_twist_errors(evaluated):
    values = {name: estimate.value for name, estimate in evaluated.items()}
    assert values["energy_rms"] == pytest.approx(np.hypot(0.3, 0.4) / np.sqrt(2))
    assert values["rms"] == pytest.approx(np.hypot(0.03, 0.1) / np.sqrt(2)) and values["worst"] == 0.1
    assert values["p99"] == pytest.approx(0.0993) and values["peak"] == pytest.approx(1.495)
    # One scenario has an error beyond the limit, one has not ended.
    assert values["not_ended"] == 1 and values["failures"] == 0.5
    assert np.isnan(evaluated["rms"].low), "an rms error without the episode that did not end has no interval"


def test_six_axis_comparison_table_has_both_errors_in_percent(evaluated, capsys):
    results = [CompensatorMetrics("none", "m", {}, {"literature": evaluated}, 6)]
    assert plot_errors(["m"], {"m": results}, 0.05).axes[0].get_xlabel() == "rms of twist error [%]"
    emit(build_mechanism_table("m", results))
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["none", "35.4", "7.38", "9.93", "10", "50", "1.5", "1"] in rows


def test_six_axis_map_varies_the_keys_of_its_axes(monkeypatch, tmp_path):
    monkeypatch.setattr(grid, "LINE_POINTS", 3)

    def errors(model, loop, gains, scenarios, at_least):
        delay, mass = (np.asarray(v) for v in (scenarios.sensor.delay, scenarios.bodies.chaser.mass))
        assert np.all(scenarios.key == scenarios.key[:, :1]), "points differ in noise"
        twist = 10 * delay * (mass / 420.0)
        return np.stack([twist, twist, twist, twist, 0 * twist])

    monkeypatch.setattr(grid, "run_tile", errors)
    result = tuning.map(
        FILE, "rig.force_sensor.delay=0.002:0.008", "chaser.mass=210:840", points=3, folder=tmp_path
    )
    expected = 10 * np.outer([210 / 420, 525 / 420, 2.0], [0.002, 0.005, 0.008])
    np.testing.assert_allclose(result.error, expected, rtol=1e-12)
    document = json.loads((tmp_path / "map.json").read_text())
    assert document["axes"] == 6 and document["limit"] == 0.05
    assert document["theory"]["none_because"] == document["spectral_radius"]["none_because"]
    assert document["theory"]["none_because"] == "closed forms and growth rates exist for one axis only"
    # The error at the nominal point is 10 times the delay of 3.7 ms; the limit is reached at 5 ms.
    assert document["nominal"]["error"] == pytest.approx(0.037)
    margins = document["nominal"]["margins"]["error"]
    assert margins["x"] == {"low": None, "high": pytest.approx(0.005)}
    assert margins["y"]["high"] == pytest.approx(420 * 0.05 / 0.037)
    assert (tmp_path / "map.png").stat().st_size > 20_000


def test_map_point_has_no_error_if_nothing_touched_or_a_contact_did_not_end():
    status = [metrics.OK, metrics.TIMEOUT, metrics.NOT_REACHED]
    outcome = outcome_with_errors([0.0] * 3, [0.1, 0.2, 0.3], status, [1.0] * 3)
    worst = grid._worst_contact(SIX_AXES.select_verdict_error(outcome))
    np.testing.assert_array_equal(worst[1], [0.1, np.nan, np.nan])


@pytest.mark.slow
def test_six_axis_map_equals_single_runs():
    x, y = "rig.force_sensor.delay=0.002:0.005", "contact.tip.stiffness=2e6:4e6"
    result = tuning.map(FILE, x, y, "phase_lead", points=2)
    for row, stiffness in enumerate(result.y):
        for column, delay in enumerate(result.x):
            changes = {"rig.force_sensor.delay": delay, "contact.tip.stiffness": stiffness}
            changed, gains = package.load(FILE, changes), result.document["gains"]
            [episode] = package.simulate(changed, "phase_lead", gains).episodes
            np.testing.assert_allclose(result.error[row, column], episode.twist_error, rtol=1e-6)


@pytest.mark.slow
def test_six_axis_compare_tunes_and_evaluates_on_equal_draws(jaxhil, tmp_path):
    ran = jaxhil(
        "compare", FILE, "--compensators", "none", "phase_lead", "--scenarios", 8, "--evaluated", 16,
        "--json", "-o", tmp_path,
    )  # fmt: skip
    assert ran.code == 0, ran.err
    document = json.loads(ran.out)
    assert document["axes"] == 6 and document["limit"] == 0.05 and document["transparency"] is None
    [mechanism] = document["mechanisms"]
    none, lead = (entry["figures"] for entry in mechanism["laws"])
    after, before = lead["tuned"]["rms"], lead["literature"]["rms"]
    assert after["high"] < before["low"] < none["literature"]["rms"]["value"]
    assert mechanism["winners"]["rms"] == "phase_lead" and lead["tuned"]["not_ended"]["value"] == 0
    assert (tmp_path / "errors.png").exists() and not (tmp_path / "transparency.png").exists()
    # A set that is built again has the same scenarios and ideal contacts as the comparison.
    scene = build_six_axis_scenario_set(package.load(FILE), 16, 0xFA1)
    again = scene.evaluate("none", {}, 0.05, 0)
    assert jax.tree.all(
        jax.tree.map(
            lambda value, stored: np.isclose(value, stored),
            {name: again[name].value for name in ("rms", "energy_rms", "peak")},
            {name: none["literature"][name]["value"] for name in ("rms", "energy_rms", "peak")},
        )
    )
