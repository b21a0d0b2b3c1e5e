"""Plot of a six-axis run: pose, forces and moments over time, and views of the mechanism in contact."""

from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from jaxhil.simulation.contact_plot import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY_BLUE,
    VERMILION,
    create_figure,
    finish_axes,
)
from jaxhil.sixdof.recording import RunRecord
from tuning.plots.outlines import Polyline, outlines, rotation_matrix

AXIS_NAMES = ("x", "y", "z")
AXIS_COLOURS = (BLUE, VERMILION, GREEN)
# Colours of the pairs of shapes that may touch; further pairs repeat the colours with dashed lines.
CANDIDATE_COLOURS = (BLUE, VERMILION, GREEN, ORANGE, SKY_BLUE, "0.35")
TIME_MARGIN = 0.05  # time shown before the first and after the last contact [s]
MIN_VIEW_RATIO = 0.3  # smallest ratio of a view's height to its width, so that force arrows have space
MAX_LEGEND_ENTRIES = 12  # largest number of pairs of shapes in a legend
VIEWS = ((0, 2), (1, 2))  # indices of the horizontal and the vertical axis of each view


@matplotlib.style.context("default")
def six_axes_plot(recorded: RunRecord, title: str) -> Figure:
    """Plot a six-axis run: pose, normal forces and moments over time, and views of the mechanism in contact.

    The views show the mechanism at the first touch and at the largest penetration. Grey lines show the ideal
    contact.
    """
    figure = create_figure((12, 8.8), title, above=0.6, below=0.75)
    rows = figure.add_gridspec(3, 4, height_ratios=(1, 1, 0.75), hspace=0.38, wspace=0.36)
    shown, (origin, since) = find_shown_ticks(recorded), find_time_origin(recorded)
    time = 1e3 * (recorded.time[shown] - recorded.time[origin])
    for cell, name, part in ((rows[0, :2], "position [mm]", 0), (rows[0, 2:], "rotation [mrad]", 3)):
        axes = figure.add_subplot(cell)
        for axis, colour in enumerate(AXIS_COLOURS):
            entry = part + axis
            curves = (curve[shown, entry] - recorded.ideal[origin, entry] for curve in recorded[1:4])
            desired, actual, ideal = (1e3 * curve for curve in curves)
            axes.plot(time, ideal, color="0.7", linewidth=3)
            axes.plot(time, desired, color=colour, label=AXIS_NAMES[axis])
            axes.plot(time, actual, color=colour, linestyle=":")
        axes.set(ylabel=f"{name}, minus that\n{since.replace('since', 'at')}")
        finish_axes(axes, "best")
    left, right = figure.add_subplot(rows[1, :2]), figure.add_subplot(rows[1, 2:])
    _plot_forces(left, recorded, shown, time)
    _plot_moments(right, recorded, shown, time)
    for axes in (left, right):
        axes.set(xlabel=f"time {since} [ms]")
    target, chaser = outlines(recorded.groups)
    for column, (name, tick) in enumerate(_find_shown_instants(recorded) if recorded.names else ()):
        after = 1e3 * (recorded.time[tick] - recorded.time[origin])
        for view, (across, up) in enumerate(VIEWS):
            axes = figure.add_subplot(rows[2, 2 * column + view])
            draw_view(axes, recorded, tick, target, chaser, across, up)
            axes.set_title(f"{name} on the rig, {after:.3g} ms", fontsize=10)
    legend = "Solid: numerical model; dotted: hardware at the sampling instants; grey: ideal contact."
    legend += " Below: target grey, chaser blue, forces on the chaser black."
    figure.text(0.5, 0.015, legend, ha="center", fontsize=9)
    return figure


def find_time_origin(recorded: RunRecord) -> tuple[int, str]:
    """Return the tick at which the plots' time is 0, and a text that describes this tick.

    This is the tick of the first touch in the ideal contact. Without such a touch, it is the tick of the
    first touch on the rig; without any contact, the start of the run.
    """
    ideal = np.flatnonzero(np.any(recorded.wrench_ideal != 0, axis=1))
    if len(ideal):
        return int(ideal[0]), "since first touch of the ideal contact"
    on_the_rig = np.flatnonzero(np.any(recorded.depth > 0, axis=1))
    return (int(on_the_rig[0]), "since first touch") if len(on_the_rig) else (0, "since the start")


def _find_shown_instants(recorded: RunRecord) -> tuple[tuple[str, int], ...]:
    """Return name and tick of first touch and largest penetration; without contact, of start and end."""
    touching = np.flatnonzero(np.any(recorded.depth > 0, axis=1))
    if not len(touching):
        return ("start", 0), ("end", len(recorded.time) - 1)
    return ("first touch", int(touching[0])), ("deepest", int(np.argmax(recorded.depth.max(axis=1))))


