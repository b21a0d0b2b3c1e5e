"""Plots of a sweep: restitution error against the inputs, failure region, convergence of the probability.

The plots are computed from the stored rows, and are written to the folder of the store.
"""

from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullLocator

from jaxhil.files import report_write_errors
from jaxhil.simulation.contact_plot import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY_BLUE,
    VERMILION,
    create_figure,
    finish_axes,
    save_figure,
)
from tuning.plots.parts import draw_limit, legend_above, set_plain_ticks
from tuning.plots.scenarios import name_axis, plot_failure_region
from tuning.statistics.intervals import binomial_interval, confidence_sequence, replicate_interval
from tuning.sweeps.manifest import Manifest, load_gains
from tuning.sweeps.plot_statistics import (
    PlotInput,
    PlotPlan,
    PlotStatistics,
    compute_error_quantile,
    read_regions,
)
from tuning.sweeps.store import PLOTS, SweepStore

MIN_CONTACTS_PER_CELL = 20  # smallest number of contacts in a cell whose 95th percentile is shown
# Terms of one-axis plots, with the terms that replace them in six-axis plots.
SIX_AXIS_TERMS = {
    "|e - e*|": "|error|",
    "restitution error": "errors",
    "a contact": "an episode",
    "contacts": "errors",
}
# Order, label, colour and line style of each quantile that is plotted against the first input.
PROFILE_QUANTILES = (
    (0.5, "half of the contacts", SKY_BLUE, "-"),
    (0.95, "95 %", BLUE, "-"),
    (0.99, "99 %", ORANGE, "-."),
)


def draw_plots(store: SweepStore, acceptable: float | None = None) -> dict[str, Figure]:
    """Draw the plots of a sweep, and return them by file name.

    The plots show the stored scenarios before the first missing chunk (part of the sweep). The chunks are
    read one by one, to limit the memory. `acceptable` is a failure probability [1], drawn in the plot of
    convergence.
    """
    manifest, mechanism = store.manifest, load_gains(store.manifest).mechanism
    plan, regions = read_regions(store, mechanism)
    if plan is None or regions is None:
        return {}
    drawn = (
        plot_error_map(plan, regions, manifest, mechanism.name),
        plot_failure_region(plan, regions, manifest, mechanism.name),
        plot_convergence(plan, regions, manifest, mechanism.name, acceptable),
    )
    if manifest.axes == 6:
        for figure in drawn:
            _rename_for_six_axes(figure)
    return dict(zip(PLOTS, drawn, strict=True))


