"""Pictures of a comparison: errors with their intervals, and how transparent the laws are."""

from collections.abc import Mapping, Sequence

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from jaxhil.simulation.contact_plot import BLACK, GREEN, LABELS, STYLES, finish, new_figure
from tuning.benchmark.study import LITERATURE, TUNED, LawFigures
from tuning.benchmark.tables import best
from tuning.pictures.plots import MARKERS

COLUMNS = 4  # of panels
TRANSPARENCY = {
    "early": "transparency, push at 25 % [1]",
    "late": "transparency, push at 75 % [1]",
    "slope": "slope of e against e* [1]",
    "peak": "peak command / reference's peak [1]",
}


@matplotlib.style.context("default")
def errors_plot(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]], limit: float) -> Picture:
    """The rms error of every law with its interval, a panel for every mechanism."""
    keys = _keys(names, found)
    laws = list(dict.fromkeys(one.law for name in names for one in found[name]))
    across = min(COLUMNS, len(names))
    down = -(-len(names) // across)
    height = 0.9 + (0.14 + 0.06 * len(keys)) * len(laws)
    size = (2.2 + 2.6 * across, 1.2 + height * down)
    picture = new_figure(size, "Restitution error on fresh scenarios", above=0.9, below=0.75)
    panels = picture.subplots(down, across, sharex=True, sharey=True, squeeze=False)
    for panel, name in zip(panels.flat, names, strict=False):
        by_law = {one.law: one for one in found[name]}
        for key, off in zip(keys, _offsets(len(keys)), strict=True):
            places = [i for i, law in enumerate(laws) if law in by_law and key in by_law[law].figures]
            figures = [by_law[laws[i]].figures[key]["rms"] for i in places]
            colour = STYLES[key][0] if key in STYLES else GREEN
            heights = np.array(places) + off
            for height_, one in zip(heights, figures, strict=True):
                panel.plot([100 * one.low, 100 * one.high], [height_, height_], color=colour, linewidth=1.5)
            values = [100 * one.value for one in figures]
            marker = MARKERS.get(key, "D")
            panel.plot(values, heights, marker, color=colour, markersize=4, label=LABELS.get(key, key))
        panel.axvline(
            100 * limit, color=BLACK, linewidth=1.2, linestyle="--", label=f"limit {100 * limit:g} %"
        )
        panel.set_xscale("log")
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.tick_params(axis="x", labelsize=8)
        panel.set_title(name.removeprefix("suite-"), fontsize=9)
        finish(panel, None)
    for panel in list(panels.flat)[len(names) :]:
        panel.set_visible(False)
    first = panels[0, 0]
    first.set_ylim(len(laws) - 0.5, -0.5)
    for panel in panels[:, 0]:
        panel.set_yticks(range(len(laws)), [law.replace("_", " ") for law in laws], fontsize=8)
    picture.subplots_adjust(left=1.6 / size[0], hspace=0.42 / height, wspace=0.08)
    for panel in list(panels.flat)[max(0, len(names) - across) : len(names)]:
        panel.set_xlabel("rms of |e - e*| [%]")
        panel.tick_params(labelbottom=True)
    handles, labels = first.get_legend_handles_labels()
    picture.legend(handles, labels, loc="lower center", ncols=4, frameon=False, fontsize=9)
    return picture


@matplotlib.style.context("default")
def transparency_plot(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> Picture:
    """Transparency, slope and peak force of every law, tuned: a point for every mechanism."""
    laws = list(dict.fromkeys(one.law for name in names for one in found[name]))
    size = (12.0, 1.75 + 0.34 * len(laws))
    gains = "Tuned gains" if TUNED in _keys(names, found) else "The literature's gains"
    picture = new_figure(size, f"Is it still a test of the hardware? {gains}", above=0.6, below=0.95)
    panels = picture.subplots(1, len(TRANSPARENCY), sharey=True)
    picture.subplots_adjust(left=1.6 / size[0], wspace=0.08)
    for panel, (key, title) in zip(panels, TRANSPARENCY.items(), strict=True):
        low, high = (0.3, 100.0) if key == "peak" else (-1.0, 2.5)
        for place, law in enumerate(laws):
            values = [best(one)[key].value for name in names for one in found[name] if one.law == law]
            spread = place + np.linspace(-0.25, 0.25, max(len(values), 2))[: len(values)]
            # What lies beyond is drawn at the edge.
            values = np.clip(values, low, high)
            label = None if place else "a mechanism each, from above in the order given"
            style = {"color": STYLES[TUNED][0], "markersize": 4, "alpha": 0.6, "clip_on": False}
            panel.plot(values, spread, "o", label=label, **style)
        panel.axvline(1, color=BLACK, linewidth=1.2, linestyle="--", label="1: as in space")
        panel.set_xlim(low, high)
        if key == "peak":
            panel.set_xscale("log")
        panel.set_xlabel(title, fontsize=9)
        finish(panel, None)
    panels[0].set_yticks(range(len(laws)), [law.replace("_", " ") for law in laws], fontsize=8)
    panels[0].set_ylim(len(laws) - 0.5, -0.5)
    handles, labels = panels[0].get_legend_handles_labels()
    picture.legend(handles, labels, loc="lower center", ncols=2, frameon=False, fontsize=9)
    return picture


def _keys(names: Sequence[str], found: Mapping[str, Sequence[LawFigures]]) -> list[str]:
    """Which gains there are figures of: the literature's, settings, tuned ones."""
    there = {key: None for name in names for one in found[name] for key in one.figures}
    last = {LITERATURE: 0, TUNED: 2}
    return sorted(there, key=lambda key: last.get(key, 1))


def _offsets(number: int) -> list[float]:
    return [0.3 * (place - (number - 1) / 2) / max(number - 1, 1) for place in range(number)]
