"""Plots of an identification: fit of the model to the logs, and estimates compared with the prior."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxhil.simulation.contact_plot import (
    BLACK,
    BLUE,
    ORANGE,
    SKY_BLUE,
    VERMILION,
    create_figure,
    finish_axes,
)
from tuning.identification.contact_fit import ContactFit
from tuning.identification.free_motion import FreeMotion
from tuning.identification.result import Identification
from tuning.number_format import format_number
from tuning.plots.parts import INTERVAL_SIGMAS, legend_above
from tuning.terminal import format_key

DOT_STYLE: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 2.5, "markeredgewidth": 0}
PLOTTED_CONTACTS = 3  # number of contacts that are plotted over time
# Limits of the lags at which the correlations of the residuals are plotted [rows of the log].
MAX_AUTOCORRELATION_LAG, MIN_CROSS_CORRELATION_LAG, MAX_CROSS_CORRELATION_LAG = 25, -20, 100
# Smallest distance from 0 [standard deviations] at which an estimate's relative deviations are plotted.
MIN_ESTIMATE_SIGMAS = 3.0


def draw_identification(result: Identification, entries: Sequence[Mapping[str, Any]]) -> dict[str, Figure]:
    """Draw the plots of an identification, and return them by file name; plots without data are omitted.

    `entries` are the estimates with their priors, as in `identification.json`.
    """
    figures = {}
    if result.motion is not None:
        figures["bode.png"] = plot_bode(result.motion)
    if result.contact is not None:
        prior = next((entry["prior"] for entry in entries if entry["key"] == "rig.force_sensor.delay"), None)
        figures["delay.png"] = plot_force_delay(result.contact, prior)
        figures["contacts.png"] = plot_contacts(result.contact)
        figures["residuals.png"] = plot_residuals(result.contact)
    figures["compare.png"] = plot_estimates(entries)
    return figures


@matplotlib.style.context("default")
def plot_bode(motion: FreeMotion) -> Figure:
    """Plot a motion simulator's frequency response (measured, modelled), noise, distortion and coherence."""
    lines, fit = motion.lines, motion.fit
    order = np.argsort(lines.frequency)
    frequency = lines.frequency[order]
    measured, modelled = ((y / lines.command)[order] for y in (lines.output, fit.model.predict(lines)))
    noise = (lines.std / np.abs(lines.command))[order]
    slopes = fit.model.slopes(2j * np.pi * frequency)
    band = np.sqrt(np.maximum(np.einsum("il,ij,jl->l", slopes, motion.covariance, slopes.conj()).real, 0.0))
    figure = create_figure((11, 6.6), "Motion simulator: from the desired to the measured position")
    (size, phase), (error, coherence) = figure.subplots(2, 2, sharex=True)
    size.plot(frequency, _to_decibel(measured), color=BLUE, label="measured", **DOT_STYLE)
    size.plot(
        frequency,
        _to_decibel(modelled),
        color=BLACK,
        linewidth=1.2,
        label=f"model: {motion.model.structure.name.replace('_', ' ')}",
    )
    size.plot(frequency, _to_decibel(noise), color="0.6", linewidth=1.2, label="noise of the measurement")
    size.plot(
        frequency, _to_decibel(measured - modelled), color=ORANGE, label="measured minus model", **DOT_STYLE
    )
    for level, name, line in zip(_find_distortion_levels(motion), ("odd", "even"), ("--", ":"), strict=True):
        if level:
            size.axhline(
                _to_decibel(level), color=VERMILION, linestyle=line, linewidth=1.2, label=f"{name} distortion"
            )
    size.set(ylabel="magnitude [dB]", xscale="log")
    finish_axes(size, "center left")
    phase.plot(frequency, _compute_phase(measured), color=BLUE, label="measured", **DOT_STYLE)
    phase.plot(frequency, _compute_phase(modelled), color=BLACK, linewidth=1.2, label="model")
    phase.set(ylabel="phase [degrees]")
    finish_axes(phase, "lower left")
    share, chance = 100.0 * np.abs(measured / modelled - 1.0), 100.0 * noise / np.abs(modelled)
    error.plot(frequency, share, color=BLUE, label="|measured / model - 1|", **DOT_STYLE)
    # With a probability of 95 %, the magnitude of complex normal noise is below 1.73 standard deviations.
    error.plot(frequency, np.sqrt(-np.log(0.05)) * chance, color="0.6", linewidth=1.2, label="95 % of noise")
    error.plot(
        frequency, 100.0 * INTERVAL_SIGMAS * band, color=BLACK, linewidth=1.2, label="95 % of the model"
    )
    error.set(xlabel="frequency [Hz]", ylabel="share of the response [%]", yscale="log")
    finish_axes(error, "best")
    of_lines = np.concatenate([spectrum.coherence for spectrum in motion.spectra])[order]
    coherence.plot(frequency, of_lines, color=BLUE, label="coherence", **DOT_STYLE)
    coherence.set(xlabel="frequency [Hz]", ylabel="coherence [1]", ylim=(min(0.9, of_lines.min()), 1.005))
    for axes in (error, coherence):
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    finish_axes(coherence, "lower left")
    return figure