def _rename_for_six_axes(figure: Figure) -> None:
    """Replace the terms for one axis in all texts of a figure by the terms for six axes."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        label = text.get_text()
        for old, new in SIX_AXIS_TERMS.items():
            label = label.replace(old, new)
        text.set_text(label)


def write_plots(store: SweepStore, acceptable: float | None = None) -> list[str]:
    """Draw the plots of a sweep, write them to its folder, and return their paths.

    Raise `InputError` if a file cannot be written. `acceptable` is a failure probability [1], drawn in the
    plot of convergence.
    """
    paths = []
    for name, figure in draw_plots(store, acceptable).items():
        path = Path(store.folder) / name
        with report_write_errors(path):
            save_figure(figure, path)
        paths.append(str(path))
    return paths


@matplotlib.style.context("default")
def plot_error_map(plan: PlotPlan, regions: PlotStatistics, manifest: Manifest, name: str) -> Figure:
    """Plot quantiles of |e - e*| against the first input of the sampling plan.

    If the plan has two inputs, add a map of one quantile over both inputs.
    """
    figure = create_figure(
        (8.6, 7.4), f"{name}: restitution error of {regions.scenarios} scenarios", below=0.85
    )
    has_two_inputs = len(plan.per_contact) == 2
    rows = 2 if has_two_inputs else 1
    figure.subplots_adjust(left=0.095, right=0.88, hspace=0.12, wspace=0.03)
    grid: Any = figure.subplots(rows, 2, squeeze=False, gridspec_kw={"width_ratios": (40, 1)})
    grid[0, 1].axis("off")
    if not plan.per_contact:
        finish_axes(grid[0, 0], None)
        return figure
    first, limit = plan.per_contact[0], manifest.limit or None
    _draw_profile(grid[0, 0], first, plan.cells, regions.sizes, limit)
    if has_two_inputs:
        _draw_map(figure, grid[1, 0], grid[1, 1], plan, regions.sizes, limit)
        grid[0, 0].set_xlim(grid[1, 0].get_xlim())
        grid[0, 0].tick_params(labelbottom=False)
    grid[-1, 0].set_xlabel(first.label)
    return figure


@matplotlib.style.context("default")
def plot_convergence(
    plan: PlotPlan, regions: PlotStatistics, manifest: Manifest, name: str, acceptable: float | None = None
) -> Figure:
    """Plot the estimated failure probability and its 95 % interval against the number of scenarios.

    Scenarios are added in the order of their index. `acceptable` is a failure probability [1], drawn as a
    line.
    """
    figure = create_figure((7.6, 5.2), f"{name}: failure probability as scenarios are added", below=1.05)
    figure.subplots_adjust(right=0.93)  # The last tick label is long.
    axes = figure.subplots()
    axes.set(xlabel="number of scenarios [1]", ylabel="failure probability [1]")
    looks = plan.looks[plan.looks <= regions.scenarios]
    if not len(looks):
        finish_axes(axes, None)
        return figure
    failures = np.cumsum(regions.failures, axis=0)[: len(looks)]
    total = np.sum(failures, axis=1)
    share = total / looks
    if plan.replicates == 1:
        _, low, high = binomial_interval(total, looks)
        _, wide_low, wide_high = confidence_sequence(total, looks)
        text = "95 % at a number fixed beforehand"
    else:
        intervals = [
            replicate_interval(k, n // plan.replicates) for k, n in zip(failures, looks, strict=True)
        ]
        low, high = np.array([i.low for i in intervals]), np.array([i.high for i in intervals])
        wide_low = wide_high = None
        text = f"95 % from {plan.replicates} scrambled Sobol replicates"
    axes.set_xscale("log")
    text += f", last {low[-1]:.3g} to {high[-1]:.3g}"
    axes.fill_between(looks, low, high, color=SKY_BLUE, alpha=0.4, linewidth=0, label=text)
    if wide_low is not None and wide_high is not None:
        label = "95 % for all numbers together: valid for any stopping rule"
        style: dict[str, Any] = {"color": ORANGE, "linestyle": "--", "linewidth": 1.3}
        axes.plot(looks, wide_low, label=label, **style)
        axes.plot(looks, wide_high, **style)
    axes.plot(
        looks, share, color=BLUE, linewidth=1.8, label=f"share of failed scenarios, last {share[-1]:.4g}"
    )
    if acceptable:
        axes.axhline(
            acceptable, color=GREEN, linestyle=":", linewidth=1.5, label=f"acceptable {acceptable:g}"
        )
    _set_probability_limits(axes, looks, share, low, high, acceptable)
    finish_axes(axes, None)
    axes.set_xlim(looks[0] / 1.05, looks[-1] * 1.05)
    set_plain_ticks(axes.xaxis, looks[0], looks[-1])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}".replace(",", " ")))
    figure.legend(loc="lower center", fontsize=9, frameon=False, ncols=2)
    return figure


def _draw_profile(
    axes: Axes, quantity: PlotInput, cells: int, sizes: np.ndarray, limit: float | None
) -> None:
    """Draw the quantiles `PROFILE_QUANTILES` of |e - e*| against one input."""
    counts = sizes.reshape(cells, -1, sizes.shape[-1]).sum(axis=1)
    edges = quantity.edges(cells)
    middles = np.sqrt(edges[1:] * edges[:-1]) if quantity.logarithmic else (edges[1:] + edges[:-1]) / 2
    for order, label, colour, line in PROFILE_QUANTILES:
        values = compute_error_quantile(counts, order, round(1 / (1 - order)))
        shown = np.where(np.isfinite(values), values, np.nan)
        axes.plot(middles, shown, color=colour, linestyle=line, marker="o", markersize=3, label=label)
    if np.any(counts[:, -1]):
        share = np.sum(counts[:, -1]) / np.sum(counts)
        axes.plot([], [], " ", label=f"({100 * share:.2g} % did not end)")
    axes.set_yscale("log")
    draw_limit(axes.axhline, limit, 1.5)
    name_axis(axes.xaxis, quantity)
    axes.set(xlabel="", ylabel="|e - e*| not exceeded by [1]")
    set_plain_ticks(axes.yaxis, *axes.get_ylim())
    finish_axes(axes, None)
    legend_above(axes, 5)


def _draw_map(
    figure: Figure, axes: Axes, bar: Axes, plan: PlotPlan, sizes: np.ndarray, limit: float | None
) -> None:
    """Draw the 95th percentile of |e - e*| on a grid over two inputs, with colours relative to the limit.

    If there is a limit, values below the limit are blue, and values above the limit are orange to red.
    """
    first, second = plan.per_contact
    values = compute_error_quantile(sizes, 0.95, MIN_CONTACTS_PER_CELL)
    finite = values[np.isfinite(values)]
    low, high = (np.min(finite), np.max(finite)) if len(finite) else (1e-3, 1e-1)
    if limit:
        low, high = np.clip(low, limit / 100, limit / 1.5), max(high, 1.5 * limit)
        middle = float(np.log(limit / low) / np.log(high / low))
        positions = (0.0, middle / 2, middle, (1 + middle) / 2, 1.0)
        anchors = list(zip(positions, (BLUE, SKY_BLUE, "white", ORANGE, VERMILION), strict=True))
        colours = LinearSegmentedColormap.from_list("limit", anchors)
    else:
        high = max(high, 1.5 * low)
        colours = LinearSegmentedColormap.from_list("sizes", ["white", SKY_BLUE, BLUE, BLACK])
    colours = colours.with_extremes(bad="0.8", over=BLACK)
    unended = bool(np.any(np.isinf(values)))
    shown = np.ma.masked_invalid(np.where(np.isinf(values), 1e300, values))
    mesh = axes.pcolormesh(
        first.edges(plan.cells), second.edges(plan.cells), shown.T, cmap=colours, norm=LogNorm(low, high),
        rasterized=True,
    )  # fmt: skip
    below = bool(len(finite) and np.min(finite) < low)
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(
        (below, unended), "neither"
    )
    colour_bar = figure.colorbar(mesh, cax=bar, extend=extend)
    colour_bar.set_label("|e - e*| not exceeded by 95 % of contacts [1]")
    _set_bar_ticks(bar.yaxis, low, high)
    if limit:
        bar.axhline(limit, color=BLACK, linewidth=1.5)
    name_axis(axes.xaxis, first)
    name_axis(axes.yaxis, second)
    handles = (
        [Patch(color="0.8", label=f"fewer than {MIN_CONTACTS_PER_CELL} contacts")]
        if np.any(np.isnan(values))
        else []
    )
    if unended:
        handles.append(Patch(color=BLACK, label="more than 5 % did not end"))
    if handles:
        # The legend is below the axes, because the cells cover their whole area.
        figure.legend(handles=handles, loc="lower center", fontsize=8, frameon=False, ncols=2)


def _set_bar_ticks(axis: Axis, low: float, high: float) -> None:
    """Set ticks of a logarithmic colour bar at both ends, and between them where labels do not overlap."""
    values = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, high)
    gap = (high / low) ** 0.06
    inner = [float(value) for value in values if low * gap < value < high / gap]
    axis.set_major_locator(FixedLocator([low, *inner, high]))
    axis.set_minor_locator(NullLocator())
    ends = {low: f"{float(f'{low:.2g}'):g}", high: f"{float(f'{high:.2g}'):g}"}
    axis.set_major_formatter(FuncFormatter(lambda value, _: ends.get(value, f"{value:g}")))


def _set_probability_limits(axes: Axes, looks, share, low, high, acceptable: float | None) -> None:
    """Set the probability axis so that it shows the estimates from at least 1 % of the scenarios.

    Estimates from fewer scenarios have wide intervals, which would dominate the axis.
    """
    late = looks >= looks[-1] / 100
    ends = [*low[late], *high[late], *share[late], acceptable or 0.0]
    top, least = max(ends), min(value for value in ends if value > 0)
    if share[-1] > 0 and top < 20 * least:
        axes.set_ylim(max(0.0, least - 0.25 * (top - least)), min(1.0, top + 0.25 * (top - least)))
    else:
        axes.set_yscale("log")
        axes.set_ylim(least / 3, min(1.0, 3 * top))
        set_plain_ticks(axes.yaxis, least / 3, 3 * top)