def find_shown_ticks(recorded: RunRecord) -> slice:
    """Return the ticks to be shown: from the first to the last (ideal or real) contact, with a margin.

    Without contact, return all ticks.
    """
    touching = np.any(recorded.depth > 0, axis=1) | np.any(recorded.wrench_ideal != 0, axis=1)
    ticks = np.flatnonzero(touching)
    if not len(ticks):
        return slice(0, len(recorded.time))
    margin = round(TIME_MARGIN / float(recorded.time[1] - recorded.time[0])) + 1
    return slice(max(ticks[0] - margin, 0), min(ticks[-1] + margin, len(recorded.time)))


def draw_view(
    axes: Axes,
    recorded: RunRecord,
    tick: int,
    target: list[Polyline],
    chaser: list[Polyline],
    across: int,
    up: int,
) -> None:
    """Draw target, chaser and contact forces at a tick, projected onto the plane of axes `across` and `up`.

    `target` and `chaser` are outlines, as returned by `outlines`.
    """
    pose = recorded.actual[tick]
    rotation = rotation_matrix(quaternion_of(pose[3:]))
    moved = [line @ rotation.T + pose[:3] for line in chaser]
    for lines, colour in ((target, "0.55"), (moved, BLUE)):
        flat: Any = [1e3 * line[:, [across, up]] for line in lines]
        axes.add_collection(LineCollection(flat, colors=colour, linewidths=0.9))
    axes.autoscale_view()
    axes.set_aspect("equal", adjustable="box")
    width, height = (float(np.ptp(limits)) for limits in (axes.dataLim.intervalx, axes.dataLim.intervaly))
    # The view of a flat mechanism needs additional height for the arrows of the forces.
    missing = max(MIN_VIEW_RATIO * width - height, 0.0)
    axes.set_ylim(axes.get_ylim()[0] - missing / 2, axes.get_ylim()[1] + missing / 2)
    largest = max(float(np.max(recorded.force)), 1e-12)
    length = 0.4 * max(height, MIN_VIEW_RATIO * width)
    for candidate in np.flatnonzero(recorded.depth[tick] > 0):
        start = 1e3 * recorded.point[tick, candidate][[across, up]]
        push = length * recorded.push[tick, candidate][[across, up]] / largest
        axes.plot(*start, marker=".", color=BLACK, markersize=5)
        axes.annotate("", start + push, start, arrowprops={"arrowstyle": "->", "color": BLACK})
    axes.set(xlabel=f"{AXIS_NAMES[across]} of T [mm]", ylabel=f"{AXIS_NAMES[up]} of T [mm]")
    axes.tick_params(labelsize=8)


def quaternion_of(theta: np.ndarray) -> Any:
    """Convert a rotation vector (3,) [rad] to a unit quaternion."""
    import jax.numpy as jnp

    from jaxhil.sixdof.rotations import exponential
    from jaxhil.sixdof.vectors import vector

    return exponential(vector(jnp.asarray(theta)))


def _plot_forces(axes: Axes, recorded: RunRecord, shown: slice, time: np.ndarray) -> None:
    """Plot the normal force between each pair of shapes that touches, and the ideal contact's total force."""
    total = np.linalg.norm(recorded.wrench_ideal[shown, :3], axis=1)
    axes.plot(time, total, color="0.7", linewidth=3, label="total force of the ideal contact")
    for index, candidate in enumerate(np.flatnonzero(np.any(recorded.force > 0, axis=0))):
        colour, line = (
            CANDIDATE_COLOURS[index % len(CANDIDATE_COLOURS)],
            "-" if index < len(CANDIDATE_COLOURS) else "--",
        )
        name = recorded.names[candidate] if index < MAX_LEGEND_ENTRIES else None
        axes.plot(time, recorded.force[shown, candidate], color=colour, linestyle=line, label=name)
    axes.set(ylabel="normal force of each contact [N]")
    finish_axes(axes, "best")


def _plot_moments(axes: Axes, recorded: RunRecord, shown: slice, time: np.ndarray) -> None:
    """Plot the moments about the origin of the target's frame T: real contact, command, and ideal contact."""
    for axis, colour in enumerate(AXIS_COLOURS):
        axes.plot(time, recorded.wrench_ideal[shown, 3 + axis], color="0.7", linewidth=3)
        axes.plot(time, recorded.command[shown, 3 + axis], color=colour, label=AXIS_NAMES[axis])
        axes.plot(time, recorded.wrench[shown, 3 + axis], color=colour, linestyle=":")
    axes.set(ylabel="moment about T [N m]")
    finish_axes(axes, "best")
