"""Identification of the motion simulator (order, parameters and delay) from runs without contact.

The identified delay is the sum of the delays of the motion and of the position sensor. Neither a log nor a
compensator with fixed gains can distinguish the two delays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, stats

from tuning.identification.frf import Spectrum, compute_spectrum
from tuning.identification.rational import (
    STRUCTURES,
    MotionModel,
    SimulatorStructure,
    SpectralLines,
    SpectrumFit,
    fit_structure,
)
from tuning.identification.records import CampaignTiming, LoggedRun
from tuning.identification.structure_choice import (
    StructureCandidate,
    choose_structure,
    compute_criterion,
    compute_residual_ratio,
)

SETTLING_TIME_CONSTANTS = 10.0  # duration of a transient, in time constants
ASSUMED_TIME_CONSTANT = 0.05  # time constant of the motion simulator that is assumed before the fit [s]
MAX_REDUCED_CHI_SQUARE = 1.3  # chi-squared per degree of freedom above which the intervals are widened
# Minimum p-value of the residual without a model error. It is low, because a model error widens the
# intervals.
MODEL_ERROR_P_VALUE = 1e-6
MODEL_ERROR_BANDS = 10  # number of frequency bands; the model error is constant in each band
MAX_MODEL_ERROR = 10.0  # upper bound of the relative model error
MODEL_ERROR_ITERATIONS = 3  # number of alternating estimates of the parameters and of the model error


@dataclass(frozen=True)
class FreeMotion:
    """Model of the motion simulator: fitted to runs without contact, or known and compared with such runs."""

    lines: SpectralLines  # spectra of all runs, with the measured noise
    spectra: tuple[Spectrum, ...]  # spectrum of each run
    chosen: StructureCandidate
    candidates: tuple[StructureCandidate, ...]
    gain: tuple[float, float]  # static gain from desired to measured position, and its standard deviation
    other_hold_gain: float  # decrease of the information criterion if the other command hold is assumed
    model_error: float = 0.0  # relative model error at each line, in addition to the noise

    @property
    def model(self) -> MotionModel:
        return self.chosen.fit.model

    @property
    def fit(self) -> SpectrumFit:
        return self.chosen.fit

    @property
    def reduced_chi_square(self) -> float:
        """Return chi-squared per degree of freedom: the ratio of residual power to noise power."""
        error, noise = self.misfit()
        return float(2.0 * np.sum(np.abs(error / noise) ** 2)) / max(self.fit.degrees_of_freedom, 1)

    @property
    def covariance(self) -> np.ndarray:
        """Return the covariance of the model's parameters, increased if the residual exceeds the noise."""
        unexplained = self.fit.chi2 / max(self.fit.degrees_of_freedom, 1)
        return self.fit.covariance * (unexplained if unexplained > MAX_REDUCED_CHI_SQUARE else 1.0)

    @property
    def noise_std(self) -> float:
        """Return the noise of a position reading [m], as the rms of all runs."""
        return float(np.sqrt(np.mean([spectrum.noise_std**2 for spectrum in self.spectra])))

    def lag(self, frequency: float) -> tuple[float, float]:
        """Return phase delay [s] from command to reading at a frequency [Hz], and its standard deviation."""
        s = np.array([2j * np.pi * frequency])
        slopes = np.imag(self.model.slopes(s)[:, 0]) / (2.0 * np.pi * frequency)
        phase = np.angle(self.model.response(s)[0])
        return float(-phase / (2.0 * np.pi * frequency)), float(np.sqrt(slopes @ self.covariance @ slopes))

    def misfit(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the complex error and the noise at each line, both divided by the model's output."""
        predicted = self.model.predict(self.lines)
        return (self.lines.output - predicted) / predicted, self.lines.std / np.abs(predicted)


def fit_free_motion(
    runs: Sequence[LoggedRun],
    timing: CampaignTiming,
    order: int | None = None,
    structures: Sequence[SimulatorStructure] = STRUCTURES,
) -> FreeMotion | None:
    """Fit the motion simulator to all free runs together.

    Args:
        runs: Runs in free motion.
        timing: Timing of commands and readings.
        order: Order of the model, or None to choose the smallest order that explains the spectra.
        structures: Structures of the model to choose from.

    Returns:
        The fit, or None if no run is long enough.
    """
    spectra = compute_spectra(runs, timing)
    if not spectra:
        return None
    lines = concatenate_lines(spectra, timing)
    chosen, candidates = choose_structure(lines, order, structures=structures)
    # A model whose order is higher by one can compensate for a wrong command hold.
    highest = chosen.fit.model.structure.order + 1
    lines_with_other_hold = replace(lines, hold="linear" if lines.hold == "zoh" else "zoh")
    other_hold = chosen.criterion - compute_criterion(
        choose_structure(lines_with_other_hold, order, highest, structures)[0].fit,
        compute_residual_ratio(candidates),
    )
    model_error, weighted = 0.0, lines
    for _ in range(MODEL_ERROR_ITERATIONS):
        model_error = estimate_model_error(chosen.fit.model, lines)
        if model_error == 0.0:
            break
        expected = np.abs(chosen.fit.model.predict(lines))
        weighted = replace(lines, std=np.hypot(lines.std, model_error * expected))
        chosen = replace(chosen, fit=fit_structure(chosen.fit.model.structure, weighted))
    gain = estimate_static_gain(chosen.fit, weighted)
    return FreeMotion(lines, tuple(spectra), chosen, tuple(candidates), gain, other_hold, model_error)


def estimate_model_error(model: MotionModel, lines: SpectralLines) -> float:
    """Return the relative error of the model at a frequency line (rms), or 0 if noise explains the residual.

    A model error varies slowly with frequency, so all lines of a frequency band are assumed to have the same
    error. The error is therefore estimated from the mean residual of each band and multiplied by the square
    root of the number of lines per band. Without this factor, a band with little noise would determine the
    error of the other bands. The error is relative to the predicted output, because the measured output is
    mainly noise where the response is small.
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
    degrees_of_freedom = 2 * len(power) - model.structure.size
    if (
        degrees_of_freedom < 1
        or stats.chi2.sf(np.sum(2.0 * power / variance), degrees_of_freedom) > MODEL_ERROR_P_VALUE
    ):
        return 0.0

    def excess(logarithm: float) -> float:
        return float(np.sum(2.0 * power / (variance + np.exp(2.0 * logarithm)))) - degrees_of_freedom

    least, most = np.log(1e-9), np.log(MAX_MODEL_ERROR)
    root: Any = optimize.brentq(excess, least, most) if excess(most) < 0.0 else most
    return float(np.exp(root) * np.sqrt(np.mean(counts)))


def compare_free_motion(
    runs: Sequence[LoggedRun], timing: CampaignTiming, model: MotionModel
) -> FreeMotion | None:
    """Compare the free runs with a known model without fitting it; return None if no run is long enough."""
    spectra = compute_spectra(runs, timing)
    if not spectra:
        return None

    def held(lines: SpectralLines) -> SpectrumFit:
        size = len(model.parameters)
        return SpectrumFit(model, np.zeros((size, size)), (model.predict(lines) - lines.output) / lines.std)

    lines = concatenate_lines(spectra, timing)
    lines_with_other_hold = replace(lines, hold="linear" if lines.hold == "zoh" else "zoh")
    fit, inflation = held(lines), max(1.0, held(lines).chi2 / max(held(lines).degrees_of_freedom, 1))
    candidate = StructureCandidate(fit, compute_criterion(fit, inflation), "")
    gain = candidate.criterion - compute_criterion(held(lines_with_other_hold), inflation)
    return FreeMotion(lines, tuple(spectra), candidate, (candidate,), estimate_static_gain(fit, lines), gain)


def compute_spectra(runs: Sequence[LoggedRun], timing: CampaignTiming) -> list[Spectrum]:
    """Return the runs' spectra; omit runs that are too short or have fewer than four frequency lines."""
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
    """Return one record with the spectral lines of several runs."""
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
    """Estimate the static gain of the motion simulator, which the model fixes at 1.

    The estimate is one Newton step that starts at the fit and has the gain as an additional parameter. The
    result is the gain and its standard deviation.
    """
    s, command = lines.images
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
