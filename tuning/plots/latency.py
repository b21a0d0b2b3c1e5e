"""Histograms of the latencies of a real-time session: controller's computing time and round-trip time."""

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxhil.simulation.contact_plot import BLACK, BLUE, ORANGE, create_figure, finish_axes
from tuning.rig.loop import ANSWER_SHARE
from tuning.rig.session import SessionReport

STYLES = {"empty loop": (ORANGE, "--"), "controller": (BLUE, "-")}
BINS_PER_DECADE = 20  # bins of the histogram for each factor of 10


@matplotlib.style.context("default")
def latency_plot(session: SessionReport, title: str, period: float) -> Figure:
    """Plot histograms of the controller's computing time per tick and of the round-trip time.

    All axes are logarithmic. Vertical lines show the control period `period` [s] and the deadline of the
    controller's answer.
    """
    figure = create_figure((10, 4.6), title)
    left, right = figure.subplots(1, 2, sharey=True)
    loops = {"empty loop": session.empty, "controller": session.run}
    for axes, name in ((left, "tick_time"), (right, "round_trip")):
        for label, loop in loops.items():
            if loop is not None:
                _plot_histogram(axes, getattr(loop.times, name), label)
        axes.axvline(1e6 * period, color=BLACK, linewidth=0.8, linestyle=":", label="control period")
        axes.set(xscale="log", yscale="log")
    deadline = 1e6 * ANSWER_SHARE * period
    right.axvline(deadline, color=BLACK, linewidth=0.8, linestyle="-.", label="deadline of the answer")
    left.set(xlabel="controller's time per tick [µs]", ylabel="share of ticks per bin [1]")
    right.set(xlabel="round-trip time, measured by the rig [µs]")
    finish_axes(left, "best")
    finish_axes(right, "best")
    return figure


def _plot_histogram(axes: Axes, times: np.ndarray, label: str) -> None:
    micro = 1e6 * times[times > 0]
    if not len(micro):
        return
    colour, line = STYLES[label]
    first, last = np.floor(BINS_PER_DECADE * np.log10([micro.min(), micro.max()]))
    edges = 10 ** (np.arange(first, last + 2) / BINS_PER_DECADE)
    counts, _ = np.histogram(micro, edges)
    # A logarithmic axis cannot show an empty bin.
    shares = np.where(counts > 0, counts / len(micro), np.nan)
    style = {"color": colour, "linestyle": line, "linewidth": 1.5, "label": label}
    axes.stairs(shares, edges, baseline=None, **style)
