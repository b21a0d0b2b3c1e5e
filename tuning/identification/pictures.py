"""Pictures of an identification: how well the model explains the logs, and what they changed.

In the units and colours of those of a run (`jaxhil.simulation.contact_plot`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxhil.simulation.contact_plot import BLACK, BLUE, GREEN, ORANGE, SKY, VERMILION, finish, new_figure
from tuning.identification.contact import ContactFit
from tuning.identification.free_motion import FreeMotion
from tuning.identification.result import Identification

DOTS: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 2.5, "markeredgewidth": 0}
WIDE = 1.96  # standard deviations of a 95 % interval
TOUCHES = 3  # drawn over time
COLOURS = (BLUE, ORANGE, GREEN)
LAGS, EARLIER, LATER = 25, -20, 100  # rows, of the residuals' correlations
PLAINLY = 3.0  # standard deviations from 0 at which a relative change means something


def draw(found: Identification, entries: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """The pictures by the names of their files; without free motion, or contact, not those of it.

    `entries`: the estimates with their priors, as `identification.json` has them."""
    figures = {}
    if found.motion is not None:
        figures["bode.png"] = bode(found.motion)
    if found.contact is not None:
        told = next((one["prior"] for one in entries if one["key"] == "rig.force_sensor.delay"), None)
        figures["delay.png"] = delay(found.contact, told)
        figures["contacts.png"] = contacts(found.contact)
        figures["residuals.png"] = residuals(found.contact)
    figures["compare.png"] = compare(entries)
    return figures


@matplotlib.style.context("default")
def bode(motion: FreeMotion) -> Figure:
    """The measured response over the model's, with what noise and distortion there is, and coherence."""
    lines, fit = motion.lines, motion.fit
    order = np.argsort(lines.frequency)
    frequency = lines.frequency[order]
    measured, modelled = ((one / lines.command)[order] for one in (lines.output, fit.model.predict(lines)))
    noise = (lines.std / np.abs(lines.command))[order]
    slopes = fit.model.slopes(2j * np.pi * frequency)
    band = np.sqrt(np.maximum(np.einsum("il,ij,jl->l", slopes, motion.covariance, slopes.conj()).real, 0.0))
    figure = new_figure((11, 6.6), "Motion simulator: from the desired to the measured position")
    (size, phase), (off, coherence) = figure.subplots(2, 2, sharex=True)
    size.plot(frequency, _decibel(measured), color=BLUE, label="measured", **DOTS)
    size.plot(frequency, _decibel(modelled), color=BLACK, linewidth=1.2, label=f"model: {_name(motion)}")
    size.plot(frequency, _decibel(noise), color="0.6", linewidth=1.2, label="noise of the lines")
    size.plot(frequency, _decibel(measured - modelled), color=ORANGE, label="measured less model", **DOTS)
    for level, name, line in zip(_distortions(motion), ("odd", "even"), ("--", ":"), strict=True):
        if level:
            size.axhline(
                _decibel(level), color=VERMILION, linestyle=line, linewidth=1.2, label=f"{name} distortion"
            )
    size.set(ylabel="magnitude [dB]", xscale="log")
    finish(size, "center left")
    phase.plot(frequency, _degrees(measured), color=BLUE, label="measured", **DOTS)
    phase.plot(frequency, _degrees(modelled), color=BLACK, linewidth=1.2, label="model")
    phase.set(ylabel="phase [degrees]")
    finish(phase, "lower left")
    share, chance = 100.0 * np.abs(measured / modelled - 1.0), 100.0 * noise / np.abs(modelled)
    off.plot(frequency, share, color=BLUE, label="measured off the model", **DOTS)
    # |complex normal| is below 1.73 standard deviations in 95 of 100 lines.
    off.plot(frequency, np.sqrt(-np.log(0.05)) * chance, color="0.6", linewidth=1.2, label="95 % of noise")
    off.plot(frequency, 100.0 * WIDE * band, color=BLACK, linewidth=1.2, label="95 % of the model")
    off.set(xlabel="frequency [Hz]", ylabel="share of the response [%]", yscale="log")
    finish(off, "best")
    of_lines = np.concatenate([one.coherence for one in motion.spectra])[order]
    coherence.plot(frequency, of_lines, color=BLUE, label="coherence", **DOTS)
    coherence.set(xlabel="frequency [Hz]", ylabel="coherence [1]", ylim=(min(0.9, of_lines.min()), 1.005))
    for axes in (off, coherence):
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    finish(coherence, "lower left")
    return figure


