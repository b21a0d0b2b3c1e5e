"""Plot of the metrics of monitored contacts, with the ranges that the mechanism file predicts."""

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
    """Plot each metric against the number of the contact, with its predicted 95 % range, in a separate panel.

    Args:
        mechanism: name or path of the mechanism file, for the title.
        contacts: numbers of the contacts.
        metrics: arrays (3, contacts) by name of the metric: values, predicted standard deviations, and z, the
            deviations from the predicted values divided by these standard deviations.
        since: number of the contact at which the rig probably changed; None if it did not change.
    """
    name = to_one_line(mechanism, 60)
    figure = create_figure((9.6, 8.4), f"Contacts compared with {name}", below=0.95)
    figure.subplots_adjust(hspace=0.3, wspace=0.28)
    grid: Any = figure.subplots(4, 2, sharex=True)
    for axes, (metric_name, unit, scale) in zip(grid.flat, METRICS, strict=False):
        value, std, z = metrics[metric_name]
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
            axes.axvline(since - 0.5, label="probable change of the rig", **style)
        axes.set_ylabel(f"{metric_name} [{unit}]", fontsize=9)
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))
        finish_axes(axes, None)
    grid[3, 1].set_axis_off()
    for axes in (grid[3, 0], grid[2, 1]):
        axes.set_xlabel("contact")
        axes.tick_params(labelbottom=True)
    legend_below(figure, grid[0, 0], 3)
    return figure
