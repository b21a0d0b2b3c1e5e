"""Pictures of a sweep: restitution error over its inputs, the failure region, convergence of the estimate.

Written into the store's folder once its parts are there; they say nothing that the rows do not.
"""

from collections.abc import Sequence
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
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxhil.files import writing
from jaxhil.simulation.contact_plot import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    finish,
    new_figure,
    save,
)
from tuning.statistics.intervals import binomial_interval, confidence_sequence, replicate_interval
from tuning.sweeps.manifest import Manifest, loaded_gains
from tuning.sweeps.regions import Input, Plan, Points, Regions, add_rows, empty_regions, make_plan, quantile
from tuning.sweeps.store import PICTURES, Store, kept_part

FEW = 20  # contacts of a cell below which it has no quantile: a 95th percentile needs as many
FAILED, UNENDED = "failed", "failed, a contact did not end: drawn at the top"
# What errors and contacts are called in six axes.
IN_SPACE = {
    "|e - e*|": "|error|",
    "restitution error": "errors",
    "a contact": "an episode",
    "contacts": "errors",
}
# Every quantile of the profile: its order, label, colour, line.
PROFILE = (
    (0.5, "half of the contacts", SKY, "-"),
    (0.95, "95 %", BLUE, "-"),
    (0.99, "99 %", ORANGE, "-."),
)


def draw_store(store: Store, acceptable: float | None = None) -> dict[str, Figure]:
    """The pictures by the names of their files, of the parts up to the first that is missing.

    One part at a time is read. `acceptable`, a probability, is drawn where the estimate converges.
    """
    manifest, mechanism = store.manifest, loaded_gains(store.manifest).mechanism
    plan = regions = None
    for part in range(manifest.parts):
        rows = kept_part(store, part)
        if rows is None:
            break
        plan = plan or make_plan(manifest, mechanism, rows)
        regions = add_rows(plan, regions or empty_regions(plan), rows)
    if plan is None or regions is None:
        return {}
    drawn = (
        error_map(plan, regions, manifest, mechanism.name),
        failure_region(plan, regions, manifest, mechanism.name),
        convergence(plan, regions, manifest, mechanism.name, acceptable),
    )
    if manifest.axes == 6:
        for figure in drawn:
            _say_in_space(figure)
    return dict(zip(PICTURES, drawn, strict=True))


