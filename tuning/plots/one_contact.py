"""Plot of one contact for readers without the theory: ideal, before and after tuning, each with its e."""

from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from jaxhil.simulation.contact_plot import BLACK, CURVE_STYLES, create_figure, finish_axes
from jaxhil.simulation.motion_curves import Curve, RunMotion

SHOWN_NAMES = {"ideal": "ideal contact", "before": "before, no compensation", "tuned": "after tuning"}
SHOWN_TIME = 1.5  # time after the first touch, in durations of the contact
LABEL_SPACE = 0.85  # width of the space for the labels, in durations of the contact
MIN_LABEL_DISTANCE = 0.07  # smallest distance of two labels, in heights of the curves


def compute_rebound(curve: Curve) -> float:
    """Return the restitution e of a contact: speed at the end of the curve divided by the approach speed."""
    speed = (curve.position[-2] - curve.position[-1]) / (curve.time[-1] - curve.time[-2])
    return float(speed / curve.velocity)


def describe_contact(motion: RunMotion) -> str | None:
    """Return the result of one contact in words; None if e is not defined or a curve is missing."""
    curves = [motion.curves[name] for name in SHOWN_NAMES if name in motion.curves]
    if len(motion.surfaces) > 1 or len(curves) < len(SHOWN_NAMES) or any(c.position[-1] > 0 for c in curves):
        return None
    ideal, before, tuned = (compute_rebound(motion.curves[name]) for name in SHOWN_NAMES)
    return (
        f"Without compensation, the rebound is {before:.2f} times as fast as the approach; "
        f"after tuning {tuned:.2f} times; ideal contact: {ideal:.2f} times."
    )


@matplotlib.style.context("default")
def plot_one_contact(motion: RunMotion, name: str) -> Figure:
    """Plot the position in one contact against time, with the restitution e at the end of each curve.

    Args:
        motion: curves of one contact. `describe_contact` must not return None for them.
        name: name of the mechanism.
    """
    figure = create_figure((9, 4.8), f"{name}, {motion.name}: before and after tuning", above=0.85)
    figure.text(0.5, 0.895, describe_contact(motion) or "", ha="center", fontsize=10)
    axes = figure.subplots()
    shown = {key: motion.curves[key] for key in SHOWN_NAMES}
    duration = max(_find_last_touch(curve) for curve in shown.values())
    begin, end = -0.15 * duration, SHOWN_TIME * duration
    ends = {}
    for key, curve in shown.items():
        colour, line, width = CURVE_STYLES[key]
        time, position = _extend(curve, end)
        style: dict[str, Any] = {"linestyle": line, "linewidth": max(width, 2.0)}
        axes.plot(1e3 * time, 1e3 * position, color="0.65" if key == "ideal" else colour, **style)
        ends[key] = 1e3 * float(position[-1])
    highest = 1e3 * max(float(np.max(curve.position)) for curve in shown.values())
    lowest = min(ends.values())
    axes.set_xlim(1e3 * begin, 1e3 * (end + LABEL_SPACE * duration))
    axes.set_ylim(lowest - 0.1 * (highest - lowest), highest + 0.1 * (highest - lowest))
    for key, height in _separate(ends, MIN_LABEL_DISTANCE * (highest - lowest)).items():
        colour = "0.35" if key == "ideal" else CURVE_STYLES[key][0]
        text = f"{SHOWN_NAMES[key]}: e = {compute_rebound(shown[key]):.2f}"
        axes.text(1e3 * (end + 0.03 * duration), height, text, color=colour, fontsize=10, va="center")
    axes.axhline(0.0, color=BLACK, linewidth=0.6)
    axes.text(1e3 * begin, 0.0, " surface", fontsize=8, va="bottom")
    axes.set(xlabel="time since first touch [ms]", ylabel="position of the model [mm]  (above 0: in contact)")
    axes.plot([], [], label=" ")  # finish_axes expects a labelled curve
    finish_axes(axes, None)
    return figure


def _find_last_touch(curve: Curve) -> float:
    """Return the last time [s] at which the position is beyond the surface."""
    inside = np.flatnonzero(curve.position > 0)
    return float(curve.time[inside[-1]]) if len(inside) else float(curve.time[-1])


def _extend(curve: Curve, until: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and positions [m] of a curve up to `until` [s], extended at its final velocity."""
    is_shown = curve.time <= until
    time, position = curve.time[is_shown], curve.position[is_shown]
    if is_shown.all():
        last = curve.position[-1] - compute_rebound(curve) * curve.velocity * (until - curve.time[-1])
        time, position = np.append(time, until), np.append(position, last)
    return time, position


def _separate(heights: dict[str, float], distance: float) -> dict[str, float]:
    """Return the heights of labels, moved downwards where two labels are closer than `distance`."""
    moved: dict[str, float] = {}
    for key in sorted(heights, key=lambda name: -heights[name]):
        lowest = min(moved.values(), default=np.inf)
        moved[key] = min(heights[key], lowest - distance)
    return moved
