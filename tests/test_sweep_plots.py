"""Plots of a sweep: accumulated statistics equal NumPy's on all rows, for any division."""

import json

import matplotlib
import msgspec
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from sweep_cases import case, manifest

from jaxhil.simulation.contact_plot import save_figure
from jaxhil.simulation.gain_file import check_document
from tuning.__main__ import main
from tuning.gain_file import write_gain_file
from tuning.plots.scenarios import UNENDED, plot_failure_region
from tuning.plots.sweep import plot_convergence, plot_error_map
from tuning.statistics.intervals import binomial_interval, replicate_interval
from tuning.statistics.quantiles import BIN_EDGES
from tuning.sweeps import plot_statistics
from tuning.sweeps.chunks import build_sweep, run_chunk
from tuning.sweeps.columns import CONTACT_STATUSES, SCENARIO_OUTCOMES
from tuning.sweeps.plot_statistics import (
    add_to_statistics,
    build_empty_statistics,
    compute_error_quantile,
    plan_statistics,
)
from tuning.sweeps.store import PLOTS

NUMBER = 96
LOST = {
    "contact.stiffness": {"distribution": "loguniform", "factor": [0.3, 3.0]},
    # The sensor reads almost nothing, so some bodies are never stopped.
    "rig.force_sensor.range": {"distribution": "loguniform", "low": 1e-7, "high": 1e3},
}


def ran(document, **choices):
    made = manifest(document, NUMBER, **choices)
    return made, check_document(document).mechanism, run_chunk(build_sweep(made), 0, NUMBER)


@pytest.fixture(scope="module")
def usual():
    made, mechanism, rows = ran(case(2, "phase_lead"), chunk=NUMBER, limit=0.2)
    size = np.abs(rows["worst_error"])
    return made, mechanism, {**rows, "failed": size > np.quantile(size, 0.6)}


@pytest.fixture(scope="module")
def lost():
    return ran(
        case(2, force_sensor={"range": 1.0}, uncertainty=LOST), chunk=NUMBER, limit=1.5, sampling="sobol"
    )


@pytest.fixture(params=["usual", "lost"])
def swept(request):
    return request.getfixturevalue(request.param)


@pytest.fixture
def few_points(monkeypatch):
    monkeypatch.setattr(plot_statistics, "MAX_POINTS", 10)
    monkeypatch.setattr(plot_statistics, "MAX_FAILED_POINTS", 20)


def accumulated(plan, rows, cuts):
    result = build_empty_statistics(plan)
    for first, until in cuts:
        result = add_to_statistics(plan, result, {name: values[first:until] for name, values in rows.items()})
    return result


def flat(found):
    return [found.sizes, found.seen, found.failures, *found.points]


