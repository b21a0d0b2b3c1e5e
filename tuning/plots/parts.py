"""Functions that several plots use: lines for limits, legends, logarithmic axes, conversion to SVG."""

import html
import io
import re
from collections.abc import Callable, Mapping
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from jaxhil.simulation.contact_plot import BLACK

INTERVAL_SIGMAS = 1.96  # half width of a 95 % interval [standard deviations]
MARKERS = {"before": "^", "literature": "s", "tuned": "o"}
ID_PATTERN = re.compile(r'<g id="[^"]*"')
LINK_PATTERN = re.compile(r'<a xlink:href="#scenario-(\d+)"[^>]*>')


def draw_limit(line: Callable[..., Any], limit: float | None, width: float = 1.2, **style: Any) -> None:
    """Draw a line at the limit; draw none if the limit is None, 0 or infinite (for logarithmic axes).

    `line` is `Axes.axvline` or `Axes.axhline`.
    """
    if limit is not None and 0 < limit < np.inf:
        line(limit, color=BLACK, linewidth=width, linestyle="--", label=f"limit {limit:g}", **style)


def legend_above(axes: Axes, columns: int, **style: Any) -> Any:
    """Draw the legend above the axes, so that it does not hide data."""
    legend_place: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    return axes.legend(ncols=columns, fontsize=8, frameon=False, **legend_place, **style)


def name_rows(axes: Axes, names: list[str]) -> None:
    """Label the rows of a plot, from top to bottom, with the names of compensators."""
    axes.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=8)
    axes.set_ylim(len(names) - 0.5, -0.5)


def set_scale(axis: Axis, low: float, high: float, logarithmic: bool) -> None:
    """Set an axis to a logarithmic or linear scale, with suitable ticks for values from `low` to `high`."""
    if logarithmic:
        (axis.axes.set_xscale if axis is axis.axes.xaxis else axis.axes.set_yscale)("log")
        set_plain_ticks(axis, low, high)
    else:
        axis.set_major_locator(MaxNLocator(6, steps=(1, 2, 2.5, 5, 10)))


def set_plain_ticks(axis: Axis, low: float, high: float) -> None:
    """Set the ticks of a logarithmic axis from `low` to `high`, with labels like 0.02 instead of powers."""
    decades = np.log10(high / low)
    factors = (1.0,) if decades > 5 else (1.0, 3.0) if decades > 2.2 else (1.0, 2.0, 5.0)
    if decades < 0.9:
        axis.set_major_locator(MaxNLocator(5, steps=(1, 2, 2.5, 5, 10)))
    else:
        axis.set_major_locator(LogLocator(subs=factors))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


@matplotlib.style.context("default")
def as_svg(figure: Figure, points: Mapping[int, str] | None = None) -> str:
    """Return a figure as an SVG element.

    `points` maps the index of a scenario to the text of the link at that scenario's point.
    """
    content = io.StringIO()
    FigureCanvasSVG(figure)
    # With a fixed salt, the names of the elements depend only on the content of the figure.
    with rc_context({"svg.hashsalt": "jaxhil", "svg.fonttype": "none"}):
        figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    svg = content.getvalue()
    svg = ID_PATTERN.sub("<g", svg[svg.index("<svg") :])
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)

    def link(match: re.Match[str]) -> str:
        index = int(match[1])
        label = html.escape(f"scenario {index}: {(points or {}).get(index, '')}")
        return f'<a href="#scenario-{index}" aria-label="{label}"><title>{label}</title>'

    return LINK_PATTERN.sub(link, svg).replace("xlink:href", "href")