@matplotlib.style.context("default")
def plot_force_delay(contact: ContactFit, prior: float | None) -> Figure:
    """Plot the profile likelihood of the force delay, and the delay's correlation with another parameter.

    The other parameter is the damping or, if the model has none, the surface position. `prior` is the prior's
    force delay [s].
    """
    posterior = contact.posterior
    draws = contact.draws()
    figure = create_figure((11, 4.6), "Force delay: likelihood from the contacts")
    left, right = figure.subplots(1, 2)
    low, high = np.quantile(draws[:, 0], (0.025, 0.975))
    density = np.exp(posterior.log_posterior)
    left.axvspan(1e3 * low, 1e3 * high, color=SKY_BLUE, alpha=0.3, linewidth=0, label="95 %")
    left.plot(1e3 * posterior.delays, density, color=BLUE, linewidth=1.5, label="profile of the likelihood")
    width = 1e3 * (high - low)
    if prior is not None and abs(1e3 * prior - 500.0 * (low + high)) < 4.0 * width:
        left.axvline(1e3 * prior, color=VERMILION, linestyle="--", linewidth=1.2, label="prior")
    left.set(xlabel="force delay [ms]", ylabel="likelihood / its maximum [1]")
    finish_axes(left, "best")
    name = next((name for name in posterior.names if name.startswith("damping")), "plane")
    second = draws[:, posterior.names.index(name)]
    scale, unit = (1e6, "um") if name == "plane" else (1.0, "N s/m" if name == "damping" else "SI")
    correlation = np.corrcoef(draws[:, 0], second)[0, 1]
    right.plot(1e3 * draws[::4, 0], scale * second[::4], color=BLUE, alpha=0.4, label="draws", **DOT_STYLE)
    right.set(xlabel="force delay [ms]", ylabel=f"{name} [{unit}]")
    right.set_title(f"correlation {correlation:.3f}", fontsize=10)
    finish_axes(right, None)
    return figure


@matplotlib.style.context("default")
def plot_contacts(contact: ContactFit) -> Figure:
    """Plot the measured and the modelled force of up to three contacts against time and penetration."""
    readings, problem = contact.readings, contact.problem
    depth, predicted = _compute_depth_and_force(contact)
    inside = readings.counts & (depth > 0.0)
    lanes = _select_plotted_contacts(contact, inside)
    title = f"Contacts: force over time and penetration, contact law {contact.law.name}"
    figure = create_figure((11, 6.6), title, above=0.75)
    figure.subplots_adjust(hspace=0.3)
    grid: Any = figure.subplots(2, max(len(lanes), 1), squeeze=False)
    for column, lane in enumerate(lanes):
        counts = readings.counts[:, lane]
        contact_rows = np.flatnonzero(inside[:, lane])
        shown = slice(max(0, contact_rows[0] - 20), contact_rows[-1] + 20)
        rows = np.arange(readings.force.shape[0])[shown]
        time = 1e3 * problem.motion.period * (rows - contact_rows[0])
        force = np.where(counts, readings.force[:, lane], np.nan)[shown]
        for axes, abscissa in ((grid[0, column], time), (grid[1, column], 1e3 * depth[shown, lane])):
            axes.plot(abscissa, force, color=BLUE, label="measured", **DOT_STYLE)
            axes.plot(abscissa, predicted[shown, lane], color=BLACK, linewidth=1.2, label="model")
            finish_axes(axes, None)
        grid[0, column].set_xlabel("time since the onset [ms]")
        grid[0, column].set_title(f"contact {lane + 1}", fontsize=10)
        grid[1, column].set_xlabel("penetration at the time of the force [mm]")
    for axes in grid[:, 0]:
        axes.set_ylabel("force [N]")
    if lanes:
        grid[0, 0].legend(loc="upper right", fontsize=8)
    return figure


