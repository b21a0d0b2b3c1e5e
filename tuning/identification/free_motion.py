"""The motion simulator from runs without contact: order, numbers, delay, and what they leave unexplained.

The delay found is the sum of the motion's and the position sensor's: no law with fixed gains can tell how the
two share it, nor can a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize, stats

from tuning.identification.frf import Spectrum, spectrum
from tuning.identification.order import Candidate, choose, criterion, left
from tuning.identification.rational import Fit, Lines, Model, fit
from tuning.identification.records import Run, Timing

SETTLING = 10.0  # time constants after which a transient is over
SLOWEST = 0.05  # s, time constant assumed before any is known
UNEXPLAINED = 1.3  # chi-squared per degree of freedom above which intervals are widened by it
RARE = 1e-6  # probability under which the model itself is taken to err: it costs most of what is known
BANDS = 10  # of frequency, in each of which it errs by as much everywhere
LARGEST = 10.0  # relative error that is looked for
ROUNDS = 3  # of fitting and of looking how much it errs


@dataclass(frozen=True)
class FreeMotion:
    """What runs without contact say."""

    lines: Lines  # with the noise that the runs show
    spectra: tuple[Spectrum, ...]  # one a run
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    gain: tuple[float, float]  # of the measured position over the desired one, and its standard deviation
    other_hold: float  # by how much the criterion falls with the other hold; negative: it rises
    beyond: float = 0.0  # relative error of the model that counts at each line beside the noise

    @property
    def model(self) -> Model:
        return self.chosen.fit.model

    @property
    def fit(self) -> Fit:
        return self.chosen.fit

    @property
    def left(self) -> float:
        """Power of what the model leaves over that of the noise."""
        error, noise = self.misfit()
        return float(2.0 * np.sum(np.abs(error / noise) ** 2)) / max(self.fit.freedom, 1)

    @property
    def covariance(self) -> np.ndarray:
        """Of the model's parameters; wider where the model leaves more than noise."""
        unexplained = self.fit.chi2 / max(self.fit.freedom, 1)
        return self.fit.covariance * (unexplained if unexplained > UNEXPLAINED else 1.0)

    @property
    def noise_std(self) -> float:
        """Of the position readings [m]."""
        return float(np.sqrt(np.mean([one.noise_std**2 for one in self.spectra])))

    def lag(self, frequency: float) -> tuple[float, float]:
        """Delay of the phase [s] at a frequency [Hz], all of it, and its standard deviation."""
        s = np.array([2j * np.pi * frequency])
        slopes = np.imag(self.model.slopes(s)[:, 0]) / (2.0 * np.pi * frequency)
        phase = np.angle(self.model.response(s)[0])
        return float(-phase / (2.0 * np.pi * frequency)), float(np.sqrt(slopes @ self.covariance @ slopes))

    def misfit(self) -> tuple[np.ndarray, np.ndarray]:
        """Relative error of the model at each line, complex, and the noise's standard deviation in it."""
        predicted = self.model.predict(self.lines)
        return (self.lines.output - predicted) / predicted, self.lines.std / np.abs(predicted)


def estimate(runs: Sequence[Run], timing: Timing, order: int | None = None) -> FreeMotion | None:
    """From all free runs together; None where none is long enough to say anything."""
    spectra = spectra_of(runs, timing)
    if not spectra:
        return None
    lines = join(spectra, timing)
    chosen, candidates = choose(lines, order)
    # What a wrong hold leaves, one order more takes up.
    highest = chosen.fit.model.structure.order + 1
    other = replace(lines, hold="linear" if lines.hold == "zoh" else "zoh")
    other_hold = chosen.criterion - criterion(choose(other, order, highest)[0].fit, left(candidates))
    beyond, weighed = 0.0, lines
    for _ in range(ROUNDS):
        beyond = erring(chosen.fit.model, lines)
        if beyond == 0.0:
            break
        expected = np.abs(chosen.fit.model.predict(lines))
        weighed = replace(lines, std=np.hypot(lines.std, beyond * expected))
        chosen = replace(chosen, fit=fit(chosen.fit.model.structure, weighed))
    gain = gain_of(chosen.fit, weighed)
    return FreeMotion(lines, tuple(spectra), chosen, tuple(candidates), gain, other_hold, beyond)


