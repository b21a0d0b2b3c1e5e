"""Pictures of tuning and of a nominal run, in units and colours that a reader can tell apart.

Figures are made without pyplot: nothing is shown, nothing stays open, and equal data gives equal files.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from jaxhil.errors import one_line
from tuning.gains.objective import Objective
from tuning.gains.pareto import Front
from tuning.gains.tune import Result
from tuning.pictures.motion import Curve, Piece

# Okabe and Ito's colours, which every kind of sight distinguishes; line styles distinguish them in print.
BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION = "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00"
STYLES = {
    "in space": (BLACK, "-", 3.0),
    "before": (VERMILION, "--", 1.5),
    "literature": (ORANGE, "-.", 1.5),
    "tuned": (BLUE, "-", 1.5),
    "rig": (BLUE, "-", 1.5),
}
LABELS = {
    "in space": "in space (reference)",
    "before": "before: no compensation",
    "literature": "literature's rule",
    "tuned": "tuned",
    "rig": "on the rig",
}
MARKERS = {"before": "^", "literature": "s", "tuned": "o"}
MOST_PANELS = 4  # contacts drawn side by side


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure, folders on the way included. Raises OSError when that is not possible."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    # Dates and versions would make equal figures differ.
    fields = {"CreationDate": None} if target.suffix.lower() == ".pdf" else {}
    fields = {"Date": None} if target.suffix.lower() == ".svg" else fields
    fields = {"Software": None} if target.suffix.lower() == ".png" else fields
    with rc_context({"svg.hashsalt": "jaxhil"}):
        figure.savefig(target, dpi=120, metadata=fields)


def errors_plot(result: Result, limit: float) -> Figure:
    """How large errors are and how often, and at which contact frequency, before and after tuning."""
    figure = new_figure(
        (11, 4.6), f"{result.mechanism.name}: restitution error on fresh scenarios", above=0.75
    )
    left, right = figure.subplots(1, 2)
    # A limit of 0 or inf has no place on a logarithmic axis.
    drawn = 0 < limit < np.inf
    sizes: list[float] = [limit] if drawn else []
    for name, outcome in result.outcomes.items():
        size = np.sort(np.abs(outcome.error[outcome.good]))[::-1]
        if not len(size):
            continue
        colour, line, width = STYLES[name]
        total = int(np.sum(outcome.wanted))
        # Contacts that did not end are larger than any error: they raise the whole curve.
        share = (np.arange(1, len(size) + 1) + total - len(size)) / total
        left.step(
            size, share, where="post", color=colour, linestyle=line, linewidth=width, label=LABELS[name]
        )
        sizes += [float(size[0]), float(np.percentile(size, 2))]
        frequency = outcome.reference_peak_force / outcome.metrics.approach_velocity / (2 * np.pi)
        frequency = frequency / result.scenarios.equivalent_mass
        right.plot(
            frequency[outcome.good],
            outcome.error[outcome.good],
            linestyle="none",
            marker=MARKERS[name],
            markersize=2.5,
            alpha=0.6,
            color=colour,
            markeredgewidth=0,
            label=LABELS[name],
            rasterized=True,
        )
    if drawn:
        left.axvline(limit, color=GREEN, linewidth=1, linestyle=":", label=f"limit {limit:g}")
        right.axhspan(-limit, limit, color=GREEN, alpha=0.15, linewidth=0, label=f"within {limit:g}")
    positive = [value for value in sizes if value > 0] or [1.0]
    left.set(xscale="log", yscale="log", xlim=(min(positive) / 1.5, 1.5 * max(positive)))
    left.set(xlabel="size of the error |e - e*| [1]", ylabel="share of contacts with a larger error [1]")
    right.axhline(0, color=BLACK, linewidth=0.6)
    right.set_yscale("symlog", linthresh=limit if drawn else 0.01)
    right.set(xlabel="contact frequency [Hz]", ylabel="error e - e* [1]  (above 0: divergence)")
    finish(left, "lower left")
    finish(right, None)
    if right.get_legend_handles_labels()[0]:
        # Above the axes: points are everywhere inside.
        style: dict[str, Any] = {"fontsize": 8, "frameon": False, "markerscale": 2.5, "columnspacing": 1.2}
        legend = right.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, **style)
        for handle in legend.legend_handles:
            if handle is not None:
                handle.set_alpha(1 if handle.get_label() in LABELS.values() else 0.3)
    return figure


def loss_plot(result: Result) -> Figure:
    """The objective that each start of the solver had reached after each step."""
    figure = new_figure((7, 4.6), f"{result.mechanism.name}: tuning from {len(result.starts)} starts")
    axes = figure.subplots()
    finite = [start for start in result.starts if np.all(np.isfinite(start.history))]
    best = min(finite, key=lambda start: start.rms) if finite else None
    for number, start in enumerate(result.starts):
        steps = np.arange(1, len(start.history) + 1)
        first = number == 0
        colour, width = (BLUE, 2.5) if start is best else (ORANGE, 1.8) if first else ("0.6", 1.0)
        label = "best start" if start is best else None
        if first:
            label = "start at the literature's gains" + (" (best)" if start is best else "")
        elif label is None and number == next(
            (i for i, s in enumerate(result.starts) if i and s is not best), 0
        ):
            label = "other starts"
        order = 3 if start is best else 2
        axes.plot(steps, start.history, color=colour, linewidth=width, label=label, zorder=order)
        axes.plot(steps[-1:], start.history[-1:], color=colour, marker="o", markersize=4, zorder=order)
    axes.set_yscale("log")
    objective = result.settings.objective
    what = objective.name if objective == Objective(objective.name) else "objective"
    axes.set(xlabel="solver step", ylabel=f"{what} on training scenarios [1]")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    finish(axes, "best")
    return figure


def overview_plot(results: Sequence[Result], limit: float) -> Figure:
    """The rms restitution error of every mechanism before tuning, with the literature's gains, and tuned."""
    height = 1.6 + 0.2 * len(results)
    figure = new_figure(
        (8, height), f"Restitution error of {len(results)} mechanisms on fresh scenarios", 0.9
    )
    longest = max(len(result.mechanism.name) for result in results)
    figure.subplots_adjust(left=min(0.45, (0.5 + 0.085 * min(longest, 40)) / 8))
    axes = figure.subplots()
    rows = np.arange(len(results))
    for name in ("before", "literature", "tuned"):
        rms = [result.figures[name].rms for result in results]
        style = {"linestyle": "none", "marker": MARKERS[name], "color": STYLES[name][0], "markersize": 5}
        axes.plot(rms, rows, label=LABELS[name], **style)
    if 0 < limit < np.inf:
        axes.axvline(limit, color=GREEN, linewidth=1, linestyle=":", label=f"limit {limit:g}")
    axes.set_yticks(rows, [one_line(r.mechanism.name, 40).replace("$", r"\$") for r in results], fontsize=8)
    axes.set(xscale="log", xlabel="rms of the restitution error e - e* [1]", ylim=(len(results) - 0.5, -0.5))
    finish(axes, None)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8, frameon=False)
    return figure


