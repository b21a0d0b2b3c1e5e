"""Plots of a sweep's scenarios: failures and worst errors against the inputs, and the run of one scenario."""

from collections.abc import Sequence
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure

from jaxhil.simulation.contact_plot import (
    BLACK,
    SKY_BLUE,
    VERMILION,
    create_figure,
    finish_axes,
    legend_below,
    plot_contacts,
)
from tuning.plots.parts import draw_limit, set_plain_ticks, set_scale
from tuning.sweeps.chunks import SweepProgram
from tuning.sweeps.manifest import Manifest
from tuning.sweeps.plot_statistics import PlotInput, PlotPlan, PlotPoints, PlotStatistics
from tuning.sweeps.replay import compute_motion, record_six_axes

# Labels of the points; the count of points is added to them.
FAILED, UNENDED = "failed", "failed, a contact did not end (drawn at the upper edge)"


def scenario_plot(sweep: SweepProgram, index: int, title: str) -> Figure:
    """Plot the run of one scenario of a sweep, with one or six axes, over time."""
    if sweep.model.axes == 1:
        return plot_contacts(compute_motion(sweep, index), title, sensors="rig")
    from tuning.plots.six_axes import six_axes_plot

    return six_axes_plot(record_six_axes(sweep, index), title)


@matplotlib.style.context("default")
def plot_failure_region(plan: PlotPlan, regions: PlotStatistics, manifest: Manifest, name: str) -> Figure:
    """Plot scenarios as points: failures in the plane of two inputs, and worst error against each input."""
    number = len(plan.per_scenario)
    points, limit = regions.points, manifest.limit or None
    size = (13, 4.9) if number == 2 else (7, 5.3)
    title = f"{name}: {regions.failed} of {regions.scenarios} scenarios failed"
    figure = create_figure(size, title, below=1.0 if number == 2 else 1.4)
    figure.subplots_adjust(wspace=0.32)
    panels: Any = figure.subplots(1, 3 if number == 2 else 1, squeeze=False)[0]
    if number == 2:
        _draw_points(panels[0], points.inputs[0], points.inputs[1], points.failed, points.size)
        name_axis(panels[0].xaxis, plan.per_scenario[0], points.inputs[0])
        name_axis(panels[0].yaxis, plan.per_scenario[1], points.inputs[1])
    finite = points.size[np.isfinite(points.size) & (points.size > 0)]
    values = [*finite, *([limit] if limit else [])] or [1.0]
    low, high = min(values) / 1.5, max(values) * 1.5
    # Without this bound, very small errors, which are not informative, would take up most of the axis.
    low = max(low, 1e-4 * high)
    for index, quantity in enumerate(plan.per_scenario):
        axes = panels[index - number]
        shown = np.clip(np.where(np.isfinite(points.size), points.size, high), low, None)
        _draw_points(axes, points.inputs[index], shown, points.failed, points.size)
        draw_limit(axes.axhline, limit, 1.5, zorder=4)
        name_axis(axes.xaxis, quantity, points.inputs[index])
        axes.set(yscale="log", ylim=(low, high * 1.1), ylabel="worst error of the scenario |e - e*| [1]")
        set_plain_ticks(axes.yaxis, low, high)
    for axes in panels:
        finish_axes(axes, None)
    handles, labels = panels[-1].get_legend_handles_labels()
    columns = (2 if UNENDED in labels else 4) if number == 2 else (1 if UNENDED in labels else 2)
    labels = [_label_with_count(label, points, regions) for label in labels]
    style: dict[str, Any] = {"fontsize": 9, "frameon": False, "markerscale": 2}
    figure.legend(handles, labels, loc="lower center", ncols=columns, **style)
    return figure