def _say_in_space(figure: Figure) -> None:
    """Call an error what it is in six axes, where an episode has two."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        said = text.get_text()
        for one, other in IN_SPACE.items():
            said = said.replace(one, other)
        text.set_text(said)


def write_pictures(store: Store, acceptable: float | None = None) -> list[str]:
    """Draw and write the pictures; their paths. Raises `InputError` when one cannot be written."""
    paths = []
    for name, figure in draw_store(store, acceptable).items():
        path = Path(store.folder) / name
        with writing(path):
            save(figure, path)
        paths.append(str(path))
    return paths


@matplotlib.style.context("default")
def error_map(plan: Plan, regions: Regions, manifest: Manifest, name: str) -> Figure:
    """Quantiles of |e - e*| over the first input and, as a map, over both."""
    figure = new_figure((8.6, 7.4), f"{name}: restitution error of {regions.scenarios} scenarios", below=0.85)
    two = len(plan.per_contact) == 2
    figure.subplots_adjust(left=0.095, right=0.88, hspace=0.12, wspace=0.03)
    grid: Any = figure.subplots(2 if two else 1, 2, squeeze=False, gridspec_kw={"width_ratios": (40, 1)})
    grid[0, 1].axis("off")
    if not plan.per_contact:
        finish(grid[0, 0], None)
        return figure
    first, limit = plan.per_contact[0], _drawn_limit(manifest)
    _draw_profile(grid[0, 0], first, plan.cells, regions.sizes, limit)
    if two:
        _draw_map(figure, grid[1, 0], grid[1, 1], plan, regions.sizes, limit)
        grid[0, 0].set_xlim(grid[1, 0].get_xlim())
        grid[0, 0].tick_params(labelbottom=False)
    grid[-1, 0].set_xlabel(first.label)
    return figure


@matplotlib.style.context("default")
def failure_region(plan: Plan, regions: Regions, manifest: Manifest, name: str) -> Figure:
    """Scenarios as points: which failed, over both inputs, and the worst error over each."""
    number = len(plan.per_scenario)
    points, limit = regions.points, _drawn_limit(manifest)
    size = (13, 4.9) if number == 2 else (7, 5.3)
    said = f"{regions.failed} of {regions.scenarios} scenarios failed"
    figure = new_figure(size, f"{name}: {said}", below=1.0 if number == 2 else 1.4)
    figure.subplots_adjust(wspace=0.32)
    panels: Any = figure.subplots(1, 3 if number == 2 else 1, squeeze=False)[0]
    if number == 2:
        _draw_points(panels[0], points.inputs[0], points.inputs[1], points.failed, points.size)
        _name_axis(panels[0].xaxis, plan.per_scenario[0], points.inputs[0])
        _name_axis(panels[0].yaxis, plan.per_scenario[1], points.inputs[1])
    finite = points.size[np.isfinite(points.size) & (points.size > 0)]
    values = [*finite, *([limit] if limit else [])] or [1.0]
    low, high = min(values) / 1.5, max(values) * 1.5
    # The smallest errors of all tell nothing and would take most of the axis.
    low = max(low, 1e-4 * high)
    for place, one in enumerate(plan.per_scenario):
        axes = panels[place - number]
        shown = np.clip(np.where(np.isfinite(points.size), points.size, high), low, None)
        _draw_points(axes, points.inputs[place], shown, points.failed, points.size)
        if limit:
            axes.axhline(
                limit, color=BLACK, linewidth=1.5, linestyle="--", label=f"limit {limit:g}", zorder=4
            )
        _name_axis(axes.xaxis, one, points.inputs[place])
        axes.set(yscale="log", ylim=(low, high * 1.1), ylabel="worst error of the scenario |e - e*| [1]")
        plain_ticks(axes.yaxis, low, high)
    for axes in panels:
        finish(axes, None)
    handles, labels = panels[-1].get_legend_handles_labels()
    columns = (2 if UNENDED in labels else 4) if number == 2 else (1 if UNENDED in labels else 2)
    labels = [_counted(label, points, regions) for label in labels]
    style: dict[str, Any] = {"fontsize": 9, "frameon": False, "markerscale": 2}
    figure.legend(handles, labels, loc="lower center", ncols=columns, **style)
    return figure


@matplotlib.style.context("default")
def convergence(
    plan: Plan, regions: Regions, manifest: Manifest, name: str, acceptable: float | None = None
) -> Figure:
    """Failure probability and its interval against the number of scenarios, in the order of the index."""
    figure = new_figure((7.6, 5.2), f"{name}: failure probability as scenarios are added", below=1.05)
    figure.subplots_adjust(right=0.93)  # the last number is a long one
    axes = figure.subplots()
    axes.set(xlabel="number of scenarios [1]", ylabel="failure probability [1]")
    looks = plan.looks[plan.looks <= regions.scenarios]
    if not len(looks):
        finish(axes, None)
        return figure
    failures = np.cumsum(regions.failures, axis=0)[: len(looks)]
    total = np.sum(failures, axis=1)
    share = total / looks
    if plan.replicates == 1:
        _, low, high = binomial_interval(total, looks)
        _, wide_low, wide_high = confidence_sequence(total, looks)
        said = "95 % at a number fixed beforehand"
    else:
        each = [replicate_interval(k, n // plan.replicates) for k, n in zip(failures, looks, strict=True)]
        low, high = np.array([one.low for one in each]), np.array([one.high for one in each])
        wide_low = wide_high = None
        said = f"95 % from {plan.replicates} scrambled Sobol replicates"
    axes.set_xscale("log")
    said += f", last {low[-1]:.3g} to {high[-1]:.3g}"
    axes.fill_between(looks, low, high, color=SKY, alpha=0.4, linewidth=0, label=said)
    if wide_low is not None and wide_high is not None:
        label = "95 % at all numbers at once: stop wherever you like"
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
    _limit_probability(axes, looks, share, low, high, acceptable)
    finish(axes, None)
    axes.set_xlim(looks[0] / 1.05, looks[-1] * 1.05)
    plain_ticks(axes.xaxis, looks[0], looks[-1])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}".replace(",", " ")))
    figure.legend(loc="lower center", fontsize=9, frameon=False, ncols=2)
    return figure


def plain_ticks(axis: Axis, low: float, high: float) -> None:
    """Ticks of a logarithmic axis as plain numbers, enough of them to read off values."""
    decades = np.log10(high / low)
    some = (1.0,) if decades > 5 else (1.0, 3.0) if decades > 2.2 else (1.0, 2.0, 5.0)
    if decades < 0.9:
        axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 2.5, 5, 10)))
    else:
        axis.set_major_locator(LogLocator(subs=some))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_profile(axes: Axes, one: Input, cells: int, sizes: np.ndarray, limit: float | None) -> None:
    """Quantiles over an input alone."""
    counts = sizes.reshape(cells, -1, sizes.shape[-1]).sum(axis=1)
    edges = one.edges(cells)
    middles = np.sqrt(edges[1:] * edges[:-1]) if one.logarithmic else (edges[1:] + edges[:-1]) / 2
    for order, label, colour, line in PROFILE:
        values = quantile(counts, order, round(1 / (1 - order)))
        shown = np.where(np.isfinite(values), values, np.nan)
        axes.plot(middles, shown, color=colour, linestyle=line, marker="o", markersize=3, label=label)
    if np.any(counts[:, -1]):
        share = np.sum(counts[:, -1]) / np.sum(counts)
        axes.plot([], [], " ", label=f"({100 * share:.2g} % did not end)")
    axes.set_yscale("log")
    if limit:
        axes.axhline(limit, color=BLACK, linewidth=1.5, linestyle="--", label=f"limit {limit:g}")
    _name_axis(axes.xaxis, one)
    axes.set(xlabel="", ylabel="|e - e*| not exceeded by [1]")
    plain_ticks(axes.yaxis, *axes.get_ylim())
    finish(axes, None)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=5, fontsize=8, frameon=False)


def _draw_map(
    figure: Figure, axes: Axes, bar: Axes, plan: Plan, sizes: np.ndarray, limit: float | None
) -> None:
    """The 95th percentile per cell; with a limit, blue within it and red beyond."""
    first, second = plan.per_contact
    values = quantile(sizes, 0.95, FEW)
    finite = values[np.isfinite(values)]
    low, high = (np.min(finite), np.max(finite)) if len(finite) else (1e-3, 1e-1)
    if limit:
        low, high = np.clip(low, limit / 100, limit / 1.5), max(high, 1.5 * limit)
        middle = float(np.log(limit / low) / np.log(high / low))
        places = (0.0, middle / 2, middle, (1 + middle) / 2, 1.0)
        anchors = list(zip(places, (BLUE, SKY, "white", ORANGE, VERMILION), strict=True))
        colours = LinearSegmentedColormap.from_list("limit", anchors)
    else:
        high = max(high, 1.5 * low)
        colours = LinearSegmentedColormap.from_list("sizes", ["white", SKY, BLUE, BLACK])
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
    _bar_ticks(bar.yaxis, low, high)
    if limit:
        bar.axhline(limit, color=BLACK, linewidth=1.5)
    _name_axis(axes.xaxis, first)
    _name_axis(axes.yaxis, second)
    handles = [Patch(color="0.8", label=f"fewer than {FEW} contacts")] if np.any(np.isnan(values)) else []
    if unended:
        handles.append(Patch(color=BLACK, label="more than 5 % did not end"))
    if handles:
        # Below the axes: cells are everywhere inside.
        figure.legend(handles=handles, loc="lower center", fontsize=8, frameon=False, ncols=2)


def _draw_points(
    axes: Axes, across: np.ndarray, up: np.ndarray, failed: np.ndarray, size: np.ndarray
) -> None:
    ended = np.isfinite(size)
    for which, label, colour, marker, width in (
        (~failed, "not failed", SKY, "o", 2.0),
        (failed & ended, FAILED, VERMILION, "x", 3.5),
        (failed & ~ended, UNENDED, BLACK, "^", 3.5),
    ):
        if np.any(which):
            style: dict[str, Any] = {"linestyle": "none", "marker": marker, "markersize": width}
            style |= {"markeredgewidth": 0.8 if marker == "x" else 0, "rasterized": True}
            axes.plot(across[which], up[which], color=colour, label=label, **style)


def _counted(label: str, points: Points, regions: Regions) -> str:
    """The label of points, with their number and what it is a part of."""
    shown, of = int(np.sum(points.failed)), regions.failed
    unended = int(np.sum(points.failed & ~np.isfinite(points.size)))
    if label in (FAILED, UNENDED) and unended:
        part = "" if shown == of else f" of the first {shown} of {of}"
        if label == FAILED:
            return f"failed, every contact ended ({shown - unended}{part})"
        return f"{label} ({unended}{part})"
    if label == "not failed":
        shown, of = len(points.failed) - shown, regions.scenarios - of
    elif label != FAILED:
        return label
    return f"{label} ({of})" if shown == of else f"{label} (the first {shown} of {of})"


def _bar_ticks(axis: Axis, low: float, high: float) -> None:
    """Ticks of a colour bar: both ends, and between them what is not too close to one."""
    places = LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(low, high)
    room = (high / low) ** 0.06
    inner = [float(place) for place in places if low * room < place < high / room]
    axis.set_major_locator(FixedLocator([low, *inner, high]))
    axis.set_minor_locator(NullLocator())
    ends = {low: f"{float(f'{low:.2g}'):g}", high: f"{float(f'{high:.2g}'):g}"}
    axis.set_major_formatter(FuncFormatter(lambda value, _: ends.get(value, f"{value:g}")))


def _limit_probability(axes: Axes, looks, share, low, high, acceptable: float | None) -> None:
    """Show the later part of the way: at first the interval is wide, whatever the end."""
    late = looks >= looks[-1] / 100
    ends = [*low[late], *high[late], *share[late], acceptable or 0.0]
    top, least = max(ends), min(value for value in ends if value > 0)
    if share[-1] > 0 and top < 20 * least:
        axes.set_ylim(max(0.0, least - 0.25 * (top - least)), min(1.0, top + 0.25 * (top - least)))
    else:
        axes.set_yscale("log")
        axes.set_ylim(least / 3, min(1.0, 3 * top))
        plain_ticks(axes.yaxis, least / 3, 3 * top)


def _name_axis(axis: Axis, one: Input, values: Sequence[float] | np.ndarray = ()) -> None:
    """Name, scale and ends of an input's axis; `values` that are to be on it, with room for their markers,
    may reach further."""
    axis.set_label_text(one.label)
    low, high = float(np.min(values, initial=one.low)), float(np.max(values, initial=one.high))
    axes, across = axis.axes, axis is axis.axes.xaxis
    scale: Any = axes.set_xscale if across else axes.set_yscale
    limits: Any = axes.set_xlim if across else axes.set_ylim
    if one.logarithmic:
        scale("log")
        plain_ticks(axis, low, high)
    else:
        axis.set_major_locator(MaxNLocator(6, steps=(1, 2, 2.5, 5, 10)))
    room = 0.02 if len(values) else 0.0
    ends = np.log([low, high]) if one.logarithmic else np.array([low, high])
    ends = ends + room * (ends[1] - ends[0]) * np.array([-1, 1])
    limits(*(np.exp(ends) if one.logarithmic else ends))


def _drawn_limit(manifest: Manifest) -> float | None:
    """A limit of 0 or none has no place on a logarithmic axis."""
    return manifest.limit if manifest.limit else None
