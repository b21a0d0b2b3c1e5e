"""Motion simulator from runs without contact: order, parameters, delay and unexplained residuals.

The delay is the sum of the delays of the motion and of the position sensor. Neither a log nor a compensator
with fixed gains can separate the two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, stats

from tuning.identification.frf import Spectrum, compute_spectrum
from tuning.identification.rational import MotionModel, SpectralLines, SpectrumFit, fit_structure
from tuning.identification.records import CampaignTiming, LoggedRun
from tuning.identification.structure_choice import (
    StructureCandidate,
    choose_structure,
    compute_criterion,
    compute_residual_ratio,
)

SETTLING_TIME_CONSTANTS = 10.0  # time constants that a transient lasts
ASSUMED_TIME_CONSTANT = 0.05  # s, assumed time constant before the fit
MAX_REDUCED_CHI_SQUARE = 1.3  # chi-squared per degree of freedom above which the intervals are widened
MODEL_ERROR_P_VALUE = (
    1e-6  # p-value below which a model error is added; low, because it widens the intervals a lot
)
MODEL_ERROR_BANDS = 10  # frequency bands, in each of which the model error is constant
MAX_MODEL_ERROR = 10.0  # largest relative model error
MODEL_ERROR_ITERATIONS = 3  # iterations of the fit and the model error


@dataclass(frozen=True)
class FreeMotion:
    """Motion simulator fitted to runs without contact."""

    lines: SpectralLines  # with the measured noise
    spectra: tuple[Spectrum, ...]  # one per run
    chosen: StructureCandidate
    candidates: tuple[StructureCandidate, ...]
    gain: tuple[float, float]  # measured over desired position, and its standard deviation
    other_hold_gain: float  # decrease of the criterion with the other hold; negative: it rises
    beyond: float = 0.0  # relative model error at each line in addition to the noise

    @property
    def model(self) -> MotionModel:
        return self.chosen.fit.model

    @property
    def fit(self) -> SpectrumFit:
        return self.chosen.fit

    @property
    def left(self) -> float:
        """Return the residual power over the noise power."""
        error, noise = self.misfit()
        return float(2.0 * np.sum(np.abs(error / noise) ** 2)) / max(self.fit.freedom, 1)

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance of the model's parameters, wider if the residual exceeds the noise."""
        unexplained = self.fit.chi2 / max(self.fit.freedom, 1)
        return self.fit.covariance * (unexplained if unexplained > MAX_REDUCED_CHI_SQUARE else 1.0)

    @property
    def noise_std(self) -> float:
        """Return the standard deviation of the position readings' noise [m]."""
        return float(np.sqrt(np.mean([spectrum.noise_std**2 for spectrum in self.spectra])))

    def lag(self, frequency: float) -> tuple[float, float]:
        """Return the total phase delay [s] at a frequency [Hz], and its standard deviation."""
        s = np.array([2j * np.pi * frequency])
        slopes = np.imag(self.model.slopes(s)[:, 0]) / (2.0 * np.pi * frequency)
        phase = np.angle(self.model.response(s)[0])
        return float(-phase / (2.0 * np.pi * frequency)), float(np.sqrt(slopes @ self.covariance @ slopes))

    def misfit(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the model's complex relative error at each line, and the noise's standard deviation."""
        predicted = self.model.predict(self.lines)
        return (self.lines.output - predicted) / predicted, self.lines.std / np.abs(predicted)


def fit_free_motion(
    runs: Sequence[LoggedRun], timing: CampaignTiming, order: int | None = None
) -> FreeMotion | None:
    """Fit the motion simulator to all free runs together; return None if none is long enough."""
    spectra = compute_spectra(runs, timing)
    if not spectra:
        return None
    lines = concatenate_lines(spectra, timing)
    chosen, candidates = choose_structure(lines, order)
    # A model of one order more can compensate a wrong hold.
    highest = chosen.fit.model.structure.order + 1
    other_lines = replace(lines, hold="linear" if lines.hold == "zoh" else "zoh")
    other_hold = chosen.criterion - compute_criterion(
        choose_structure(other_lines, order, highest)[0].fit, compute_residual_ratio(candidates)
    )
    beyond, weighed = 0.0, lines
    for _ in range(MODEL_ERROR_ITERATIONS):
        beyond = estimate_model_error(chosen.fit.model, lines)
        if beyond == 0.0:
            break
        expected = np.abs(chosen.fit.model.predict(lines))
        weighed = replace(lines, std=np.hypot(lines.std, beyond * expected))
        chosen = replace(chosen, fit=fit_structure(chosen.fit.model.structure, weighed))
    gain = estimate_static_gain(chosen.fit, weighed)
    return FreeMotion(lines, tuple(spectra), chosen, tuple(candidates), gain, other_hold, beyond)


def estimate_model_error(model: MotionModel, lines: SpectralLines) -> float:
    """Return the relative model error at each line (rms), or 0 if noise explains the residual.

    A model error is smooth: all lines of a band share one error. It is therefore estimated from the means
    over bands and multiplied by the root of the number of lines. Otherwise lines with little noise would
    determine the error elsewhere. It is relative to the model's output, since a measured output without
    response is noise.
    """
    expected = model.predict(lines)
    size = np.abs(expected)
    errors, variances, counts = [], [], []
    for band in np.array_split(np.argsort(lines.frequency), min(MODEL_ERROR_BANDS, len(lines))):
        weight = size[band] ** 2 / lines.std[band] ** 2
        relative = (lines.output[band] - expected[band]) / expected[band]
        errors.append(np.abs(np.sum(weight * relative) / weight.sum()))
        variances.append(1.0 / weight.sum())
        counts.append(len(band))
    power, variance = np.square(errors), np.array(variances)
    freedom = 2 * len(power) - model.structure.size
    if freedom < 1 or stats.chi2.sf(np.sum(2.0 * power / variance), freedom) > MODEL_ERROR_P_VALUE:
        return 0.0

    def excess(logarithm: float) -> float:
        return float(np.sum(2.0 * power / (variance + np.exp(2.0 * logarithm)))) - freedom

    least, most = np.log(1e-9), np.log(MAX_MODEL_ERROR)
    root: Any = optimize.brentq(excess, least, most) if excess(most) < 0.0 else most
    return float(np.exp(root) * np.sqrt(np.mean(counts)))


def compare_free_motion(
    runs: Sequence[LoggedRun], timing: CampaignTiming, model: MotionModel
) -> FreeMotion | None:
    """Compare the free runs with a known model, without fitting; return None if no run is long enough."""
    spectra = compute_spectra(runs, timing)
    if not spectra:
        return None

    def held(lines: SpectralLines) -> SpectrumFit:
        size = len(model.parameters)
        return SpectrumFit(model, np.zeros((size, size)), (model.predict(lines) - lines.output) / lines.std)

    lines = concatenate_lines(spectra, timing)
    other_lines = replace(lines, hold="linear" if lines.hold == "zoh" else "zoh")
    fit, inflation = held(lines), max(1.0, held(lines).chi2 / max(held(lines).freedom, 1))
    candidate = StructureCandidate(fit, compute_criterion(fit, inflation), "")
    gain = candidate.criterion - compute_criterion(held(other_lines), inflation)
    return FreeMotion(lines, tuple(spectra), candidate, (candidate,), estimate_static_gain(fit, lines), gain)


def compute_spectra(runs: Sequence[LoggedRun], timing: CampaignTiming) -> list[Spectrum]:
    """Return the spectra of the runs that are long enough."""
    rest = round(SETTLING_TIME_CONSTANTS * ASSUMED_TIME_CONSTANT / timing.control_period)
    spectra = []
    for run in runs:
        result = compute_spectrum(
            run.position_desired, run.position_measured, run.valid & np.isfinite(run.position_measured),
            timing.control_period, rest,
        )  # fmt: skip
        if result is not None and len(result.frequency) >= 4:
            spectra.append(result)
    return spectra


def concatenate_lines(spectra: Sequence[Spectrum], timing: CampaignTiming) -> SpectralLines:
    """Return the lines of several runs, concatenated."""
    return SpectralLines(
        np.concatenate([spectrum.frequency for spectrum in spectra]),
        np.concatenate([spectrum.command for spectrum in spectra]),
        np.concatenate([spectrum.output for spectrum in spectra]),
        np.concatenate([spectrum.std for spectrum in spectra]),
        timing.control_period,
        timing.command_hold,
        timing.command_latency,
        timing.shift,
    )


def estimate_static_gain(fit: SpectrumFit, lines: SpectralLines) -> tuple[float, float]:
    """Return the static gain if it were free, and its standard deviation, by one Newton step from 1."""
    s, command = lines.copies
    scale = np.sqrt(2.0) / lines.std
    predicted = fit.model.predict(lines)
    slopes = np.sum(fit.model.slopes(s) * fit.model.response(s) * command, axis=1)
    jacobian = np.concatenate([predicted[None], slopes]) * scale
    jacobian = np.concatenate([jacobian.real, jacobian.imag], axis=1).T
    left = (lines.output - predicted) * scale
    size = np.linalg.norm(jacobian, axis=0)
    curvature = jacobian.T @ jacobian / np.outer(size, size)
    covariance = np.linalg.pinv(curvature, hermitian=True) / np.outer(size, size)
    step = covariance @ (jacobian.T @ np.concatenate([left.real, left.imag]))
    return float(1.0 + step[0]), float(np.sqrt(covariance[0, 0]))
