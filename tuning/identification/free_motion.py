"""The motion simulator from runs without contact: order, numbers, delay, and what they leave unexplained.

The delay found is the sum of the motion's and the position sensor's: no law with fixed gains can tell how the
two share it, nor can a log.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tuning.identification.frf import Spectrum, spectrum
from tuning.identification.order import Candidate, choose, criterion, left
from tuning.identification.rational import Fit, Lines, Model
from tuning.identification.records import Run, Timing

SETTLING = 10.0  # time constants after which a transient is over
SLOWEST = 0.05  # s, time constant assumed before any is known
UNEXPLAINED = 1.3  # chi-squared per degree of freedom above which intervals are widened by it


@dataclass(frozen=True)
class FreeMotion:
    """What runs without contact say."""

    lines: Lines
    spectra: tuple[Spectrum, ...]  # one a run
    chosen: Candidate
    candidates: tuple[Candidate, ...]
    gain: tuple[float, float]  # of the measured position over the desired one, and its standard deviation
    other_hold: float  # by how much the criterion falls with the other hold; negative: it rises

    @property
    def model(self) -> Model:
        return self.chosen.fit.model

    @property
    def fit(self) -> Fit:
        return self.chosen.fit

    @property
    def left(self) -> float:
        """Chi-squared per degree of freedom."""
        return self.fit.chi2 / max(self.fit.freedom, 1)

    @property
    def covariance(self) -> np.ndarray:
        """Of the model's parameters; wider where the model leaves more than noise."""
        return self.fit.covariance * (self.left if self.left > UNEXPLAINED else 1.0)

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
    return FreeMotion(
        lines,
        tuple(spectra),
        chosen,
        tuple(candidates),
        gain_of(chosen.fit, lines),
        chosen.criterion - criterion(choose(other, order, highest)[0].fit, left(candidates)),
    )


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
        timing.row,
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