@matplotlib.style.context("default")
def plot_residuals(contact: ContactFit) -> Figure:
    """Plot the whitened force residuals, their autocorrelation, and their correlation with the speed."""
    readings, problem = contact.readings, contact.problem
    depth, predicted = _compute_depth_and_force(contact)
    residuals = problem.whiten(readings.force - predicted) / readings.std
    residuals = np.where(readings.counts, residuals, np.nan)
    figure = create_figure((11, 6.6), "Residuals: measured minus modelled force, divided by the noise")
    figure.subplots_adjust(hspace=0.3)
    (over_time, by_depth), (autocorrelation, cross) = figure.subplots(2, 2)
    inside = (depth > 0.0) & readings.counts
    time = problem.motion.period * (np.arange(len(residuals))[:, None] - np.argmax(inside, axis=0))
    shown = readings.counts & (time > -0.02)
    shown &= time < 0.02 + problem.motion.period * inside.sum(axis=0).max()
    style: dict[str, Any] = {"color": BLUE, "alpha": 0.5, "label": "all contacts", **DOT_STYLE}
    over_time.plot(1e3 * time[shown], residuals[shown], **style)
    over_time.set(xlabel="time since the onset [ms]", ylabel="residual / noise [1]")
    by_depth.plot(1e3 * depth[inside], residuals[inside], **style)
    by_depth.set(xlabel="penetration at the time of the force [mm]", ylabel="residual / noise [1]")
    for axes in (over_time, by_depth):
        for side in (-INTERVAL_SIGMAS, INTERVAL_SIGMAS):
            axes.axhline(side, color=ORANGE, linestyle="--", linewidth=1, label="95 %" * (side > 0))
        axes.set_ylim(*(1.3 * np.array(axes.get_ylim())))
        finish_axes(axes, "upper right")
    _plot_correlation(
        autocorrelation,
        residuals,
        residuals,
        range(1, MAX_AUTOCORRELATION_LAG + 1),
        "lag of the autocorrelation [rows]",
    )
    rate = np.where(inside, np.gradient(depth, axis=0), np.nan)
    _plot_correlation(
        cross,
        rate,
        residuals,
        range(MIN_CROSS_CORRELATION_LAG, MAX_CROSS_CORRELATION_LAG + 1),
        "lag of the residuals behind the speed [rows]",
    )
    return figure


