"""The picture of a run: force and position over time, contact by contact, beside the same contacts in space.

Figures are made without pyplot and whatever the caller's settings of matplotlib: nothing is shown, nothing
stays open, and equal data gives equal files.
"""

import os
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxhil.errors import one_line
from jaxhil.files import write_whole
from jaxhil.simulation.motion import Curve, Piece

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
MOST_PANELS = 4  # contacts drawn side by side


@matplotlib.style.context("default")
def contact_plot(pieces: Sequence[Piece], title: str, sensors: str | None = None) -> Figure:
    """Force and position over time, contact by contact, beside the same contact in space.

    `sensors` names the curve whose measured force and position are drawn too.
    """
    shown = list(pieces[:MOST_PANELS])
    if len(pieces) > len(shown):
        title += f" (the first {len(shown)} of {len(pieces)} contacts)"
    # Two lines of title above the axes; the legend below.
    width = max(7.0, 3.6 * len(shown) + 1)
    figure = new_figure((width, 6.4), title, above=1.0, below=0.95)
    figure.subplots_adjust(left=1.1 / width)  # the position's name takes two lines
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


def new_figure(
    size: tuple[float | int, float | int], title: str, above: float = 0.55, below: float = 0.6
) -> Figure:
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


@matplotlib.style.context("default")
def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure, whole or not at all, folders on the way included. Raises OSError when that is not
    possible, or what is there is no plain file."""
    target, content = Path(path), BytesIO()
    target.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    # Dates and versions would make equal figures differ.
    fields = {"CreationDate": None} if target.suffix.lower() == ".pdf" else {}
    fields = {"Date": None} if target.suffix.lower() == ".svg" else fields
    fields = {"Software": None} if target.suffix.lower() == ".png" else fields
    with rc_context({"svg.hashsalt": "jaxhil"}), warnings.catch_warnings():
        # A name may have letters that the font lacks; they are drawn as boxes.
        warnings.filterwarnings("ignore", r"Glyph \d+", UserWarning)
        figure.savefig(content, dpi=120, metadata=fields, format=target.suffix[1:].lower())
    write_whole(target, content.getvalue())


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