@pytest.mark.parametrize(
    "cuts",
    [[(n, n + 1) for n in range(NUMBER)], [(0, 1), (1, 1), (1, 37), (37, NUMBER)], [(60, NUMBER), (0, 60)]],
)
def test_sweep_plots_do_not_depend_on_division_into_chunks(swept, few_points, cuts):
    made, mechanism, rows = swept
    plan = plan_statistics(made, mechanism, rows)
    whole = accumulated(plan, rows, [(0, NUMBER)])
    for one, other in zip(flat(whole), flat(accumulated(plan, rows, cuts)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_sweep_plots_prefer_stiffness_and_force_delay_as_axes(usual):
    made, mechanism, rows = usual
    plan = plan_statistics(made, mechanism, rows)
    assert [one.label for one in plan.per_contact] == ["contact stiffness [kN/m]", "force delay [ms]"]
    assert all(one.low < np.median(one.values(rows)) < one.high for one in plan.per_contact)


def test_plotted_inputs_are_those_with_strongest_rank_correlation(lost):
    made, mechanism, rows = lost
    assert plan_statistics(made, mechanism, rows).per_scenario[1].columns == ("rig.force_sensor.range",)
    # The plan is given sensitivities that differ from the true ones.
    size = rows["approach.phase_2"]
    made_up = {**rows, "worst_error": size, "outcome": np.zeros(NUMBER, int)}
    assert plan_statistics(made, mechanism, made_up).per_scenario[1].columns == ("approach.phase_2",)


def test_accumulated_plot_counts_equal_histogram_of_all_sweep_rows(usual):
    made, mechanism, rows = usual
    plan = plan_statistics(made, mechanism, rows)
    sizes = accumulated(plan, rows, [(0, NUMBER)]).sizes
    sample, edges = [], [one.edges(plan.cells) for one in plan.per_contact]
    for number in (1, 2):
        across = np.clip(1e-3 * rows["contact.stiffness_1"], edges[0][0], edges[0][-1])
        up = np.clip(1e3 * rows["rig.force_sensor.delay"], edges[1][0], edges[1][-1])
        sample.append(np.stack([across, up, np.abs(rows[f"error_{number}"])], axis=1))
    inner = sizes[..., 1:-1]
    direct, _ = np.histogramdd(np.concatenate(sample), bins=[*edges, BIN_EDGES])
    np.testing.assert_array_equal(inner, direct)
    assert inner.sum() == sizes.sum() == 2 * NUMBER and np.count_nonzero(inner) > 50


def test_plotted_quantile_equals_quantile_of_all_values():
    values = np.abs(np.random.default_rng(0).standard_normal(3000)) * 10.0 ** np.linspace(-4, 0, 3000)
    counts = np.bincount(np.searchsorted(BIN_EDGES, values, side="right"), minlength=len(BIN_EDGES) + 1)
    for order in (0.5, 0.95, 0.99):
        direct = np.quantile(values, order, method="inverted_cdf")
        assert compute_error_quantile(counts, order, 20) == pytest.approx(direct, rel=0.005)
    assert np.isnan(compute_error_quantile(counts, 0.5, 3001)) and np.isnan(
        compute_error_quantile(0 * counts, 0.5, 0)
    )
    counts[-1] = 200
    assert compute_error_quantile(counts, 0.95, 20) == np.inf and np.isfinite(
        compute_error_quantile(counts, 0.9, 20)
    )


def test_contact_without_end_has_infinite_error_and_later_contacts_are_ignored(lost):
    made, mechanism, rows = lost
    plan = plan_statistics(made, mechanism, rows)
    result = accumulated(plan, rows, [(0, NUMBER)])
    ended = [rows[f"status_{number}"] == CONTACT_STATUSES.index("ok") for number in (1, 2)]
    first, second = np.sum(~ended[0]), np.sum(ended[0] & ~ended[1])
    assert first > 10
    assert result.sizes[..., -1].sum() == first + second
    assert result.sizes.sum() == NUMBER + ended[0].sum()
    bad = rows["outcome"] > SCENARIO_OUTCOMES.index("saturated")
    np.testing.assert_array_equal(np.isinf(result.points.size), bad)


def test_convergence_plot_counts_failures_up_to_each_plotted_scenario(swept):
    made, mechanism, rows = swept
    plan = plan_statistics(made, mechanism, rows)
    result = accumulated(plan, rows, [(0, NUMBER)])
    assert (result.scenarios, result.failed) == (NUMBER, rows["failed"].sum())
    assert plan.looks[-1] == NUMBER // plan.replicates * plan.replicates
    assert not np.any(plan.looks % plan.replicates)
    counted = np.cumsum(result.failures, axis=0)
    for look, each in zip(plan.looks, counted, strict=False):
        direct = [rows["failed"][:look][k :: plan.replicates].sum() for k in range(plan.replicates)]
        np.testing.assert_array_equal(each, direct)


def test_plotted_points_are_the_first_scenarios_and_the_first_failures(usual, few_points):
    made, mechanism, rows = usual
    result = accumulated(plan_statistics(made, mechanism, rows), rows, [(0, NUMBER)])
    failed = np.flatnonzero(rows["failed"])[:20]
    wanted = np.union1d(np.arange(10), failed)
    assert len(wanted) > 20
    np.testing.assert_array_equal(result.points.index, wanted)
    np.testing.assert_array_equal(result.points.size, np.abs(rows["worst_error"])[wanted])
    np.testing.assert_array_equal(result.points.inputs[1], 1e3 * rows["rig.force_sensor.delay"][wanted])


def test_convergence_plot_ends_at_the_probability_of_the_verdict(swept):
    made, mechanism, rows = swept
    plan = plan_statistics(made, mechanism, rows)
    result = accumulated(plan, rows, [(0, NUMBER)])
    figure = plot_convergence(plan, result, made, "name")
    axes = figure.axes[0]
    drawn = {line.get_label(): line.get_data() for line in axes.lines}
    (number,), (share,) = [
        [values[-1]] for label, pair in drawn.items() if label.startswith("share") for values in pair
    ]
    assert number == plan.looks[-1] and share == np.mean(rows["failed"][:number])
    band = axes.collections[0].get_paths()[0].vertices
    ends = band[band[:, 0] == number][:, 1]
    failed = rows["failed"][:number]
    if plan.replicates == 1:
        interval = binomial_interval(failed.sum(), number)
    else:
        each = failed.reshape(-1, plan.replicates).sum(axis=0)
        interval = replicate_interval(each, number // plan.replicates)
    assert ends.min() == pytest.approx(float(interval.low))
    assert ends.max() == pytest.approx(float(interval.high))


@pytest.mark.parametrize("acceptable", [None, 0.5])
def test_convergence_plot_shows_final_upper_bound_without_failures(usual, acceptable):
    made, mechanism, rows = usual
    rows = {**rows, "failed": np.zeros(NUMBER, bool)}
    plan = plan_statistics(made, mechanism, rows)
    result = accumulated(plan, rows, [(0, NUMBER)])
    axes = plot_convergence(plan, result, made, "name", acceptable).axes[0]
    last = float(binomial_interval(0, NUMBER).high)
    low, high = axes.get_ylim()
    assert low < 0.9 * last and last < 0.9 * high
    labels = [collection.get_label() for collection in axes.collections]
    assert f"95 % at a number fixed beforehand, last 0 to {last:.3g}" in labels


def test_sweep_plots_ignore_user_matplotlib_settings(usual, tmp_path):
    made, mechanism, rows = usual
    plan = plan_statistics(made, mechanism, rows)
    result = accumulated(plan, rows, [(0, NUMBER)])

    def drawn(name):
        figures = [draw(plan, result, made, "n") for draw in (plot_error_map, plot_failure_region)]
        paths = [tmp_path / f"{name}-{index}.png" for index in range(2)]
        for figure, path in zip(figures, paths, strict=True):
            save_figure(figure, path)
        return [path.read_bytes() for path in paths]

    usually = drawn("usual")
    settings = {"figure.constrained_layout.use": True, "font.size": 20, "axes.facecolor": "red"}
    with matplotlib.rc_context({**settings, "savefig.dpi": 30, "lines.linewidth": 9}):
        assert drawn("other") == usually
        assert matplotlib.rcParams["font.size"] == 20


@pytest.fixture(scope="module")
def phases():
    return ran(case(1, uncertainty={}), chunk=NUMBER)


SELDOM = [("phases", 0.0), ("phases", 1e-9), ("phases", 1e9), ("lost", 0.2), ("lost", None), ("lost", 1e-9)]


@pytest.mark.parametrize(
    "name, limit",
    [
        pytest.param(name, limit, marks=pytest.mark.slow if (name, limit) in SELDOM else ())
        for name in ("phases", "usual", "lost")
        for limit in (0.2, 0.0, None, 1e-9, 1e9)
    ],
)
def test_every_axis_of_sweep_plots_is_labelled_with_unit(request, name, limit):
    made, mechanism, rows = request.getfixturevalue(name)
    made = msgspec.structs.replace(made, limit=limit)
    plan = plan_statistics(made, mechanism, rows)
    assert len(plan.per_contact) == (1 if name == "phases" else 2)
    result = accumulated(plan, rows, [(0, NUMBER)])
    drawn = [draw(plan, result, made, name) for draw in (plot_error_map, plot_failure_region)]
    for figure in (*drawn, plot_convergence(plan, result, made, name, 0.1)):
        FigureCanvasAgg(figure).draw()
        named = [axes for axes in figure.axes if axes.axison]
        assert named
        # Plots above a map repeat no axis label; colour bars have a label.
        mapped = figure is drawn[0] and name != "phases"
        across = named[1:2] if mapped else named
        labels = [*(axes.get_ylabel() for axes in named), *(axes.get_xlabel() for axes in across)]
        assert all(label.endswith("]") for label in labels), labels


@pytest.mark.parametrize("limit", [0.2, None, 1e-9, 1e9])
def test_colour_scale_of_sweep_plot_is_labelled_at_both_ends(usual, limit):
    made, mechanism, rows = usual
    made = msgspec.structs.replace(made, limit=limit)
    plan = plan_statistics(made, mechanism, rows)
    figure = plot_error_map(plan, accumulated(plan, rows, [(0, NUMBER)]), made, "usual")
    FigureCanvasAgg(figure).draw()
    (bar,) = (axes for axes in figure.axes if "not exceeded by 95 %" in axes.get_ylabel())
    ticks = bar.get_yticks()
    assert ticks[[0, -1]] == pytest.approx(bar.get_ylim(), rel=1e-9)
    labels = [float(text.get_text()) for text in bar.get_yticklabels()]
    assert labels == pytest.approx(ticks, rel=0.05)


def test_sweep_plot_legend_counts_failures_by_kind(lost, few_points):
    made, mechanism, rows = lost
    plan = plan_statistics(made, mechanism, rows)
    result = accumulated(plan, rows, [(0, NUMBER)])
    endless = int(np.sum(result.points.failed & np.isinf(result.points.size)))
    failed, of = int(np.sum(result.points.failed)), int(np.sum(rows["failed"]))
    assert 0 < endless < failed < of
    (legend,) = plot_failure_region(plan, result, made, "lost").legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert f"failed, every contact ended ({failed - endless} of the first {failed} of {of})" in labels
    assert f"{UNENDED} ({endless} of the first {failed} of {of})" in labels


def test_sweep_command_writes_plots_and_replaces_plots_on_resume(tmp_path, capsys):
    gains, store = tmp_path / "gains.json", tmp_path / "store"
    write_gain_file(gains, case())
    command = ["sweep", str(gains), "--scenarios", "70", "--chunk", "64", "-o", str(store), "--json"]
    main(command)
    result = json.loads(capsys.readouterr().out)
    assert result["plots"] == [str(store / name) for name in PLOTS]
    before = [path.read_bytes() for path in map(store.joinpath, PLOTS)]
    (store / PLOTS[0]).unlink()
    (store / "parts" / "part-000001.parquet").unlink()
    main([*command, "--resume"])
    assert json.loads(capsys.readouterr().out)["failed"] == result["failed"]
    assert [path.read_bytes() for path in map(store.joinpath, PLOTS)] == before
    assert main(command) == 2 and "--resume" in capsys.readouterr().err
