"""Animation of a six-axis contact: the ideal contact and the contact on the rig, side by side."""

import tempfile
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxhil.files import write_atomically
from jaxhil.simulation.contact_plot import BLUE, VERMILION, create_figure
from jaxhil.sixdof.recording import RunRecord
from tuning.plots.outlines import Polyline, outlines, rotation_matrix
from tuning.plots.six_axes import AXIS_NAMES, VIEWS, find_shown_ticks, find_time_origin, quaternion_of

FRAME_COUNT, FRAME_RATE = 60, 12  # number of frames, and frames per second
MARGIN_FACTOR = 3.0  # margin around the points of contact, divided by the displacement during the contact
COLUMN_TITLES = ("ideal contact", "on the rig")


@matplotlib.style.context("default")
def animate(recorded: RunRecord, title: str, path: str | Path) -> None:
    """Write an animation of target and chaser near the contact, for the ideal contact and for the rig.

    Raise OSError if the file cannot be written.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    ticks_shown = find_shown_ticks(recorded)
    ticks = np.unique(np.linspace(ticks_shown.start, ticks_shown.stop - 1, FRAME_COUNT).astype(int))
    figure = create_figure((7.6, 8), title, above=0.9, below=0.85)
    FigureCanvasAgg(figure)
    figure.subplots_adjust(hspace=0.28, wspace=0.28)
    moving = _draw_scene(figure, recorded)
    clock = figure.text(0.5, 0.925, "", ha="center", fontsize=10)
    origin, since = find_time_origin(recorded)
    writer = _select_writer(target)
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / f"film{target.suffix.lower()}"
        with writer.saving(figure, str(film), 64):
            for tick in ticks:
                clock.set_text(f"{1e3 * (recorded.time[tick] - recorded.time[origin]):.0f} ms {since}")
                for lines, trail, chaser, poses, view in moving:
                    lines.set_segments(_project_outline(chaser, poses[tick], view))
                    trail.set_data(*(1e3 * poses[ticks_shown.start : tick + 1, list(view)].T))
                writer.grab_frame()
        write_atomically(target, film.read_bytes())


def _select_writer(target: Path) -> AbstractMovieWriter:
    """Return the animation writer for the format of a file, .gif or .mp4."""
    return PillowWriter(fps=FRAME_RATE) if target.suffix.lower() == ".gif" else FFMpegWriter(fps=FRAME_RATE)


def _draw_scene(
    figure: Figure, recorded: RunRecord
) -> list[tuple[LineCollection, Line2D, list[Polyline], np.ndarray, Any]]:
    """Draw the target in four subplots: two views of the ideal contact, and two of the contact on the rig.

    Return, for each subplot, the data that draw the chaser at one instant: the lines of the chaser, the line
    of its path, the chaser's outline in the frame C of its docking interface, the chaser's pose at each tick,
    and the axes of the view.
    """
    target, chaser = outlines(recorded.groups)
    middle, half = _shown_region(recorded)
    moving = []
    for row, view in enumerate(VIEWS):
        for column, poses in enumerate((recorded.ideal, recorded.actual)):
            axes = figure.add_subplot(2, 2, 2 * row + column + 1)
            fixed: Any = [1e3 * line[:, list(view)] for line in target]
            axes.add_collection(LineCollection(fixed, colors="0.55", linewidths=1.2))
            lines = LineCollection([], colors=BLUE, linewidths=1.2)
            axes.add_collection(lines)
            _format_axes(axes, middle[list(view)], half, view)
            axes.set_title(COLUMN_TITLES[column], fontsize=10)
            [trail] = axes.plot([], [], color=VERMILION, linewidth=2.0)
            moving.append((lines, trail, chaser, poses, view))
    handles = [Line2D([], [], color=colour, linewidth=2.0) for colour in ("0.55", BLUE, VERMILION)]
    labels = ["target", "chaser", "path of the chaser's interface C"]
    figure.legend(handles, labels, loc="lower center", ncols=3, fontsize=9, frameon=False)
    return moving


def _shown_region(recorded: RunRecord) -> tuple[np.ndarray, float]:
    """Return centre (3,) and half width [m] of the shown region: all contact points, and a margin."""
    touching = recorded.depth > 0
    points = recorded.point[touching] if np.any(touching) else recorded.actual[:1, :3]
    ticks = find_shown_ticks(recorded)
    moved = np.ptp(recorded.desired[ticks, :3], axis=0).max()
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float(np.max(high - low) / 2 + MARGIN_FACTOR * moved + 0.01)


def _format_axes(axes: Axes, middle: np.ndarray, half: float, view: tuple[int, int]) -> None:
    """Set limits, labels and grid of a subplot, for a region with centre `middle` and half width `half`."""
    across, up = (1e3 * (centre + half * np.array([-1, 1])) for centre in middle)
    axes.set(xlim=tuple(across), ylim=tuple(up), aspect="equal")
    axes.set(xlabel=f"{AXIS_NAMES[view[0]]} of T [mm]", ylabel=f"{AXIS_NAMES[view[1]]} of T [mm]")
    axes.grid(True, color="0.9", linewidth=0.6)


def _project_outline(chaser: list[Polyline], pose: np.ndarray, view: tuple[int, int]) -> Any:
    """Return the lines [mm] of the chaser's outline at a pose, projected onto the plane of a view."""
    rotation = rotation_matrix(quaternion_of(pose[3:]))
    return [1e3 * (line @ rotation.T + pose[:3])[:, list(view)] for line in chaser]
