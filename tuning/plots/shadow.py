"""Plot of the commands of a controller in shadow mode, with the commands in the logs."""

from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxhil.errors import to_one_line
from jaxhil.simulation.contact_plot import (
    BLUE,
    MAX_PANELS,
    VERMILION,
    create_figure,
    finish_axes,
    legend_below,
)
from tuning.shadow_mode.comparison import ShadowComparison
from tuning.shadow_mode.logged_ticks import LoggedTicks
from tuning.shadow_mode.replay import ReplayedRun, compare_commands

LOGGED: dict[str, Any] = {"color": "0.65", "linewidth": 3.0}
COMPUTED: dict[str, Any] = {"color": BLUE, "linewidth": 1.3}


@matplotlib.style.context("default")
def shadow_plot(comparison: ShadowComparison, title: str) -> Figure:
    """Plot logged commands, the controller's commands, and the differences between both against time.

    Each column shows one contact. If there are more than `MAX_PANELS` contacts, those in which the controller
    tripped take precedence, then those with the largest differences. The columns follow the order of the
    logs. On six axes, the norms of force and moment are drawn.
    """
    runs = [
        (ticks, run) for ticks, runs in zip(comparison.logs, comparison.runs, strict=True) for run in runs
    ]
    order = sorted(range(len(runs)), key=lambda index: _rank(comparison, index), reverse=True)
    shown = sorted(order[:MAX_PANELS])
    if len(runs) > len(shown):
        title += f" (the {len(shown)} largest differences of {len(runs)} contacts)"
    parts = ("force [N]",) if runs[0][0].axes == 1 else ("force [N]", "moment [N m]")
    width = max(7.0, 3.6 * len(shown) + 1)
    figure = create_figure((width, 3.2 * len(parts) + 3.0), title, above=1.0, below=0.95)
    figure.subplots_adjust(left=1.1 / width, hspace=0.25)
    grid: Any = figure.subplots(2 * len(parts), len(shown), squeeze=False, sharex="col")
    for column, index in enumerate(shown):
        contact = comparison.contacts[index]
        name = to_one_line(contact.log.rsplit("/", 1)[-1], 28)
        grid[0, column].set_title(f"contact {contact.contact}\n{name}", fontsize=10)
        for part, label in enumerate(parts):
            _plot_part(grid[2 * part : 2 * part + 2, column], *runs[index], part)
            if column == 0:
                grid[2 * part, 0].set_ylabel(f"commanded\n{label}")
                grid[2 * part + 1, 0].set_ylabel(f"difference\n{label}")
        grid[-1, column].set_xlabel("time in the log [s]")
    figure.align_ylabels(grid[:, 0])
    legend_below(figure, next((axes for axes in grid[0] if len(axes.lines) > 2), grid[0, 0]), 3)
    return figure


def _rank(comparison: ShadowComparison, index: int) -> tuple[bool, float]:
    """Return the rank of a contact: a trip of the controller ranks highest, then large differences."""
    contact = comparison.contacts[index]
    return contact.trip is not None, 0.0 if contact.share is None else contact.share


def _plot_part(panels: Any, ticks: LoggedTicks, run: ReplayedRun, part: int) -> None:
    """Plot the logged and the controller's commands of one contact above, and their difference below."""
    upper: Axes = panels[0]
    lower: Axes = panels[1]
    columns = slice(3 * part, 3 * part + 3)
    time = ticks.instant[run.rows]
    difference, _ = compare_commands(ticks, run)
    logged, computed, error = (
        _size(values[:, columns]) for values in (ticks.command[run.rows], run.commands, difference)
    )
    upper.plot(time, logged, label="in the log", **LOGGED)
    upper.plot(time, computed, label="controller in shadow mode", **COMPUTED)
    lower.plot(time, error, label="difference", **COMPUTED)
    if run.trip is not None:
        for axes in (upper, lower):
            axes.axvline(run.trip[0], color=VERMILION, linestyle="--", linewidth=1.3, label="trip")
    for axes in (upper, lower):
        finish_axes(axes, None)


def _size(values: np.ndarray) -> np.ndarray:
    """Return the norm of each row with three components; with one component, the component itself."""
    return values[:, 0] if values.shape[1] == 1 else np.linalg.norm(values, axis=1)
