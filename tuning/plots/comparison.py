"""Plots of a comparison of compensators: errors with confidence intervals, and transparency."""

from collections.abc import Mapping, Sequence

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jaxhil.simulation.contact_plot import (
    BLACK,
    CURVE_LABELS,
    CURVE_STYLES,
    GREEN,
    create_figure,
    finish_axes,
    legend_below,
)
from tuning.benchmark.comparison import LITERATURE_GAINS, TUNED_GAINS, CompensatorMetrics
from tuning.benchmark.tables import ERROR_NAMES, choose_best_metrics
from tuning.plots.parts import MARKERS, name_rows

MAX_PANEL_COLUMNS = 4  # largest number of panels side by side
TRANSPARENCY_TITLES = {
    "early": "transparency, push at 25 % [1]",
    "late": "transparency, push at 75 % [1]",
    "slope": "slope of e against e* [1]",
    "peak": "peak command / ideal peak [1]",
}


@matplotlib.style.context("default")
def plot_errors(
    names: Sequence[str], results: Mapping[str, Sequence[CompensatorMetrics]], limit: float
) -> Figure:
    """Plot the rms error of each compensator with its 95 % interval, in one panel per mechanism.

    `names` are the mechanisms, and `results` the metrics of all compensators by mechanism.
    """
    keys = _list_gain_names(names, results)
    laws = list(dict.fromkeys(result.compensator for name in names for result in results[name]))
    columns = min(MAX_PANEL_COLUMNS, len(names))
    rows = -(-len(names) // columns)
    height = 0.9 + (0.14 + 0.06 * len(keys)) * len(laws)
    size = (2.2 + 2.6 * columns, 1.2 + height * rows)
    error_name = ERROR_NAMES[results[names[0]][0].axes]
    title = f"{error_name.capitalize()} on fresh scenarios"
    figure = create_figure(size, title, above=0.9, below=0.75)
    panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for panel, name in zip(panels.flat, names, strict=False):
        by_law = {result.compensator: result for result in results[name]}
        for key, offset in zip(keys, _compute_offsets(len(keys)), strict=True):
            indices = [i for i, law in enumerate(laws) if law in by_law and key in by_law[law].figures]
            errors = [by_law[laws[i]].figures[key]["rms"] for i in indices]
            colour = CURVE_STYLES[key][0] if key in CURVE_STYLES else GREEN
            heights = np.array(indices) + offset
            for y, error in zip(heights, errors, strict=True):
                panel.plot([100 * error.low, 100 * error.high], [y, y], color=colour, linewidth=1.5)
            values = [100 * error.value for error in errors]
            marker = MARKERS.get(key, "D")
            panel.plot(values, heights, marker, color=colour, markersize=4, label=CURVE_LABELS.get(key, key))
        panel.axvline(
            100 * limit, color=BLACK, linewidth=1.2, linestyle="--", label=f"limit {100 * limit:g} %"
        )
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.tick_params(axis="x", labelsize=8)
        panel.set_title(name.removeprefix("suite-"), fontsize=9)
        finish_axes(panel, None)
    for panel in list(panels.flat)[len(names) :]:
        panel.set_visible(False)
    for panel in panels[:, 0]:
        name_rows(panel, laws)
    figure.subplots_adjust(left=1.6 / size[0], hspace=0.42 / height, wspace=0.08)
    for panel in list(panels.flat)[max(0, len(names) - columns) : len(names)]:
        panel.set_xlabel(f"rms of {'|e - e*|' if error_name == ERROR_NAMES[1] else error_name} [%]")
        panel.tick_params(labelbottom=True)
    legend_below(figure, panels[0, 0], 4)
    return figure


@matplotlib.style.context("default")
def plot_transparency(names: Sequence[str], results: Mapping[str, Sequence[CompensatorMetrics]]) -> Figure:
    """Plot transparency, slope of e against e*, and peak command of each compensator with its best gains.

    Each mechanism in `names` is a point; `results` are the metrics of all compensators by mechanism.
    """
    laws = list(dict.fromkeys(result.compensator for name in names for result in results[name]))
    size = (12.0, 1.75 + 0.34 * len(laws))
    gains = "Tuned gains" if TUNED_GAINS in _list_gain_names(names, results) else "The literature's gains"
    figure = create_figure(size, f"Does the run still test the hardware? {gains}", above=0.6, below=0.95)
    panels = figure.subplots(1, len(TRANSPARENCY_TITLES), sharey=True)
    figure.subplots_adjust(left=1.6 / size[0], wspace=0.08)
    for panel, (key, title) in zip(panels, TRANSPARENCY_TITLES.items(), strict=True):
        low, high = (0.3, 100.0) if key == "peak" else (-1.0, 2.5)
        for row, law in enumerate(laws):
            values = [
                choose_best_metrics(result)[key].value
                for name in names
                for result in results[name]
                if result.compensator == law
            ]
            heights = row + np.linspace(-0.25, 0.25, max(len(values), 2))[: len(values)]
            # A value beyond the range of the axis is drawn at the end of the axis.
            values = np.clip(values, low, high)
            label = None if row else "one mechanism, from top to bottom in the order of the command"
            style = {"color": CURVE_STYLES[TUNED_GAINS][0], "markersize": 4, "alpha": 0.6, "clip_on": False}
            panel.plot(values, heights, "o", label=label, **style)
        panel.axvline(1, color=BLACK, linewidth=1.2, linestyle="--", label="1: as in the ideal contact")
        panel.set_xlim(low, high)
        if key == "peak":
            panel.set_xscale("log")
        panel.set_xlabel(title, fontsize=9)
        finish_axes(panel, None)
    name_rows(panels[0], laws)
    legend_below(figure, panels[0], 2)
    return figure


def _list_gain_names(names: Sequence[str], results: Mapping[str, Sequence[CompensatorMetrics]]) -> list[str]:
    """Return the names of all evaluated sets of gains: "literature", then named settings, then "tuned"."""
    keys = {key: None for name in names for result in results[name] for key in result.figures}
    rank = {LITERATURE_GAINS: 0, TUNED_GAINS: 2}
    return sorted(keys, key=lambda key: rank.get(key, 1))


def _compute_offsets(number: int) -> list[float]:
    return [0.3 * (index - (number - 1) / 2) / max(number - 1, 1) for index in range(number)]
