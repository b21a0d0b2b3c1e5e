"""Plot of monitored contacts: each metric with the range that the mechanism file predicts."""

from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxhil.errors import one_line
from jaxhil.simulation.contact_plot import BLUE, SKY, VERMILION, finish, new_figure
from tuning.identification.monitor.figures import FIGURES
from tuning.reporting.documents import Monitoring
from tuning.reporting.drawings import Drawing, as_svg

WIDE = 1.96  # half width of a 95 % interval [standard deviations]


def monitor_drawing(document: Monitoring) -> Drawing:
    """Draw all metrics over the number of the contact."""
    says = "Figures of every contact over its number, with their predicted range"
    return Drawing(as_svg(_figure(document)), says, f"{says}, 95 % of contacts of the rig of the file.")


@matplotlib.style.context("default")
def _figure(document: Monitoring) -> Figure:
    """Return the figure with one panel per metric."""
    name = one_line(document.mechanism, 60)
    figure = new_figure((9.6, 8.4), f"Contacts held against {name}", below=0.95)
    figure.subplots_adjust(hspace=0.3, wspace=0.28)
    grid: Any = figure.subplots(4, 2, sharex=True)
    numbers = [contact.contact for contact in document.contacts]
    for axes, (figure_name, unit, scale) in zip(grid.flat, FIGURES, strict=False):
        value, std, z = _columns(document, figure_name)
        middle = scale * (value - z * std)
        axes.fill_between(
            numbers, middle - WIDE * scale * std, middle + WIDE * scale * std,
            color=SKY, alpha=0.35, linewidth=0, label="predicted, 95 %",
        )  # fmt: skip
        axes.plot(numbers, scale * value, color=BLUE, marker="o", markersize=4, linewidth=1, label="measured")
        if document.since is not None:
            style: dict[str, Any] = {"color": VERMILION, "linestyle": "--", "linewidth": 1.3}
            axes.axvline(document.since - 0.5, label="a change is likely since", **style)
        axes.set_ylabel(f"{figure_name} [{unit}]", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        finish(axes, None)
    grid[3, 1].set_axis_off()
    for axes in (grid[3, 0], grid[2, 1]):
        axes.set_xlabel("contact")
        axes.tick_params(labelbottom=True)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=3, fontsize=9, frameon=False)
    return figure


def _columns(document: Monitoring, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return value, predicted standard deviation, and z of a metric for every contact; NaN if unknown."""
    rows = []
    for contact in document.contacts:
        metric = contact.figures.get(name)
        rows.append((None,) * 3 if metric is None else (metric.value, metric.predicted_std, metric.z))
    value, std, z = np.array(rows, float).reshape(-1, 3).T
    return value, std, z