def front_plot(front: Front, result: Result, limit: float) -> Figure:
    """Restitution error against what it is traded for: numbered points, the front as a line of what
    is reached, the literature's gains and those tuned beside."""
    figure = new_figure(
        (7, 5), f"{result.mechanism.name}: restitution error against {front.axis.name}, fresh scenarios"
    )
    axes = figure.subplots()
    kept = sorted((one for one in front.points if one.on_front), key=lambda one: one.cost)
    axes.step([p.cost for p in kept], [p.error for p in kept], where="post", color=BLUE)
    for points, label, marker, size, edge, face in (
        (kept, "front", "o", 7, BLUE, BLUE),
        ([one for one in front.points if not one.on_front], "beaten by another", "o", 7, BLUE, "white"),
        ([front.literature], LABELS["literature"], "s", 7, ORANGE, ORANGE),
        # Open: what was tuned before may be a point too.
        ([front.tuned], LABELS["tuned"], "D", 10, BLACK, "none"),
    ):
        if points:
            places = [one.cost for one in points], [one.error for one in points]
            style: dict[str, Any] = {"linestyle": "none", "marker": marker, "markersize": size}
            axes.plot(*places, color=edge, markerfacecolor=face, label=label, zorder=3, **style)
    if 0 < limit < np.inf:
        axes.axhline(limit, color=GREEN, linewidth=1, linestyle=":", label=f"limit {limit:g}")
    numbers: dict[tuple[float, float], list[str]] = {}  # points that came out alike share a place
    for number, one in enumerate(front.points, start=1):
        numbers.setdefault(one.place, []).append(str(number))
    for turn, (error, noise) in enumerate(sorted(numbers)):
        where = {"xytext": (6, -14 if turn % 2 else 6), "textcoords": "offset points"}  # one above, one below
        axes.annotate(", ".join(numbers[error, noise]), (noise, error), fontsize=8, **where)
    _scale(axes, "x", [one.cost for one in (*front.points, front.literature, front.tuned)])
    _scale(axes, "y", [one.error for one in (*front.points, front.literature, front.tuned)])
    axes.margins(0.08, 0.12)
    name = result.settings.objective.name
    axes.set(xlabel=f"{front.axis.words} [1]", ylabel=f"{name} of e - e* [1]")
    finish(axes, "best")
    return figure


