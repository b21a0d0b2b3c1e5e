"""Plot of a run: force and position against time for each contact, together with the ideal contact.

The plots use neither pyplot nor the caller's settings of matplotlib. Therefore no window opens, no figure
stays in memory, and equal data results in equal files.
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

from jaxhil.errors import to_one_line
from jaxhil.files import write_atomically
from jaxhil.simulation.motion_curves import Curve, RunMotion

# Colours of Okabe and Ito, distinct for colour-blind readers. Line styles help in black-and-white print.
BLACK, ORANGE, SKY_BLUE, GREEN, BLUE, VERMILION = (
    "#000000",
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
)
CURVE_STYLES = {
    "ideal": (BLACK, "-", 3.0),
    "before": (VERMILION, "--", 1.5),
    "literature": (ORANGE, "-.", 1.5),
    "tuned": (BLUE, "-", 1.5),
    "rig": (BLUE, "-", 1.5),
}
CURVE_LABELS = {
    "ideal": "ideal contact",
    "before": "before: no compensation",
    "literature": "literature's rule",
    "tuned": "tuned",
    "rig": "on the rig",
}
# Widths of a legend entry at the font size of `legend_below` [inches].
LEGEND_KEY_WIDTH, LEGEND_LETTER_WIDTH = 0.65, 0.075
MAX_PANELS = 4  # maximum number of contacts in one plot, side by side


@matplotlib.style.context("default")
def plot_contacts(motions: Sequence[RunMotion], title: str, sensors: str | None = None) -> Figure:
    """Draw force and position against time for each contact, together with the ideal contact.

    Args:
        motions: Motion of each contact; the first `MAX_PANELS` are drawn.
        title: Title of the plot.
        sensors: Name of the curve for which the sensor readings are drawn too; None for no readings.
    """
    shown = list(motions[:MAX_PANELS])
    if len(motions) > len(shown):
        title += f" (the first {len(shown)} of {len(motions)} contacts)"
    # The margins leave space for two lines of panel titles above the axes and for the legend below them.
    width = max(7.0, 3.6 * len(shown) + 1)
    figure = create_figure((width, 6.4), title, above=1.0, below=0.95)
    figure.subplots_adjust(left=1.1 / width)  # The label of the position axis has two lines.
    grid = figure.subplots(2, len(shown), squeeze=False, sharex="col")
    for column, motion in enumerate(shown):
        force, position = grid[0, column], grid[1, column]
        end = 0.0
        for name, curve in motion.curves.items():
            colour, line, width = CURVE_STYLES[name]
            style = {"color": colour, "linestyle": line, "linewidth": width, "label": CURVE_LABELS[name]}
            if name == "ideal":
                style.update(color="0.65")
            force.plot(1e3 * curve.time, curve.force, **style)
            position.plot(1e3 * curve.time, 1e3 * curve.position, **style)
            if name == sensors and curve.force_measured is not None and curve.position_measured is not None:
                extra = {"color": VERMILION, "linestyle": ":", "linewidth": 1.3}
                force.plot(1e3 * curve.time, curve.force_measured, label="measured", **extra)
                position.plot(1e3 * curve.time, 1e3 * curve.position_measured, label="measured", **extra)
            end = max(end, _last_force_time(curve))
        force.set_title(_panel_title(motion), fontsize=10)
        force.set_xlim(-20, 1e3 * end + 20)
        position.set_xlabel("time since first touch [ms]")
        for surface in motion.surfaces:
            position.axhline(1e3 * surface, color=BLACK, linewidth=0.6)
        _limit_position(position, motion, end)
        for axes in (force, position):
            finish_axes(axes, None)
    grid[0, 0].set_ylabel("force on the model [N]")
    grid[1, 0].set_ylabel("position of the model [mm]\n(thin line: a surface)")
    figure.align_ylabels(grid[:, 0])
    legend_below(figure, grid[0, 0])
    return figure


def create_figure(
    size: tuple[float | int, float | int], title: str, above: float = 0.55, below: float = 0.6
) -> Figure:
    """Create a figure with a title and with fixed margins around its axes.

    Fixed margins are enough because the sizes of labels and titles are known. An automatic layout would draw
    everything twice.

    Args:
        size: Width and height of the figure [inches].
        title: Title, as plain text.
        above: Margin above the axes [inches].
        below: Margin below the axes [inches].
    """
    width, height = size
    figure = Figure(figsize=size)
    figure.subplots_adjust(
        left=0.9 / width, right=1 - 0.25 / width, bottom=below / height, top=1 - above / height,
        wspace=0.24, hspace=0.12,
    )  # fmt: skip
    # Matplotlib would read text between two dollar signs as a formula.
    figure.suptitle(to_one_line(title, 120).replace("$", r"\$"), fontsize=12, y=1 - 0.12 / height, va="top")
    return figure


def finish_axes(axes: Axes, legend: Any) -> None:
    """Add grid and legend to axes with curves; `legend` is matplotlib's location, or None for no legend."""
    axes.grid(True, color="0.88", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if not axes.get_legend_handles_labels()[0]:
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center", va="center")
    elif legend is not None:
        axes.legend(loc=legend, fontsize=8, framealpha=0.9)


def legend_below(figure: Figure, axes: Axes, columns: int | None = None) -> None:
    """Draw the legend of `axes` at the bottom of the figure, in one row or, if that is too wide, in two."""
    handles, labels = axes.get_legend_handles_labels()
    needed = sum(LEGEND_KEY_WIDTH + LEGEND_LETTER_WIDTH * len(label) for label in labels)
    columns = columns or (len(labels) if needed < figure.get_figwidth() else -(-len(labels) // 2))
    figure.legend(handles, labels, loc="lower center", ncols=columns, fontsize=9, frameon=False)


@matplotlib.style.context("default")
def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure to a file atomically; create the parent folders.

    Raise OSError if the file cannot be written, or if the path exists and is not a regular file.
    """
    target, content = Path(path), BytesIO()
    target.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    # Without these fields, a file would contain its date or the version of matplotlib.
    fields = {"CreationDate": None} if target.suffix.lower() == ".pdf" else {}
    fields = {"Date": None} if target.suffix.lower() == ".svg" else fields
    fields = {"Software": None} if target.suffix.lower() == ".png" else fields
    with rc_context({"svg.hashsalt": "jaxhil"}), warnings.catch_warnings():
        # Matplotlib warns about characters that the font lacks, and draws boxes; suppress the warning.
        warnings.filterwarnings("ignore", r"Glyph \d+", UserWarning)
        figure.savefig(content, dpi=120, metadata=fields, format=target.suffix[1:].lower())
    write_atomically(target, content.getvalue())


def _panel_title(motion: RunMotion) -> str:
    """Return a panel's title: contact, ideal approach speed, and curves whose speed differs from it."""
    speed = motion.curves["ideal"].velocity
    text = f"{motion.name}, approach at {1e3 * speed:.3g} mm/s"
    for name, curve in motion.curves.items():
        if abs(curve.velocity - speed) > 0.005 * speed:
            text += f"\n({name}: {1e3 * curve.velocity:.3g} mm/s)"
    return text


def _last_force_time(curve: Curve) -> float:
    """Return the last time [s] at which a force acts."""
    pushing = np.flatnonzero(np.abs(curve.force) > 1e-3 * np.max(np.abs(curve.force), initial=0.0))
    return float(curve.time[pushing[-1]]) if len(pushing) else float(curve.time[-1])


def _limit_position(axes: Axes, motion: RunMotion, end: float) -> None:
    """Fit the position axis to the positions up to 20 ms after the time `end` [s]."""
    values = []
    for curve in motion.curves.values():
        within = curve.time <= end + 0.02
        values.append(1e3 * curve.position[within])
    positions = np.concatenate(values)
    positions = positions[np.isfinite(positions)]
    if len(positions):
        margin = 0.05 * (np.max(positions) - np.min(positions)) or 1.0
        axes.set_ylim(np.min(positions) - margin, np.max(positions) + margin)
