"""Plot for the summary page of a bundle: restitution errors, and ranges of the tuning scenarios."""

import io
from collections.abc import Mapping
from typing import Any

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxhil.errors import to_one_line
from jaxhil.simulation.contact_plot import BLACK, BLUE, CURVE_LABELS, ORANGE, VERMILION, finish_axes

COLOURS = {"before": VERMILION, "literature": ORANGE, "tuned": BLUE}
HATCHES = {"before": "///", "literature": "...", "tuned": ""}
ERROR_STATISTICS = {"rms": "rms", "p99": "99th percentile", "max": "largest"}  # statistics of |e - e*|
# Label, displayed unit, and factor from the SI unit, of each quantity in a gain file's "envelope".
ENVELOPE_QUANTITIES = {
    "contact_frequency": ("contact frequency", "Hz", 1.0),
    "delay": ("delay", "ms", 1e3),
    "approach_velocity": ("approach velocity", "mm/s", 1e3),
    "force": ("contact force", "N", 1.0),
}


@matplotlib.style.context("default")
def summary_png(document: Mapping[str, Any]) -> bytes:
    """Return a PNG plot: restitution errors before and after tuning, and ranges of the tuning scenarios.

    `document` is the content of a gain file.
    """
    figure = Figure(figsize=(9.3, 3.1))
    FigureCanvasAgg(figure)
    left = figure.add_axes((0.075, 0.2, 0.48, 0.6))
    _draw_errors(left, document)
    spans = [(key, span) for key, span in document["envelope"].items() if _is_range(span)][:4]
    figure.text(0.61, 0.93, "Ranges of the tuning (the gains are valid there)", fontsize=10, va="center")
    if not spans:
        figure.text(0.61, 0.5, "not stated in the gain file", fontsize=9)
    for number, (key, span) in enumerate(spans):
        _draw_range(figure.add_axes((0.63, 0.72 - 0.2 * number, 0.34, 0.06)), key, span)
    file = io.BytesIO()
    figure.savefig(file, dpi=160, format="png", metadata={"Software": None})
    return file.getvalue()


def _draw_errors(axes: Axes, document: Mapping[str, Any]) -> None:
    """Draw bars of each gain set's errors, in the nominal run and in scenarios not used for tuning."""
    is_one_axis = document.get("axes", 1) == 1
    groups = _error_groups(document["figures"], "robust" if is_one_axis else "twist_error")
    title, label = ("Restitution error |e - e*|", "|e - e*| [1]") if is_one_axis else ("Twist error",) * 2
    series = [name for name in COLOURS if any(name in values for _, values in groups)]
    width = 0.8 / max(1, len(series))
    axes.set_title(title, fontsize=10, loc="left", y=1.13)
    for index, name in enumerate(series):
        heights = [(i, values[name]) for i, (_, values) in enumerate(groups) if name in values]
        centres = [i + (index - (len(series) - 1) / 2) * width for i, _ in heights]
        bars = axes.bar(
            centres, [value for _, value in heights], width * 0.92, color=COLOURS[name], hatch=HATCHES[name],
            edgecolor="white", linewidth=0.4, label=CURVE_LABELS[name].partition(":")[0],
        )  # fmt: skip
        axes.bar_label(bars, [f"{value:.2g}" for _, value in heights], fontsize=6, padding=1)
    axes.set_xticks(range(len(groups)), [label for label, _ in groups], fontsize=8)
    axes.tick_params(axis="y", labelsize=8)
    axes.set_ylabel(label, fontsize=9)
    finish_axes(axes, None)
    axes.grid(False, axis="x")
    positive = [value for _, values in groups for value in values.values() if value > 0]
    if positive:
        axes.set_yscale("log")
        axes.set_ylim(min(positive) / 2, max(positive) * 3)
        legend_place: dict[str, Any] = {
            "loc": "lower left",
            "bbox_to_anchor": (0, 0.98),
            "borderaxespad": 0.2,
        }
        axes.legend(ncols=3, fontsize=8, frameon=False, **legend_place)


def _error_groups(metrics: Mapping[str, Any], robust: str) -> list[tuple[str, dict[str, float]]]:
    """Return for each group of bars its label, and the error [1] of each set of gains.

    `robust` is the key of the errors in scenarios that were not used for tuning.
    """
    groups = []
    for kind, key, label in (
        ("nominal", "rms", "nominal run,\nrms"),
        *((robust, key, f"scenarios,\n{text}") for key, text in ERROR_STATISTICS.items()),
    ):
        errors = metrics.get(kind, {})
        values = {
            name: statistics[key]
            for name, statistics in (errors.items() if isinstance(errors, Mapping) else ())
            if name in COLOURS
            and isinstance(statistics, Mapping)
            and isinstance(statistics.get(key), (int, float))
        }
        if values:
            groups.append((label, values))
    return groups


def _draw_range(axes: Axes, key: str, span: Mapping[str, Any]) -> None:
    """Draw the range of one quantity as a bar on an axis of its own, in the displayed unit."""
    name, unit, factor = ENVELOPE_QUANTITIES.get(key, (key.replace("_", " "), span["unit"], 1.0))
    low, high = sorted((factor * span["low"], factor * span["high"]))
    margin = 0.25 * (high - low) or 0.25 * abs(high) or 1.0
    axes.barh(0, high - low, left=low, height=1, color=BLUE)
    axes.plot([low, high], [0, 0], linestyle="none", marker="|", color=BLACK, markersize=9)
    axes.set(xlim=(low - margin, high + margin), ylim=(-0.9, 0.9), yticks=[])
    axes.tick_params(axis="x", labelsize=7, pad=1.5)
    axes.set_title(
        f"{to_one_line(name, 30)}: {low:.3g} to {high:.3g} {to_one_line(unit, 10)}",
        fontsize=8,
        loc="left",
        pad=3,
    )
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)


def _is_range(value: Any) -> bool:
    """Return whether a value is a mapping with the numbers "low" and "high"."""
    return isinstance(value, Mapping) and all(
        isinstance(value.get(key), (int, float)) for key in ("low", "high")
    )