@matplotlib.style.context("default")
def delay(contact: ContactFit, told: float | None) -> Figure:
    """What the touches say of the force delay, and what hangs together with it."""
    posterior = contact.posterior
    draws = contact.draws()
    figure = new_figure((11, 4.6), "Force delay: what the touches say of it")
    left, right = figure.subplots(1, 2)
    low, high = np.quantile(draws[:, 0], (0.025, 0.975))
    density = np.exp(posterior.log_posterior)
    left.axvspan(1e3 * low, 1e3 * high, color=SKY, alpha=0.3, linewidth=0, label="95 %")
    left.plot(1e3 * posterior.delays, density, color=BLUE, linewidth=1.5, label="profile of the likelihood")
    reach = 1e3 * (high - low)
    if told is not None and abs(1e3 * told - 500.0 * (low + high)) < 4.0 * reach:
        left.axvline(1e3 * told, color=VERMILION, linestyle="--", linewidth=1.2, label="prior")
    left.set(xlabel="force delay [ms]", ylabel="likelihood over its greatest [1]")
    finish(left, "best")
    name = next((one for one in posterior.names if one.startswith("damping")), "plane")
    other = draws[:, posterior.names.index(name)]
    scale, unit = (1e6, "um") if name == "plane" else (1.0, "N s/m" if name == "damping" else "SI")
    correlation = np.corrcoef(draws[:, 0], other)[0, 1]
    right.plot(1e3 * draws[::4, 0], scale * other[::4], color=BLUE, alpha=0.4, label="draws", **DOTS)
    right.set(xlabel="force delay [ms]", ylabel=f"{name} [{unit}]")
    right.set_title(f"correlation {correlation:.3f}", fontsize=10)
    finish(right, None)
    return figure


@matplotlib.style.context("default")
def contacts(contact: ContactFit) -> Figure:
    """Measured force and the model's over time and over depth, of three touches."""
    readings, problem = contact.readings, contact.problem
    depth, predicted = _modelled(contact)
    inside = readings.counts & (depth > 0.0)
    lanes = _shown(contact, inside)
    title = f"Touches: force over time and depth, law {contact.law.name}"
    figure = new_figure((11, 6.6), title, above=0.75)
    figure.subplots_adjust(hspace=0.3)
    grid: Any = figure.subplots(2, max(len(lanes), 1), squeeze=False)
    for column, lane in enumerate(lanes):
        counts = readings.counts[:, lane]
        touched = np.flatnonzero(inside[:, lane])
        around = slice(max(0, touched[0] - 20), touched[-1] + 20)
        rows = np.arange(readings.force.shape[0])[around]
        time = 1e3 * problem.motion.period * (rows - touched[0])
        force = np.where(counts, readings.force[:, lane], np.nan)[around]
        for axes, place in ((grid[0, column], time), (grid[1, column], 1e3 * depth[around, lane])):
            axes.plot(place, force, color=BLUE, label="measured", **DOTS)
            axes.plot(place, predicted[around, lane], color=BLACK, linewidth=1.2, label="model")
            finish(axes, None)
        grid[0, column].set_xlabel("time since the touch [ms]")
        grid[0, column].set_title(f"touch {lane}", fontsize=10)
        grid[1, column].set_xlabel("depth when the force was [mm]")
    for axes in grid[:, 0]:
        axes.set_ylabel("force [N]")
    if lanes:
        grid[0, 0].legend(loc="upper right", fontsize=8)
    return figure


@matplotlib.style.context("default")
def residuals(contact: ContactFit) -> Figure:
    """What the contact law leaves of the force, over its noise: in time, by depth, and correlated."""
    readings, problem = contact.readings, contact.problem
    depth, predicted = _modelled(contact)
    left = problem.whiten(readings.force - predicted) / readings.std
    left = np.where(readings.counts, left, np.nan)
    figure = new_figure((11, 6.6), "Force less the model's, over the noise")
    figure.subplots_adjust(hspace=0.3)
    (over_time, by_depth), (own, cross) = figure.subplots(2, 2)
    inside = (depth > 0.0) & readings.counts
    time = problem.motion.period * (np.arange(len(left))[:, None] - np.argmax(inside, axis=0))
    shown = readings.counts & (time > -0.02)
    shown &= time < 0.02 + problem.motion.period * inside.sum(axis=0).max()
    over_time.plot(1e3 * time[shown], left[shown], color=BLUE, alpha=0.5, label="all touches", **DOTS)
    over_time.set(xlabel="time since the touch [ms]", ylabel="left over noise [1]")
    by_depth.plot(1e3 * depth[inside], left[inside], color=BLUE, alpha=0.5, label="all touches", **DOTS)
    by_depth.set(xlabel="depth when the force was [mm]", ylabel="left over noise [1]")
    for axes in (over_time, by_depth):
        for side in (-WIDE, WIDE):
            axes.axhline(side, color=ORANGE, linestyle="--", linewidth=1, label="95 %" * (side > 0))
        axes.set_ylim(*(1.3 * np.array(axes.get_ylim())))
        finish(axes, "upper right")
    _correlation(own, left, left, range(1, LAGS + 1), "with itself, later by [rows]")
    command = np.where(inside, np.gradient(depth, axis=0), np.nan)
    _correlation(cross, command, left, range(EARLIER, LATER + 1), "with the speed before, by [rows]")
    return figure


