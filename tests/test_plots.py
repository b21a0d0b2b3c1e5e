"""Plots: labels and units, reproducible files, and the ideal contact as reference."""

import ast
import math
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from lanes import QUICK
from matplotlib.colors import to_hex

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.contact_plot import CURVE_STYLES, plot_contacts, save_figure
from jaxhil.simulation.metrics import Metrics
from jaxhil.simulation.motion_curves import Curve, RunMotion, _ideal_curves
from jaxhil.simulation.outcome import Outcome, parameters_by_slot
from jaxhil.simulation.scenario import build_scenarios
from tuning.gains.multistart_solver import StartResult
from tuning.gains.pareto import ParetoFront, ParetoPoint
from tuning.gains.settings import TuneSettings
from tuning.gains.tune import TuneResult, compute_error_metrics
from tuning.plots.one_contact import describe_contact, plot_one_contact
from tuning.plots.tuning_results import errors_plot, front_plot, loss_plot

LANES = 40


def result(error_size=(0.5, 0.05, 0.005)):
    """Return a tuning result with random errors."""
    mechanism = load("varying").mechanism
    scenarios = build_scenarios(mechanism, draw(mechanism, LANES, 1), 1)
    generator = np.random.default_rng(0)
    shape = scenarios.phase.shape
    outcomes = {}
    for name, size in zip(("before", "literature", "tuned"), error_size, strict=True):
        number = np.arange(shape[0])[:, None] + np.zeros(shape)
        numbers = {field: np.ones(shape) for field in Metrics._fields}
        numbers["approach_velocity"] = np.full(shape, 0.005)
        wanted = number < mechanism.approach.contacts
        outcomes[name] = Outcome(
            metrics=Metrics(**numbers),
            reference_restitution=np.ones(shape),
            reference_peak_force=0.005 * np.sqrt(scenarios.contact.stiffness * scenarios.equivalent_mass),
            reference_duration=np.ones(shape),
            error=size * generator.standard_normal(shape),
            peak_ratio=np.ones(shape),
            chatter=np.zeros(shape),
            is_scheduled=wanted,
            good=wanted,
            is_unlike_ideal=np.zeros(shape, bool),
        )
    summaries = {name: compute_error_metrics(outcome) for name, outcome in outcomes.items()}
    starts = [StartResult("converged", 3, 0.1 / n, [1.0, 0.5, 0.1 / n], {}) for n in (1, 3, 2)]
    return TuneResult(
        "phase_lead", mechanism, {}, {}, summaries, summaries, starts, outcomes, scenarios, TuneSettings()
    )


def pieces(contacts=2):
    time = np.linspace(-0.02, 0.2, 50)
    force = 30 * np.maximum(np.sin(np.pi * time / 0.17), 0)

    def curve(scale):
        return Curve(0.005 * scale, time, scale * force, 1e-3 * scale * time, force, time)

    curves = {"ideal": curve(1.0), "before": curve(1.4), "tuned": curve(1.001)}
    return [RunMotion(f"contact {n + 1}", (0.0,), curves) for n in range(contacts)]