def erring(model: Model, lines: Lines) -> float:
    """Standard deviation of the model's relative error that counts at each line, 0 where noise explains all.

    A model errs smoothly: all lines of a band share one error. So it is found from the means over bands, and
    counts as often as a band has lines; else lines of little noise would decide what it is elsewhere. The
    error is relative to the model's output: where nothing comes out, what was measured is noise alone."""
    expected = model.predict(lines)
    size = np.abs(expected)
    errors, variances, counts = [], [], []
    for band in np.array_split(np.argsort(lines.frequency), min(BANDS, len(lines))):
        weight = size[band] ** 2 / lines.std[band] ** 2
        relative = (lines.output[band] - expected[band]) / expected[band]
        errors.append(np.abs(np.sum(weight * relative) / weight.sum()))
        variances.append(1.0 / weight.sum())
        counts.append(len(band))
    power, variance = np.square(errors), np.array(variances)
    freedom = 2 * len(power) - model.structure.size
    if freedom < 1 or stats.chi2.sf(np.sum(2.0 * power / variance), freedom) > RARE:
        return 0.0

    def excess(logarithm: float) -> float:
        return float(np.sum(2.0 * power / (variance + np.exp(2.0 * logarithm)))) - freedom

    least, most = np.log(1e-9), np.log(LARGEST)
    root: Any = optimize.brentq(excess, least, most) if excess(most) < 0.0 else most
    return float(np.exp(root) * np.sqrt(np.mean(counts)))


def of_known(runs: Sequence[Run], timing: Timing, model: Model) -> FreeMotion | None:
    """The same with a model that is known: what it leaves of the lines, nothing fitted."""
    spectra = spectra_of(runs, timing)
    if not spectra:
        return None

    def held(lines: Lines) -> Fit:
        size = len(model.parameters)
        return Fit(model, np.zeros((size, size)), (model.predict(lines) - lines.output) / lines.std)

    lines = join(spectra, timing)
    other = replace(lines, hold="linear" if lines.hold == "zoh" else "zoh")
    fit, inflation = held(lines), max(1.0, held(lines).chi2 / max(held(lines).freedom, 1))
    candidate = Candidate(fit, criterion(fit, inflation), "")
    gain = candidate.criterion - criterion(held(other), inflation)
    return FreeMotion(lines, tuple(spectra), candidate, (candidate,), gain_of(fit, lines), gain)


def spectra_of(runs: Sequence[Run], timing: Timing) -> list[Spectrum]:
    """Of the runs that are long enough."""
    rest = round(SETTLING * SLOWEST / timing.control_period)
    spectra = []
    for run in runs:
        found = spectrum(
            run.position_desired, run.position_measured, run.valid & np.isfinite(run.position_measured),
            timing.control_period, rest,
        )  # fmt: skip
        if found is not None and len(found.frequency) >= 4:
            spectra.append(found)
    return spectra


def join(spectra: Sequence[Spectrum], timing: Timing) -> Lines:
    """The lines of several runs, one after the other."""
    return Lines(
        np.concatenate([one.frequency for one in spectra]),
        np.concatenate([one.command for one in spectra]),
        np.concatenate([one.output for one in spectra]),
        np.concatenate([one.std for one in spectra]),
        timing.control_period,
        timing.command_hold,
        timing.command_latency,
        timing.shift,
    )


def gain_of(fit: Fit, lines: Lines) -> tuple[float, float]:
    """The static gain, were it free, and its standard deviation: one Newton step from 1."""
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