def contact_plot(pieces: Sequence[Piece], title: str, sensors: str | None = None) -> Figure:
    """Force and position over time, contact by contact, beside the same contact in space.

    `sensors` names the curve whose measured force and position are drawn too.
    """
    shown = list(pieces[:MOST_PANELS])
    if len(pieces) > len(shown):
        title += f" (the first {len(shown)} of {len(pieces)} contacts)"
    # Two lines of title above the axes; the legend below.
    figure = new_figure((max(7.0, 3.6 * len(shown) + 1), 6.4), title, above=1.0, below=0.95)
    grid = figure.subplots(2, len(shown), squeeze=False, sharex="col")
    for column, piece in enumerate(shown):
        force, position = grid[0, column], grid[1, column]
        end = 0.0
        for name, curve in piece.curves.items():
            colour, line, width = STYLES[name]
            style = {"color": colour, "linestyle": line, "linewidth": width, "label": LABELS[name]}
            if name == "in space":
                style.update(color="0.65")
            force.plot(1e3 * curve.time, curve.force, **style)
            position.plot(1e3 * curve.time, 1e3 * curve.position, **style)
            if name == sensors and curve.force_measured is not None and curve.position_measured is not None:
                extra = {"color": VERMILION, "linestyle": ":", "linewidth": 1.3}
                force.plot(1e3 * curve.time, curve.force_measured, label="measured", **extra)
                position.plot(1e3 * curve.time, 1e3 * curve.position_measured, label="measured", **extra)
            end = max(end, _end(curve))
        force.set_title(_entered(piece), fontsize=10)
        force.set_xlim(-20, 1e3 * end + 20)
        position.set_xlabel("time since first touch [ms]")
        for surface in piece.surfaces:
            position.axhline(1e3 * surface, color=BLACK, linewidth=0.6)
        _limit_position(position, piece, end)
        for axes in (force, position):
            finish(axes, None)
    grid[0, 0].set_ylabel("force on the model [N]")
    grid[1, 0].set_ylabel("position of the model [mm]\n(thin line: a surface)")
    figure.align_ylabels(grid[:, 0])
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=len(labels), fontsize=9, frameon=False)
    return figure


def new_figure(size: tuple[float, float], title: str, above: float = 0.55, below: float = 0.6) -> Figure:
    """A figure with room [inches] above and below its axes, of labels and titles of known sizes: an automatic
    layout draws everything twice."""
    width, height = size
    figure = Figure(figsize=size)
    figure.subplots_adjust(
        left=0.9 / width, right=1 - 0.25 / width, bottom=below / height, top=1 - above / height,
        wspace=0.24, hspace=0.12,
    )  # fmt: skip
    # A name is text, not a formula.
    figure.suptitle(one_line(title, 120).replace("$", r"\$"), fontsize=12, y=1 - 0.12 / height, va="top")
    return figure


def finish(axes: Axes, legend: Any) -> None:
    """Grid, spines and legend (its place, None for none) of axes that are drawn."""
    axes.grid(True, color="0.88", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if not axes.get_legend_handles_labels()[0]:
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center", va="center")
    elif legend is not None:
        axes.legend(loc=legend, fontsize=8, framealpha=0.9)


def _scale(axes: Axes, name: str, values: Sequence[float]) -> None:
    """A logarithmic axis, its ticks plain numbers, where values of different orders are on it."""
    low, high = min(values), max(values)
    if not 0 < 3 * low < high:
        return
    axes.set(**{f"{name}scale": "log"})
    axis = {"x": axes.xaxis, "y": axes.yaxis}[name]
    axis.set_minor_locator(LogLocator(subs=(2, 3, 5) if high > 5 * low else range(2, 10)))
    for plainly in (axis.set_major_formatter, axis.set_minor_formatter):
        plainly(lambda value, _: f"{value:g}")


def _entered(piece: Piece) -> str:
    """The contact and the speed it was entered at; another speed where a curve has one of its own."""
    speed = piece.curves["in space"].velocity
    text = f"{piece.name}, entered at {1e3 * speed:.3g} mm/s"
    for name, curve in piece.curves.items():
        if abs(curve.velocity - speed) > 0.005 * speed:
            text += f"\n({name}: {1e3 * curve.velocity:.3g} mm/s)"
    return text


def _end(curve: Curve) -> float:
    """When the last force is over [s]."""
    pushed = np.flatnonzero(np.abs(curve.force) > 1e-3 * np.max(np.abs(curve.force), initial=0.0))
    return float(curve.time[pushed[-1]]) if len(pushed) else float(curve.time[-1])


def _limit_position(axes: Axes, piece: Piece, end: float) -> None:
    """Show what lies within the time shown."""
    values = []
    for curve in piece.curves.values():
        within = curve.time <= end + 0.02
        values.append(1e3 * curve.position[within])
    every = np.concatenate(values)
    every = every[np.isfinite(every)]
    if len(every):
        margin = 0.05 * (np.max(every) - np.min(every)) or 1.0
        axes.set_ylim(np.min(every) - margin, np.max(every) + margin)
