"""Plot of a stability map: error in colours, contours, theory, and margins of the nominal point."""

from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, SymLogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from jaxhil.errors import to_one_line
from jaxhil.simulation.contact_plot import BLACK, BLUE, GREEN, SKY_BLUE, VERMILION, create_figure, finish_axes
from tuning.plots.parts import set_scale
from tuning.stability_map.axes import MapAxis
from tuning.stability_map.grid import MapResults
from tuning.sweeps.plot_statistics import DISPLAY_UNITS, INPUT_LABELS

CONTOUR_ERRORS = [step * 10.0**power for power in range(-4, 2) for step in (1, 3)]  # errors at contours
MAX_COLOUR_ERROR = 10.0  # largest error on the colour scale
# Largest numbers of contours, and of ticks of the colour bar, for errors of the same sign.
MAX_CONTOURS, MAX_COLOUR_TICKS = 4, 20
PALE_ORANGE = "#F7CF85"  # orange, light enough for black lines to be visible


@matplotlib.style.context("default")
def map_plot(stability_map: MapResults, title: str, limit: float) -> Figure:
    """Plot a stability map: signed error in colours, contours of error and theory, nominal point.

    The margins of the nominal point are the ranges in which the error is at most `limit` [1].
    """
    figure = create_figure((8.6, 7.0), title)
    figure.subplots_adjust(left=0.09, right=0.88)
    axes = figure.subplots()
    x, y = (
        _in_plot_unit(axis, values)
        for axis, values in zip(stability_map.axes, (stability_map.x, stability_map.y), strict=True)
    )
    handles = _draw_error(figure, axes, stability_map, x, y, limit)
    handles += _draw_growth(axes, stability_map)
    handles += _draw_theory(axes, stability_map, x, y, limit)
    handles += _draw_nominal(axes, stability_map)
    for axis, plot_axis in zip(stability_map.axes, (axes.xaxis, axes.yaxis), strict=True):
        low, high = _in_plot_unit(axis, np.array([axis.low, axis.high]))
        # Matplotlib would read text between dollar signs as a formula.
        label = (
            f"{INPUT_LABELS.get(axis.key, to_one_line(axis.key, 60))} [{to_one_line(_plot_unit(axis), 20)}]"
        )
        plot_axis.set_label_text(label.replace("$", r"\$"))
        set_scale(plot_axis, low, high, axis.logarithmic)
        (axes.set_xlim if plot_axis is axes.xaxis else axes.set_ylim)(low, high)
    finish_axes(axes, None)
    axes.grid(False)
    figure.subplots_adjust(bottom=(0.7 + 0.22 * -(-len(handles) // 2)) / 7.0)
    figure.legend(handles=handles, loc="lower center", fontsize=8.5, frameon=False, ncols=2, handlelength=3.5)
    return figure


def _draw_error(
    figure: Figure, axes: Axes, stability_map: MapResults, x: np.ndarray, y: np.ndarray, limit: float
) -> list[Any]:
    """Draw the error in colours with contours, and return the entries for the legend."""
    error, has_sign = stability_map.error, stability_map.rig_axes == 1
    anchors = [*([BLUE, SKY_BLUE] if has_sign else []), "white", PALE_ORANGE, VERMILION]
    colours = LinearSegmentedColormap.from_list("error", anchors).with_extremes(bad="0.75")
    finite = np.abs(error[np.isfinite(error)])
    drawn = limit if 0 < limit < np.inf else 0.01
    most = float(np.clip(np.max(finite, initial=0.0), 3 * drawn, MAX_COLOUR_ERROR))
    mesh = axes.pcolormesh(
        x, y, np.ma.masked_invalid(np.clip(error, -most, most)), cmap=colours, shading="nearest",
        norm=SymLogNorm(drawn, vmin=-most if has_sign else 0.0, vmax=most), rasterized=True,
    )  # fmt: skip

    def write(value: float) -> str:
        return f"{value:+.3g}" if has_sign else f"{value:.3g}"

    bar = figure.colorbar(mesh, ax=axes, pad=0.02, fraction=0.05)
    bar.set_label(
        "largest error of a contact, e - e* [1]  (above 0: divergence)"
        if has_sign
        else "largest twist error of a contact [1]"
    )
    bar.ax.yaxis.set_major_locator(
        FixedLocator([0.0, *_contour_levels(np.array([-most * has_sign, most]), drawn, MAX_COLOUR_TICKS)])
    )
    bar.ax.yaxis.set_minor_locator(NullLocator())
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: write(value) if value else "0"))
    handles: list[Any] = []
    levels = [level for level in _contour_levels(error, drawn) if abs(level) != drawn]
    if levels:
        lines = axes.contour(x, y, error, levels=levels, colors=BLACK, linewidths=0.8, linestyles="-")
        axes.clabel(lines, fmt=write, fontsize=8)
        handles.append(Line2D([], [], color=BLACK, linewidth=0.8, label="contours of the error"))
    if np.any(finite <= drawn) and np.any(finite > drawn):
        axes.contour(x, y, np.abs(error), levels=[drawn], colors=BLACK, linewidths=2.2)
        handles.append(Line2D([], [], color=BLACK, linewidth=2.2, label=f"error of {drawn:g}, the limit"))
    if np.any(~np.isfinite(error)):
        handles.append(Patch(color="0.75", label=describe_missing_error(stability_map.rig_axes)))
    return handles


def describe_missing_error(axes: int) -> str:
    """Return a text that states why a point of a map for 1 or 6 axes has no error."""
    return "a contact did not end" if axes == 1 else "a contact did not end, or nothing touched"


def _draw_theory(
    axes: Axes, stability_map: MapResults, x: np.ndarray, y: np.ndarray, limit: float
) -> list[Any]:
    """Draw the contours of the closed-form errors, and return the entries for the legend."""
    handles: list[Any] = []
    drawn = limit if 0 < limit < np.inf else 0.01
    for values, colour, line, label in (
        (stability_map.closed.series, BLUE, (0, (5, 4)), "theory, small control period: series"),
        (stability_map.closed.characteristic_root, GREEN, (0, (1, 2)), "theory: characteristic root"),
    ):
        levels = (
            []
            if values is None
            else [level for level in _contour_levels(stability_map.error, drawn) if level > 0]
        )
        if values is not None and levels:
            axes.contour(x, y, values - 1, levels=levels, colors=colour, linewidths=2.0, linestyles=[line])
            handles.append(Line2D([], [], color=colour, linewidth=2.0, linestyle=line, label=label))
    critical = stability_map.closed.delay_over_critical
    if critical is not None and np.min(critical) < 1 < np.max(critical):
        style: dict[str, Any] = {"linestyles": [(0, (5, 4))], "linewidths": 2.2}
        axes.contour(x, y, critical, levels=[1.0], colors=BLUE, **style)
        label = "theory, small control period: growth limit"
        handles.append(Line2D([], [], color=BLUE, linewidth=2.2, linestyle=(0, (5, 4)), label=label))
    return handles


def _draw_growth(axes: Axes, stability_map: MapResults) -> list[Any]:
    """Draw the contour at which the loop in contact has the spectral radius 1; return its legend entry."""
    radii = stability_map.radii
    if radii is None or not np.min(radii.values) < 1 < np.max(radii.values):
        return []
    x, y = (
        _in_plot_unit(axis, values)
        for axis, values in zip(stability_map.axes, (radii.x, radii.y), strict=True)
    )
    axes.contour(x, y, radii.values, levels=[1.0], colors=GREEN, linewidths=2.2)
    label = "spectral radius 1: above 1, the oscillation in contact grows"
    return [Line2D([], [], color=GREEN, linewidth=2.2, label=label)]


def _draw_nominal(axes: Axes, stability_map: MapResults) -> list[Any]:
    """Draw the nominal point and its margins, and return its entry for the legend."""
    point = [float(_in_plot_unit(axis, np.array(axis.nominal))) for axis in stability_map.axes]
    style: dict[str, Any] = {
        "marker": "o",
        "markersize": 8,
        "markerfacecolor": "white",
        "markeredgecolor": BLACK,
    }
    axes.plot(*point, label="nominal", linestyle="none", markeredgewidth=1.6, zorder=5, **style)
    label = "nominal"
    if stability_map.nominal.error_margins is not None:
        label = "nominal, and range of each key within the limit"
        for index, (axis, margin) in enumerate(
            zip(stability_map.axes, stability_map.nominal.error_margins, strict=True)
        ):
            ends = [
                axis.low if margin.low is None else margin.low,
                axis.high if margin.high is None else margin.high,
            ]
            line = [list(_in_plot_unit(axis, np.array(ends))), [point[1 - index]] * 2]
            axes.plot(*(line if index == 0 else line[::-1]), color=BLACK, linewidth=1.2, linestyle=":")
    return [Line2D([], [], linestyle=":" if "and" in label else "none", color=BLACK, label=label, **style)]


def _contour_levels(error: np.ndarray, limit: float, most: int = MAX_CONTOURS) -> list[float]:
    """Return the contour levels of both signs: the limit, and above it 1 and 3 times each power of 10.

    Only levels within the range of `error` are returned, at most `most` of each sign.
    """
    levels = sorted({limit, *(level for level in CONTOUR_ERRORS if level > 1.5 * limit)})
    low, high = np.nanmin(error, initial=0.0), np.nanmax(error, initial=0.0)
    above = [level for level in levels if level < high][-most:]
    below = [-level for level in levels if -level > low][-most:]
    return sorted([*below, *above])


def _plot_unit(axis: MapAxis) -> str:
    """Return the unit in which the plot shows the values of an axis."""
    return DISPLAY_UNITS.get(axis.unit, (1.0, axis.unit))[1]


def _in_plot_unit(axis: MapAxis, values: np.ndarray) -> np.ndarray:
    """Convert values of an axis from its SI unit to the unit of the plot."""
    return DISPLAY_UNITS.get(axis.unit, (1.0, axis.unit))[0] * values
