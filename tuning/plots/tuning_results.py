"""Plots of tuning results: errors before and after tuning, objective in each solver step, Pareto fronts."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from jaxhil.errors import to_one_line
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation.contact_plot import (
    BLACK,
    BLUE,
    CURVE_LABELS,
    CURVE_STYLES,
    GREEN,
    ORANGE,
    create_figure,
    finish_axes,
)
from tuning.gains.objective import Objective
from tuning.gains.pareto import ParetoFront
from tuning.gains.tune import TuneResult
from tuning.plots.parts import MARKERS, draw_limit, legend_above


@matplotlib.style.context("default")
def errors_plot(result: TuneResult, limit: float) -> Figure:
    """Plot the distribution of restitution errors before and after tuning, and errors against frequency."""
    figure = create_figure(
        (11, 4.6), f"{result.mechanism.name}: restitution error on fresh scenarios", above=0.75
    )
    left, right = figure.subplots(1, 2)
    # A limit of 0 or infinity cannot be drawn on a logarithmic axis.
    has_limit = 0 < limit < np.inf
    _draw_shares(left, result.outcomes, limit)
    for name, outcome in result.outcomes.items():
        if not np.any(outcome.good):
            continue
        frequency = outcome.reference_peak_force / outcome.metrics.approach_velocity / (2 * np.pi)
        frequency = frequency / result.scenarios.equivalent_mass
        style: dict[str, Any] = {"linestyle": "none", "marker": MARKERS[name], "markersize": 2.5}
        style |= {"alpha": 0.6, "markeredgewidth": 0, "rasterized": True}
        points = frequency[outcome.good], outcome.error[outcome.good]
        right.plot(*points, color=CURVE_STYLES[name][0], label=CURVE_LABELS[name], **style)
    if has_limit:
        right.axhspan(-limit, limit, color=GREEN, alpha=0.15, linewidth=0, label=f"within {limit:g}")
    left.set(xlabel="magnitude of the error |e - e*| [1]", ylabel="share of contacts with a larger error [1]")
    right.axhline(0, color=BLACK, linewidth=0.6)
    right.set_yscale("symlog", linthresh=limit if has_limit else 0.01)
    right.set(xlabel="contact frequency [Hz]", ylabel="error e - e* [1]  (above 0: divergence)")
    finish_axes(left, "lower left")
    finish_axes(right, None)
    if right.get_legend_handles_labels()[0]:
        # Inside the axes, the legend would hide points.
        legend = legend_above(right, 4, markerscale=2.5, columnspacing=1.2)
        for handle in legend.legend_handles:
            if handle is not None:
                handle.set_alpha(1 if handle.get_label() in CURVE_LABELS.values() else 0.3)
    return figure


@matplotlib.style.context("default")
def six_axis_errors_plot(result: TuneResult, limit: float) -> Figure:
    """Plot the distributions of a six-axis mechanism's energy and twist errors, before and after tuning."""
    figure = create_figure((11, 4.6), f"{result.mechanism.name}: errors on fresh scenarios", above=0.6)
    labels = {"energy_error": "magnitude of the energy error [1]", "twist_error": "twist error [1]"}
    model = choose_rig_model(result.mechanism)
    for axes, (error, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        outcomes = {name: model.by_error(outcome)[error] for name, outcome in result.outcomes.items()}
        _draw_shares(axes, outcomes, limit if error == model.verdict_error else np.inf)
        axes.set(xlabel=label, ylabel="share of episodes with a larger error [1]")
        finish_axes(axes, "lower left")
    return figure


def _error_name(result: TuneResult) -> str:
    """Return the name of the error that decides the verdict."""
    name = choose_rig_model(result.mechanism).verdict_error
    return "restitution error" if name == "error" else name.replace("_", " ")


def _draw_shares(axes: Axes, outcomes: Mapping[str, Any], limit: float) -> None:
    """Plot, against the error, the fraction of contacts with a larger error, for each set of gains."""
    shown_errors: list[float] = [limit] if 0 < limit < np.inf else []
    for name, outcome in outcomes.items():
        errors = np.sort(np.abs(outcome.error[outcome.good]))[::-1]
        if not len(errors):
            continue
        colour, line, width = CURVE_STYLES[name]
        total = int(np.sum(outcome.is_scheduled))
        # A contact that did not end counts as an infinite error, which raises the whole curve.
        share = (np.arange(1, len(errors) + 1) + total - len(errors)) / total
        style: dict[str, Any] = {"color": colour, "linestyle": line, "linewidth": width}
        axes.step(errors, share, where="post", label=CURVE_LABELS[name], **style)
        shown_errors += [float(errors[0]), float(np.percentile(errors, 2))]
    draw_limit(axes.axvline, limit)
    positive = [value for value in shown_errors if value > 0] or [1.0]
    axes.set(xscale="log", yscale="log", xlim=(min(positive) / 1.5, 1.5 * max(positive)))


@matplotlib.style.context("default")
def loss_plot(result: TuneResult) -> Figure:
    """Plot the objective against the solver's steps, one curve for each starting point."""
    figure = create_figure((7, 4.6), f"{result.mechanism.name}: tuning from {len(result.starts)} starts")
    axes = figure.subplots()
    finite = [start for start in result.starts if np.all(np.isfinite(start.history))]
    best = min(finite, key=lambda start: start.rms) if finite else None
    for number, start in enumerate(result.starts):
        steps = np.arange(1, len(start.history) + 1)
        is_first = number == 0
        colour, width = (BLUE, 2.5) if start is best else (ORANGE, 1.8) if is_first else ("0.6", 1.0)
        label = "best start" if start is best else None
        if is_first:
            label = "start at the literature's gains" + (" (best)" if start is best else "")
        elif label is None and number == next(
            (i for i, s in enumerate(result.starts) if i and s is not best), 0
        ):
            label = "other starts"
        order = 3 if start is best else 2
        axes.plot(steps, start.history, color=colour, linewidth=width, label=label, zorder=order)
        axes.plot(steps[-1:], start.history[-1:], color=colour, marker="o", markersize=4, zorder=order)
    axes.set_yscale("log")
    objective = result.settings.objective
    what = objective.name if objective == Objective(objective.name) else "objective"
    axes.set(xlabel="solver step", ylabel=f"{what} on training scenarios [1]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    finish_axes(axes, "best")
    return figure


@matplotlib.style.context("default")
def overview_plot(results: Sequence[TuneResult], limit: float) -> Figure:
    """Plot the rms error of each mechanism: uncompensated, with the literature's gains, and tuned."""
    height = 1.6 + 0.2 * len(results)
    figure = create_figure(
        (8, height), f"Restitution error of {len(results)} mechanisms on fresh scenarios", 0.9
    )
    longest = max(len(result.mechanism.name) for result in results)
    figure.subplots_adjust(left=min(0.45, (0.5 + 0.085 * min(longest, 40)) / 8))
    axes = figure.subplots()
    rows = np.arange(len(results))
    for name in ("before", "literature", "tuned"):
        rms = [result.figures[name].rms for result in results]
        style = {
            "linestyle": "none",
            "marker": MARKERS[name],
            "color": CURVE_STYLES[name][0],
            "markersize": 5,
        }
        axes.plot(rms, rows, label=CURVE_LABELS[name], **style)
    draw_limit(axes.axvline, limit)
    axes.set_yticks(
        rows, [to_one_line(r.mechanism.name, 40).replace("$", r"\$") for r in results], fontsize=8
    )
    axes.set(xscale="log", xlabel="rms of the restitution error e - e* [1]", ylim=(len(results) - 0.5, -0.5))
    finish_axes(axes, None)
    legend_above(axes, 4)
    return figure


@matplotlib.style.context("default")
def front_plot(front: ParetoFront, result: TuneResult, limit: float) -> Figure:
    """Plot a Pareto front of error and cost, with numbered points.

    The literature's gains and the gains tuned for the least error are also shown.
    """
    figure = create_figure(
        (7, 5), f"{result.mechanism.name}: {_error_name(result)} against {front.axis.name}, fresh scenarios"
    )
    axes = figure.subplots()
    best = sorted((point for point in front.points if point.on_front), key=lambda point: point.cost)
    axes.step([p.cost for p in best], [p.error for p in best], where="post", color=BLUE)
    for points, label, marker, size, edge, face in (
        (best, "front", "o", 7, BLUE, BLUE),
        ([p for p in front.points if not p.on_front], "dominated by another point", "o", 7, BLUE, "white"),
        ([front.literature], CURVE_LABELS["literature"], "s", 7, ORANGE, ORANGE),
        # The marker is open, so that a point of the front with the same gains remains visible.
        ([front.tuned], CURVE_LABELS["tuned"], "D", 10, BLACK, "none"),
    ):
        if points:
            values = [point.cost for point in points], [point.error for point in points]
            style: dict[str, Any] = {"linestyle": "none", "marker": marker, "markersize": size}
            axes.plot(*values, color=edge, markerfacecolor=face, label=label, zorder=3, **style)
    draw_limit(axes.axhline, limit)
    numbers: dict[tuple[float, float], list[str]] = {}  # equal points share one label
    for number, point in enumerate(front.points, start=1):
        numbers.setdefault(point.place, []).append(str(number))
    for index, (error, cost) in enumerate(sorted(numbers)):
        # Labels alternate above and below the points, so that they do not overlap.
        offset = {"xytext": (6, -14 if index % 2 else 6), "textcoords": "offset points"}
        axes.annotate(", ".join(numbers[error, cost]), (cost, error), fontsize=8, **offset)
    _set_log_scale(axes, "x", [point.cost for point in (*front.points, front.literature, front.tuned)])
    _set_log_scale(axes, "y", [point.error for point in (*front.points, front.literature, front.tuned)])
    axes.margins(0.08, 0.12)
    name, error = result.settings.objective.name, _error_name(result)
    error = "e - e*" if error == "restitution error" else f"the {error}"
    axes.set(xlabel=f"{front.axis.words} [1]", ylabel=f"{name} of {error} [1]")
    finish_axes(axes, "best")
    return figure


def _set_log_scale(axes: Axes, name: str, values: Sequence[float]) -> None:
    """Make axis "x" or "y" logarithmic, with plain tick labels, if its values span a factor of over 3."""
    low, high = min(values), max(values)
    if not 0 < 3 * low < high:
        return
    axes.set(**{f"{name}scale": "log"})
    axis = {"x": axes.xaxis, "y": axes.yaxis}[name]
    axis.set_minor_locator(LogLocator(subs=(2, 3, 5) if high > 5 * low else range(2, 10)))
    for set_formatter in (axis.set_major_formatter, axis.set_minor_formatter):
        set_formatter(lambda value, _: f"{value:g}")