@matplotlib.style.context("default")
def compare(entries: Sequence[Mapping[str, Any]]) -> Figure:
    """Every estimate's 95 % interval and the prior's value, over the estimate."""
    plain = [one for one in entries if one["std"] and abs(one["value"]) > PLAINLY * one["std"]]
    figure = new_figure((9, 1.7 + 0.3 * max(len(plain), 1)), "Estimates, and what the prior said", above=0.9)
    figure.subplots_adjust(left=0.34)
    axes = figure.subplots()
    for row, one in enumerate(plain):
        share = [100.0 * (one[name] / one["value"] - 1.0) for name in ("low", "high")]
        axes.plot(share, [row, row], color=BLUE, linewidth=3, label="estimate, 95 %" if row == 0 else None)
        axes.plot([0.0], [row], color=BLUE, marker="o", markersize=5)
    told = [(row, one) for row, one in enumerate(plain) if one["prior"] is not None]
    if told:
        shares = [100.0 * (one["prior"] / one["value"] - 1.0) for _, one in told]
        style: dict[str, Any] = {"linestyle": "none", "marker": "D", "markersize": 5, "color": VERMILION}
        axes.plot(shares, [row for row, _ in told], label="prior", **style)
    names = [f"{one['key']}\n{one['value']:.4g} {one['unit']}".removesuffix(" 1") for one in plain]
    # A key is text, not a formula.
    axes.set_yticks(range(len(plain)), [name.replace("$", r"\$") for name in names])
    axes.tick_params(axis="y", labelsize=7)
    axes.set(xlabel="distance from the estimate [%]", ylim=(len(plain) - 0.5, -0.5))
    axes.set_xscale("symlog", linthresh=0.1)
    most = 2.0 * max(map(abs, axes.get_xlim()))
    axes.set_xlim(-most, most)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    finish(axes, None)
    if plain:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, fontsize=8, frameon=False)
    return figure


def _decibel(value):
    return 20.0 * np.log10(np.maximum(np.abs(value), 1e-12))


def _degrees(response: np.ndarray) -> np.ndarray:
    return np.degrees(np.unwrap(np.angle(response)))


def _name(motion: FreeMotion) -> str:
    return motion.model.structure.name.replace("_", " ")


def _distortions(motion: FreeMotion) -> list[float]:
    """Levels of odd and even distortion, the largest of the runs; 0 where none was measured."""
    return [
        max((level for one in motion.spectra if (level := getattr(one, parity)) is not None), default=0.0)
        for parity in ("odd", "even")
    ]


def _modelled(contact: ContactFit) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] when each force was, and the best fit's force [N], (rows, touches)."""
    at, plane, inner = contact.posterior.best
    problem = contact.problem
    return problem.motion.at(at)[0] - plane, problem.force(at, plane, inner.coefficients)


def _shown(contact: ContactFit, inside: np.ndarray) -> list[int]:
    """Touches of the least, the middle and the greatest force, of those with rows in contact."""
    lanes = np.flatnonzero(inside.any(axis=0))
    peak = np.max(np.where(inside, contact.readings.force, 0.0), axis=0)[lanes]
    order = lanes[np.argsort(peak, kind="stable")]
    places = np.linspace(0, len(order) - 1, TOUCHES).round().astype(int)
    return list(dict.fromkeys(order[places].tolist())) if len(order) else []


def _correlation(axes: Axes, one: np.ndarray, other: np.ndarray, lags: range, words: str) -> None:
    """Of `one` with `other` so many rows later, all lanes together, with what chance does."""
    found, chance = [], []
    for lag in lags:
        early, late = slice(max(0, -lag), len(one) - max(0, lag)), slice(max(0, lag), len(one) - max(0, -lag))
        a, b = one[early], other[late]
        both = np.isfinite(a) & np.isfinite(b)
        power = np.sqrt(np.sum(a[both] ** 2) * np.sum(b[both] ** 2))
        found.append(np.sum(a[both] * b[both]) / power if power > 0.0 else 0.0)
        chance.append(WIDE / np.sqrt(max(both.sum(), 1)))
    axes.fill_between(list(lags), -np.array(chance), chance, color=SKY, alpha=0.4, linewidth=0, label="95 %")
    axes.plot(list(lags), found, color=BLUE, linewidth=1, marker="o", markersize=2.5, label="correlation")
    most = 1.6 * max(*chance, *np.abs(found))  # the legend above
    axes.set_ylim(-most, most)
    axes.set(xlabel=words, ylabel="correlation of what is left [1]")
    finish(axes, "upper right")
