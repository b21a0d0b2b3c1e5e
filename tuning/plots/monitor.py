"""Plot of monitored contacts: each metric with the range that the mechanism file predicts."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxhil.errors import to_one_line
from jaxhil.simulation.contact_plot import BLUE, SKY_BLUE, VERMILION, create_figure, finish_axes, legend_below
from tuning.identification.monitor.metrics import METRICS
from tuning.plots.parts import INTERVAL_SIGMAS


@matplotlib.style.context("default")
def monitor_plot(
    mechanism: str, contacts: Sequence[int], metrics: Mapping[str, np.ndarray], since: float | None
) -> Figure:
    """Plot the metrics over the number of the contact, one panel each.

    Rows of a metric are its values, their predicted standard deviations, and their deviations in these. A
    change is likely since contact `since`.
    """
    name = to_one_line(mechanism, 60)
    figure = create_figure((9.6, 8.4), f"Contacts held against {name}", below=0.95)
    figure.subplots_adjust(hspace=0.3, wspace=0.28)
    grid: Any = figure.subplots(4, 2, sharex=True)
    for axes, (figure_name, unit, scale) in zip(grid.flat, METRICS, strict=False):
        value, std, z = metrics[figure_name]
        middle = scale * (value - z * std)
        axes.fill_between(
            contacts, middle - INTERVAL_SIGMAS * scale * std, middle + INTERVAL_SIGMAS * scale * std,
            color=SKY_BLUE, alpha=0.35, linewidth=0, label="predicted, 95 %",
        )  # fmt: skip
        axes.plot(
            contacts, scale * value, color=BLUE, marker="o", markersize=4, linewidth=1, label="measured"
        )
        if since is not None:
            style: dict[str, Any] = {"color": VERMILION, "linestyle": "--", "linewidth": 1.3}
            axes.axvline(since - 0.5, label="a change is likely since", **style)
        axes.set_ylabel(f"{figure_name} [{unit}]", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        finish_axes(axes, None)
    grid[3, 1].set_axis_off()
    for axes in (grid[3, 0], grid[2, 1]):
        axes.set_xlabel("contact")
        axes.tick_params(labelbottom=True)
    legend_below(figure, grid[0, 0], 3)
    return figure