@matplotlib.style.context("default")
def linked_scenarios(
    name: str, inputs: Sequence[Any], points: PlotPoints, limit: float | None, linked: Sequence[int]
) -> Figure:
    """Plot the worst error of scenarios against each input, with links to the plots of some scenarios.

    Args:
        name: name of the mechanism, for the title.
        inputs: inputs of the horizontal axes; if empty, the axis is the index of the scenario.
        points: scenarios.
        limit: limit of the error; None for no limit.
        linked: indices of the scenarios that get a ring with a link.
    """
    number = max(1, len(inputs))
    figure = create_figure((5.4 * number + 0.6, 4.6), f"{name}: worst error of scenarios", below=0.95)
    panels: Any = figure.subplots(1, number, squeeze=False)[0]
    positions = {int(index): column for column, index in enumerate(points.index)}
    rings_at = [positions[index] for index in linked if index in positions]
    finite = points.size[np.isfinite(points.size) & (points.size > 0)]
    high = 1.5 * max([*finite, limit or 0.0, 1e-6])
    errors = np.clip(np.where(np.isfinite(points.size), points.size, high), 1e-4 * high, None)
    for column, axes in enumerate(panels):
        across = points.inputs[column] if inputs else points.index
        for mask, label, colour, marker in (
            (~points.failed, "not failed", SKY_BLUE, "."), (points.failed, "failed", VERMILION, "x"),
        ):  # fmt: skip
            if np.any(mask):
                axes.plot(across[mask], errors[mask], linestyle="none", marker=marker, markersize=3,
                          color=colour, label=label, rasterized=True)  # fmt: skip
        rings = axes.scatter(across[rings_at], errors[rings_at], s=55, facecolors=(1, 1, 1, 0.6),
                             edgecolors=BLACK, linewidths=1.3, label="plotted below", zorder=4)  # fmt: skip
        rings.set_urls([f"#scenario-{int(points.index[position])}" for position in rings_at])
        draw_limit(axes.axhline, limit, 1.5)
        label = inputs[column].label if inputs else "scenario [1]"
        axes.set(yscale="log", xlabel=label, ylabel="worst |e - e*| of the scenario [1]")
        set_plain_ticks(axes.yaxis, *axes.get_ylim())
        if inputs and inputs[column].logarithmic:
            axes.set_xscale("log")
            set_plain_ticks(axes.xaxis, *axes.get_xlim())
        finish_axes(axes, None)
    legend_below(figure, panels[0])
    return figure


def _draw_points(
    axes: Axes, across: np.ndarray, up: np.ndarray, failed: np.ndarray, size: np.ndarray
) -> None:
    """Draw scenarios as points at (across, up); the markers show failures and contacts that did not end."""
    ended = np.isfinite(size)
    for mask, label, colour, marker, width in (
        (~failed, "not failed", SKY_BLUE, "o", 2.0),
        (failed & ended, FAILED, VERMILION, "x", 3.5),
        (failed & ~ended, UNENDED, BLACK, "^", 3.5),
    ):
        if np.any(mask):
            style: dict[str, Any] = {"linestyle": "none", "marker": marker, "markersize": width}
            style |= {"markeredgewidth": 0.8 if marker == "x" else 0, "rasterized": True}
            axes.plot(across[mask], up[mask], color=colour, label=label, **style)


def _label_with_count(label: str, points: PlotPoints, regions: PlotStatistics) -> str:
    """Return a legend label with the number of drawn points and, if some are not drawn, the total number."""
    shown, total = int(np.sum(points.failed)), regions.failed
    unended = int(np.sum(points.failed & ~np.isfinite(points.size)))
    if label in (FAILED, UNENDED) and unended:
        total_text = "" if shown == total else f" of the first {shown} of {total}"
        if label == FAILED:
            return f"failed, every contact ended ({shown - unended}{total_text})"
        return f"{label} ({unended}{total_text})"
    if label == "not failed":
        shown, total = len(points.failed) - shown, regions.scenarios - total
    elif label != FAILED:
        return label
    return f"{label} ({total})" if shown == total else f"{label} (the first {shown} of {total})"


def name_axis(axis: Axis, quantity: PlotInput, values: Sequence[float] | np.ndarray = ()) -> None:
    """Set label, scale and limits of the axis of an input, with a margin for the markers of `values`."""
    axis.set_label_text(quantity.label)
    low, high = float(np.min(values, initial=quantity.low)), float(np.max(values, initial=quantity.high))
    axes, across = axis.axes, axis is axis.axes.xaxis
    limits: Any = axes.set_xlim if across else axes.set_ylim
    set_scale(axis, low, high, quantity.logarithmic)
    margin = 0.02 if len(values) else 0.0
    ends = np.log([low, high]) if quantity.logarithmic else np.array([low, high])
    ends = ends + margin * (ends[1] - ends[0]) * np.array([-1, 1])
    limits(*(np.exp(ends) if quantity.logarithmic else ends))