def labels(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_error_plot_has_units_and_a_legend():
    left_axes, right_axes = errors_plot(result(), 0.01).axes
    assert "|e - e*|" in left_axes.get_xlabel() and "share" in left_axes.get_ylabel()
    assert "[Hz]" in right_axes.get_xlabel() and "divergence" in right_axes.get_ylabel()
    assert labels(left_axes) == ["before: no compensation", "literature's rule", "tuned", "limit 0.01"]
    assert labels(right_axes)[-1] == "within 0.01"


def test_exceedance_curve_is_share_of_errors_above_each_value():
    made = result()
    axes = errors_plot(made, 0.01).axes[0]
    line = next(line for line in axes.lines if line.get_label() == "tuned")
    size, share = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
    outcome = made.outcomes["tuned"]
    errors = np.abs(outcome.error[outcome.good])
    for place in (0, 10, -1):
        assert share[place] == pytest.approx(np.mean(errors >= size[place]))


def test_plotted_contact_frequency_equals_that_of_linear_contact():
    made = result()
    right = errors_plot(made, 0.01).axes[1]
    points = np.asarray(right.lines[0].get_xdata())
    stiffness = made.scenarios.contact.stiffness[: made.mechanism.approach.contacts]
    expected = np.sqrt(stiffness / made.scenarios.equivalent_mass) / (2 * math.pi)
    np.testing.assert_allclose(np.sort(points), np.sort(expected.ravel()), rtol=1e-12)


@pytest.mark.parametrize("limit", [0.0, 0.01, math.inf])
def test_error_plot_accepts_any_limit_and_no_errors_at_all(limit, tmp_path):
    save_figure(errors_plot(result((0.5, 0.0, 0.0)), limit), tmp_path / "errors.png")
    made = result()
    nothing = {name: one._replace(good=one.good & False) for name, one in made.outcomes.items()}
    made.outcomes.update(nothing)
    save_figure(errors_plot(made, limit), tmp_path / "nothing.png")


def test_best_optimisation_start_is_highlighted_in_the_plot():
    (axes,) = loss_plot(result()).axes
    assert "log" == axes.get_yscale() and "step" in axes.get_xlabel() and "rms" in axes.get_ylabel()
    assert set(labels(axes)) == {"start at the literature's gains", "best start", "other starts"}
    best = next(line for line in axes.lines if line.get_label() == "best start")
    assert np.asarray(best.get_ydata())[-1] == pytest.approx(0.1 / 3)


def front(places=((0.01, 3.0), (0.01, 3.0), (0.02, 2.0), (0.03, 2.5), (0.04, 1.1))):
    """Return points at (error, amplification); the third dominates the fourth."""
    made = result()

    def point(error, noise, on_front):
        one = made.figures["tuned"]
        return ParetoPoint({}, 0.1, noise, error, one, one, made.intervals, on_front)

    points = [point(*place, number != 3) for number, place in enumerate(places)]
    return made, ParetoFront(points, point(0.1, 4.0, False), point(0.012, 3.5, False))


def test_pareto_plot_has_units_point_numbers_and_literature_gains():
    made, drawn = front()
    (axes,) = front_plot(drawn, made, 0.015).axes
    assert (
        "noise" in axes.get_xlabel() and "[1]" in axes.get_xlabel() and "rms of e - e*" in axes.get_ylabel()
    )
    assert labels(axes) == [
        *("front", "dominated by another point", "literature's rule", "tuned", "limit 0.015"),
    ]
    # Points with the same result share a position.
    assert {text.get_text(): text.xy for text in axes.texts} == {
        **{"1, 2": (3.0, 0.01), "3": (2.0, 0.02), "4": (2.5, 0.03), "5": (1.1, 0.04)},
    }
    line = next(line for line in axes.lines if line.get_drawstyle() == "steps-post")
    assert list(np.asarray(line.get_xdata())) == [1.1, 2.0, 3.0, 3.0]
    colours = {to_hex(line.get_color()) for line in axes.lines if line.get_label() in labels(axes)[:4]}
    assert len(colours) == 3


@pytest.mark.parametrize("limit", [0.0, 0.01, math.inf])
def test_pareto_plot_accepts_any_number_of_points(limit, tmp_path):
    for number, places in enumerate(
        [((0.5, 1.0),) * 2, ((0.0, 1.0), (2.0, 0.9)), ((1e-3, 40.0), (1.0, 1.0))]
    ):
        made, drawn = front(places)
        save_figure(front_plot(drawn, made, limit), tmp_path / f"{number}.png")


def test_contact_plot_shows_contacts_side_by_side_with_units():
    figure = plot_contacts(pieces(), "title")
    force, _, position, _ = figure.axes
    assert "[N]" in force.get_ylabel() and "[mm]" in position.get_ylabel() and "[ms]" in position.get_xlabel()
    # The approach speed is stated for curves on which it differs visibly.
    assert force.get_title() == "contact 1, approach at 5 mm/s\n(before: 7 mm/s)"
    assert len(figure.legends) == 1
    assert "the first 4 of 6 contacts" in plot_contacts(pieces(6), "title").get_suptitle()


def test_measured_signals_are_plotted_on_request():
    def measured(figure):
        return [line for line in figure.axes[0].lines if line.get_label() == "measured"]

    assert not measured(plot_contacts(pieces(1), "title"))
    assert len(measured(plot_contacts(pieces(1), "title", sensors="tuned"))) == 1


def test_mechanism_name_in_plot_is_not_rendered_as_formula(tmp_path):
    save_figure(plot_contacts(pieces(1), r"$\frac{1$ [bold]"), tmp_path / "plot.png")


@pytest.mark.parametrize("suffix", ["png", "pdf", "svg"])
def test_equal_data_give_equal_plot_files(suffix, tmp_path):
    for name in ("one", "two"):
        save_figure(loss_plot(result()), tmp_path / f"{name}.{suffix}")
    assert (tmp_path / f"one.{suffix}").read_bytes() == (tmp_path / f"two.{suffix}").read_bytes()


def test_plot_colours_and_line_styles_differ():
    compared = [CURVE_STYLES[name] for name in ("before", "literature", "tuned")]
    assert len({to_hex(colour) for colour, _, _ in compared}) == 3
    assert len({line for _, line, _ in compared}) == 3


@pytest.mark.parametrize("name", ["rig-300kg", "claw-350kg", "layered"])
def test_plotted_reference_motion_equals_ideal_contact(name):
    mechanism = load(name).mechanism
    scenarios = build_scenarios(mechanism, {"approach.phase": np.full(1, 0.5)})
    velocity = 0.007
    until = Curve(velocity, np.array([0.4]), np.zeros(1), np.zeros(1), None, None)
    (curve,) = _ideal_curves(mechanism, scenarios, [until])
    contact = parameters_by_slot(jax.tree.map(jax.numpy.asarray, scenarios.contact))
    like = jax.numpy.full(scenarios.phase.shape, velocity)
    of_law = jax.jit(CONTACT_LAWS[mechanism.contact.law].ideal_contact, compiler_options=QUICK)
    reference = of_law(contact, 0 * like + mechanism.bodies.mass, like)
    assert np.max(curve.force) == pytest.approx(float(reference.peak_force[0, 0]), rel=2e-3)
    rebound = -np.diff(curve.position)[-1] / np.diff(curve.time)[-1]
    assert rebound == pytest.approx(velocity * float(reference.restitution[0, 0]), rel=2e-3)


ROOT = Path(__file__).resolve().parents[1]
DRAWING = [
    path
    for package in ("jaxhil", "tuning")
    for path in sorted((ROOT / package).rglob("*.py"))
    if "matplotlib" in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("path", DRAWING, ids=lambda path: "/".join(path.parts[-2:]))
def test_all_plots_use_the_same_colours_and_have_units(path):
    counted = ("", "solver step", "contact")
    for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        for keyword in call.keywords if isinstance(call, ast.Call) else ():
            if not isinstance(keyword.value, ast.Constant) or not isinstance(keyword.value.value, str):
                continue
            text = keyword.value.value
            if "color" in (keyword.arg or ""):
                assert re.fullmatch(r"0\.\d+|white|none", text), text
            elif keyword.arg in ("xlabel", "ylabel"):
                assert re.search(r"\[.+\]", text) or text in counted, text


def test_one_contact_plot_states_restitution_of_each_curve():
    time = np.array([-0.1, 0.0, 0.1, 0.2, 0.3, 0.4])
    fast = 1e-3 * np.array([-1.0, 0.0, 1.0, -0.0, -1.5, -3.0])
    slow = 1e-3 * np.array([-1.0, 0.0, 1.0, 0.1, -0.8, -1.7])
    curves = {
        name: Curve(0.01, time, np.zeros(6), position, None, None)
        for name, position in (("ideal", slow), ("before", fast), ("tuned", slow))
    }
    motion = RunMotion("contact 1", (0.0,), curves)
    figure = plot_one_contact(motion, "rig")
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert {"ideal contact: e = 0.90", "before, no compensation: e = 1.50", "after tuning: e = 0.90"} <= {
        *texts
    }
    assert "1.50 times as fast" in describe_contact(motion)
    assert describe_contact(motion._replace(surfaces=(0.0, -0.01))) is None