@matplotlib.style.context("default")
def plot_estimates(entries: Sequence[Mapping[str, Any]]) -> Figure:
    """Plot the 95 % interval of each estimate, and the prior's value, as deviations from the estimate [%].

    `entries` are the estimates, as in `identification.json`. Estimates that hardly differ from 0 are omitted.
    """
    plotted = [
        entry
        for entry in entries
        if entry["std"] and abs(entry["value"]) > MIN_ESTIMATE_SIGMAS * entry["std"]
    ]
    with_prior = [(row, entry) for row, entry in enumerate(plotted) if entry["prior"] is not None]
    title = "Estimates, compared with the prior" if with_prior else "Estimates"
    figure = create_figure((9, 1.7 + 0.3 * max(len(plotted), 1)), title, above=0.9)
    figure.subplots_adjust(left=0.34)
    axes = figure.subplots()
    for row, estimate in enumerate(plotted):
        share = [100.0 * (estimate[name] / estimate["value"] - 1.0) for name in ("low", "high")]
        axes.plot(share, [row, row], color=BLUE, linewidth=3, label="estimate, 95 %" if row == 0 else None)
        axes.plot([0.0], [row], color=BLUE, marker="o", markersize=5)
    if with_prior:
        shares = [100.0 * (entry["prior"] / entry["value"] - 1.0) for _, entry in with_prior]
        style: dict[str, Any] = {"linestyle": "none", "marker": "D", "markersize": 5, "color": VERMILION}
        axes.plot(shares, [row for row, _ in with_prior], label="prior", **style)
    names = [
        f"{format_key(entry['key'])}\n{format_number(entry['value'])} {entry['unit']}".removesuffix(" 1")
        for entry in plotted
    ]
    # Matplotlib would read text between dollar signs as a formula.
    axes.set_yticks(range(len(plotted)), [name.replace("$", r"\$") for name in names])
    axes.tick_params(axis="y", labelsize=7)
    axes.set(xlabel="deviation from the estimate [%]", ylim=(len(plotted) - 0.5, -0.5))
    axes.set_xscale("symlog", linthresh=0.1)
    most = 2.0 * max(map(abs, axes.get_xlim()))
    axes.set_xlim(-most, most)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    finish_axes(axes, None)
    if plotted:
        legend_above(axes, 2)
    return figure


def _to_decibel(value):
    return 20.0 * np.log10(np.maximum(np.abs(value), 1e-12))


def _compute_phase(response: np.ndarray) -> np.ndarray:
    return np.degrees(np.unwrap(np.angle(response)))


def _find_distortion_levels(motion: FreeMotion) -> list[float]:
    """Return the largest levels of odd and of even distortion among the runs; 0 if none was measured."""
    return [
        max(
            (level for run in motion.spectra if (level := getattr(run, parity)) is not None),
            default=0.0,
        )
        for parity in ("odd", "even")
    ]


def _compute_depth_and_force(contact: ContactFit) -> tuple[np.ndarray, np.ndarray]:
    """Return penetration [m] and modelled force [N] of the best fit, both (rows, contacts).

    The penetration of a row is taken one force delay earlier, when the force of the row acted.
    """
    delay, plane, inner = contact.posterior.best
    problem = contact.problem
    return problem.motion.at(delay)[0] - plane, problem.force(delay, plane, inner.coefficients)


def _select_plotted_contacts(contact: ContactFit, inside: np.ndarray) -> list[int]:
    """Return the indices of the contacts with the smallest, the median and the largest peak force."""
    lanes = np.flatnonzero(inside.any(axis=0))
    peak = np.max(np.where(inside, contact.readings.force, 0.0), axis=0)[lanes]
    order = lanes[np.argsort(peak, kind="stable")]
    ranks = np.linspace(0, len(order) - 1, PLOTTED_CONTACTS).round().astype(int)
    return list(dict.fromkeys(order[ranks].tolist())) if len(order) else []


def _plot_correlation(axes: Axes, x: np.ndarray, y: np.ndarray, lags: range, label: str) -> None:
    """Plot the correlation of `x` with the `y` of a later row, against the lag of `y` behind `x` [rows]."""
    values, chance = [], []
    for lag in lags:
        early, late = slice(max(0, -lag), len(x) - max(0, lag)), slice(max(0, lag), len(x) - max(0, -lag))
        a, b = x[early], y[late]
        both_finite = np.isfinite(a) & np.isfinite(b)
        power = np.sqrt(np.sum(a[both_finite] ** 2) * np.sum(b[both_finite] ** 2))
        values.append(np.sum(a[both_finite] * b[both_finite]) / power if power > 0.0 else 0.0)
        chance.append(INTERVAL_SIGMAS / np.sqrt(max(both_finite.sum(), 1)))
    axes.fill_between(
        list(lags), -np.array(chance), chance, color=SKY_BLUE, alpha=0.4, linewidth=0, label="95 %"
    )
    axes.plot(list(lags), values, color=BLUE, linewidth=1, marker="o", markersize=2.5, label="correlation")
    most = 1.6 * max(*chance, *np.abs(values))  # the factor leaves space for the legend
    axes.set_ylim(-most, most)
    axes.set(xlabel=label, ylabel="correlation of residuals [1]")
    finish_axes(axes, "upper right")
