"""Models of the motion simulator: first- and second-order sections with a delay, fitted to spectra.

    H(s) = N(s) e^{-s tau} / (prod (1 + T s) prod (1 + 2 zeta s/w + s^2/w^2)),  N = 1 + c1 s + c2 s^2

The logarithms of time constants, natural frequencies and damping ratios are fitted, so that the model remains
stable. The maximum likelihood fit weights every spectral line with its noise (Pintelon and Schoukens, System
Identification: A Frequency Domain Approach, 2012). The model includes the command hold, so that the fitted
parameters are those of the rig itself. The starting values come from linear fits at several delays
(Sanathanan and Koerner 1963).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.polynomial import polynomial
from scipy import optimize

from jaxhil.simulation.cells import MAX_POLE
from tuning.identification import hold as holds

MEMORY_TIME_CONSTANTS = 10.0  # time constants after which a command has no effect
MIN_TIME_CONSTANT = 1e-6  # minimum time constant [s]; logs cannot resolve faster poles
POLE_SHARE = 0.9  # largest pole, divided by the largest one that simulations accept


@dataclass(frozen=True)
class SimulatorStructure:
    """Structure of a motion model: numbers of first-order sections, second-order sections and zeros."""

    name: str
    first: int  # number of denominator sections 1 + T s
    second: int  # number of denominator sections 1 + 2 zeta s/w + s^2/w^2
    zeros: int  # number of zeros: degree of the numerator N(s)

    @property
    def order(self) -> int:
        return self.first + 2 * self.second

    @property
    def size(self) -> int:
        """Return the number of parameters, including the delay."""
        return self.order + self.zeros + 1

    def make_model(self, parameters: np.ndarray) -> MotionModel:
        """Return the model with these parameters."""
        return MotionModel(self, parameters)

    def make_starts(self, lines: SpectralLines) -> list[tuple[float, np.ndarray]]:
        """Return starting points of a fit: chi-squared and parameters of linear fits at several delays."""
        return [_fit_linear_start(self, lines, delay) for delay in _make_delay_grid(lines)]


STRUCTURES = (
    SimulatorStructure("ideal", 0, 0, 0),
    SimulatorStructure("first_order", 1, 0, 0),
    SimulatorStructure("second_order", 0, 1, 0),
    SimulatorStructure("second_order_zero", 0, 1, 1),
    SimulatorStructure("third_order", 1, 1, 0),
    SimulatorStructure("fourth_order", 0, 2, 0),
    SimulatorStructure("resonance", 0, 2, 2),
)


@dataclass(frozen=True)
class SpectralLines:
    """Measured spectra of command and position at the excited frequencies, with the command timing."""

    frequency: np.ndarray  # Hz
    command: np.ndarray  # complex amplitude of the commanded position
    output: np.ndarray  # complex amplitude of the measured position, in the command's unit
    std: np.ndarray  # standard deviation of the output's complex noise n: E|n|^2 = std^2
    period: float  # control period [s]
    hold: str  # "zoh" or "linear"
    latency: int  # latency of the command [periods]
    shift: int = 0  # periods by which the readings of a row are older than its command

    @cached_property
    def images(self) -> tuple[np.ndarray, np.ndarray]:
        """Return s = 2 pi j f and the drives' input at all lines and their aliases, both (images, lines)."""
        frequencies = holds.compute_image_frequencies(self.frequency, self.period)
        return 2j * np.pi * frequencies, self.command * holds.compute_hold_response(
            frequencies, self.period, self.hold, self.latency, self.shift
        )

    def __len__(self) -> int:
        return len(self.frequency)


@dataclass(frozen=True)
class MotionModel:
    """Model of the motion simulator: a structure with values of its parameters.

    The parameters are, in this order: the logarithm of the time constant [s] of each first-order section;
    the logarithms of natural frequency [rad/s] and damping ratio of each second-order section; the
    coefficients of s and s^2 in the numerator, as far as the structure has them; and the delay [s].
    """

    structure: SimulatorStructure
    parameters: np.ndarray

    @property
    def delay(self) -> float:
        """Return the transport delay [s]."""
        return float(self.parameters[-1])

    @property
    def memory(self) -> float:
        """Return the time [s] for which a command affects the motion, not counting the transport delay."""
        slowest = max((-1.0 / pole.real for pole in np.roots(self.fraction[1])), default=0.0)
        return MEMORY_TIME_CONSTANTS * slowest

    @property
    def names(self) -> list[str]:
        many = self.structure
        sections = [f"time_constant{i or ''}" for i in range(many.first)]
        for i in range(many.second):
            sections += [f"natural_frequency{i or ''}", f"damping_ratio{i or ''}"]
        return [*sections, *(f"zero{i + 1}" for i in range(many.zeros)), "delay"]

    @cached_property
    def sections(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Return the coefficients of the numerator and each denominator section, in ascending powers of s."""
        many, values = self.structure, np.asarray(self.parameters, float)
        parts = [np.array([1.0, time]) for time in np.exp(values[: many.first])]
        for w, zeta in np.exp(values[many.first : many.order]).reshape(-1, 2):
            parts.append(np.array([1.0, 2.0 * zeta / w, 1.0 / w**2]))
        return np.array([1.0, *values[many.order : -1]]), parts

    @cached_property
    def fraction(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the coefficients of numerator and denominator (without delay), in descending powers of s."""
        numerator, parts = self.sections
        denominator = np.array([1.0])
        for part in parts:
            denominator = polynomial.polymul(denominator, part)
        return numerator[::-1], denominator[::-1]

    def response(self, s: np.ndarray) -> np.ndarray:
        """Return the transfer function, including the delay, at each complex frequency in `s` [1/s]."""
        numerator, denominator = self.fraction
        return np.polyval(numerator, s) / np.polyval(denominator, s) * np.exp(-s * self.delay)

    def slopes(self, s: np.ndarray) -> np.ndarray:
        """Return the log transfer function's derivatives by each parameter, shape (parameters, *s.shape)."""
        numerator, parts = self.sections
        many, rows = self.structure, []
        for part in parts[: many.first]:
            rows.append(-part[1] * s / (1.0 + part[1] * s))
        for part in parts[many.first :]:
            below = 1.0 + part[1] * s + part[2] * s**2
            rows += [(part[1] * s + 2.0 * part[2] * s**2) / below, -part[1] * s / below]
        above = polynomial.polyval(s, numerator)
        rows += [s**power / above for power in range(1, many.zeros + 1)]
        return np.array([*rows, -s])

    def predict(self, lines: SpectralLines) -> np.ndarray:
        """Return the predicted complex amplitude of the measured position at each frequency line."""
        s, command = lines.images
        return np.sum(self.response(s) * command, axis=0)

    def bandwidth(self) -> float:
        """Return the -3 dB bandwidth [Hz]; infinite for an ideal motion simulator."""
        if self.structure.order == 0:
            return np.inf
        poles = np.abs(np.roots(self.fraction[1]))
        grid = np.geomspace(poles.min() / 30.0, poles.max() * 30.0, 4000)
        level = np.abs(self.response(1j * grid)) - np.sqrt(0.5)
        below = np.flatnonzero(level < 0.0)
        if not len(below) or below[0] == 0:
            return np.inf
        low, high = grid[below[0] - 1], grid[below[0]]
        root: Any = optimize.brentq(
            lambda w: abs(self.response(1j * np.asarray(w))) - np.sqrt(0.5), low, high
        )
        return float(root) / (2.0 * np.pi)


@dataclass(frozen=True)
class SpectrumFit:
    """Model fitted to measured spectra, with the covariance of its parameters and with the residuals."""

    model: MotionModel
    covariance: np.ndarray  # covariance of the parameters, from the curvature of the likelihood
    residual: np.ndarray  # complex residual r at each line, divided by its noise: E|r|^2 = 1

    @property
    def chi2(self) -> float:
        """Return chi-squared: the sum of squares of real and imaginary residuals, scaled to unit variance."""
        return float(2.0 * np.sum(np.abs(self.residual) ** 2))

    @property
    def degrees_of_freedom(self) -> int:
        return 2 * len(self.residual) - self.model.structure.size

    @property
    def std(self) -> np.ndarray:
        return np.sqrt(np.diag(self.covariance))


def fit_structure(structure: SimulatorStructure, lines: SpectralLines) -> SpectrumFit:
    """Fit a structure to spectra by maximum likelihood (Levenberg-Marquardt method)."""
    candidates = sorted(structure.make_starts(lines), key=lambda c: c[0])
    # Fits from similar delays converge to the same minimum, so the second fit starts from a distant delay.
    fits = [_refine_fit(structure, candidates[0][1], lines)]
    for _, start in candidates[1:]:
        if structure.order > 1 and abs(start[-1] - candidates[0][1][-1]) > 2.0 * lines.period:
            fits.append(_refine_fit(structure, start, lines))
            break
    return min(fits, key=lambda candidate: candidate.chi2)


def _refine_fit(structure: SimulatorStructure, start: np.ndarray, lines: SpectralLines) -> SpectrumFit:
    """Fit a model structure by the Levenberg-Marquardt method from the starting parameters `start`."""
    s, command = lines.images
    scale = np.sqrt(2.0) / lines.std

    def split(values):
        return np.concatenate([values.real, values.imag], axis=-1)

    def residual(parameters):
        return split((structure.make_model(parameters).predict(lines) - lines.output) * scale)

    def jacobian(parameters):
        model = structure.make_model(parameters)
        slopes = np.sum(model.slopes(s) * model.response(s) * command, axis=1) * scale
        return split(slopes).T

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        solve: Any = optimize.least_squares
        result = solve(residual, start, jacobian, method="lm", x_scale="jac", max_nfev=80)
    curvature = result.jac.T @ result.jac
    scales = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
    covariance = np.linalg.pinv(curvature / np.outer(scales, scales), hermitian=True) / np.outer(
        scales, scales
    )
    least = max(MIN_TIME_CONSTANT, lines.period / (POLE_SHARE * MAX_POLE))
    half, parameters = len(lines), _limit_fast_poles(structure, result.x, least)
    left = residual(parameters)
    return SpectrumFit(
        structure.make_model(parameters), covariance, (left[:half] + 1j * left[half:]) / np.sqrt(2.0)
    )


def _limit_fast_poles(structure: SimulatorStructure, parameters: np.ndarray, least: float) -> np.ndarray:
    """Limit the magnitude of all poles to 1 / `least`; return the changed parameters.

    The delay changes so that the sum of the delay and all lags at low frequencies stays the same.
    """
    first, order = structure.first, structure.order
    times = np.maximum(parameters[:first], np.log(least))
    sections = []
    fastest = -np.log(least)
    for frequency, ratio in parameters[first:order].reshape(-1, 2):
        if ratio > 0.0:  # damping ratio above 1: the section has two real poles; return their logarithms
            slower = frequency - ratio - np.log1p(np.sqrt(1.0 - np.exp(-2.0 * ratio)))
            faster, slower = min(2.0 * frequency - slower, fastest), min(slower, fastest)
            frequency = 0.5 * (slower + faster)
            ratio = np.logaddexp(slower, faster) - np.log(2.0) - frequency
        frequency = min(frequency, fastest)
        sections += [frequency, ratio]
    limited = np.array([*times, *sections, *parameters[order:]])
    limited[-1] += _compute_low_frequency_lag(structure, parameters)
    limited[-1] -= _compute_low_frequency_lag(structure, limited)
    return limited


def _compute_low_frequency_lag(structure: SimulatorStructure, parameters: np.ndarray) -> float:
    """Return the delay [s] that the poles of a model cause at low frequencies."""
    frequencies, ratios = parameters[structure.first : structure.order].reshape(-1, 2).T
    return float(np.sum(np.exp(parameters[: structure.first])) + np.sum(2.0 * np.exp(ratios - frequencies)))


def estimate_low_frequency_delay(lines: SpectralLines) -> float:
    """Return the delay [s] from the drives' input to the position reading at low frequencies."""
    s, command = lines.images
    middle = len(s) // 2
    phase = np.unwrap(np.angle(lines.output / command[middle]))
    lowest = slice(0, max(3, len(lines) // 8))
    weight = np.abs(command[middle][lowest]) / lines.std[lowest]
    f = lines.frequency[lowest]
    return float(-np.sum(weight**2 * f * phase[lowest]) / np.sum(weight**2 * f**2) / (2.0 * np.pi))


def _make_delay_grid(lines: SpectralLines) -> np.ndarray:
    """Return a grid of delays [s] from 0 to the response's low-frequency delay, at least to one period."""
    longest = max(estimate_low_frequency_delay(lines), lines.period)
    return np.linspace(0.0, longest, int(np.clip(4.0 * longest / lines.period, 8, 40)))


def _fit_linear_start(
    structure: SimulatorStructure, lines: SpectralLines, delay: float
) -> tuple[float, np.ndarray]:
    """Fit a structure with a fixed delay by linear least squares; return chi-squared and the parameters.

    The fit neglects the aliases of the sampled command; chi-squared includes them.
    """
    s, command = lines.images
    s, command = s[len(s) // 2], command[len(s) // 2]
    unit = 1.0 / np.abs(s).mean()
    p = s * unit
    target = lines.output / command * np.exp(s * delay)
    weight = np.abs(command) / lines.std
    order, zeros = structure.order, structure.zeros
    if order == 0:
        parameters = np.array([delay])
    else:
        columns = [*(-(p**i) for i in range(1, zeros + 1)), *(target * p**i for i in range(1, order + 1))]
        basis, below = np.array(columns).T, np.ones_like(p)
        for _ in range(4):
            scaled = (weight / np.abs(below))[:, None]
            left, right = basis * scaled, (1.0 - target)[:, None] * scaled
            table = np.concatenate([left.real, left.imag])
            right_side = np.concatenate([right.real, right.imag])[:, 0]
            size = np.linalg.norm(table, axis=0)
            normal = table.T @ table / np.outer(size, size) + 1e-12 * np.eye(len(size))
            solved = np.linalg.solve(normal, table.T @ right_side / size) / size
            below = 1.0 + sum(solved[zeros + i - 1] * p**i for i in range(1, order + 1))
        above = solved[:zeros] * unit ** np.arange(1, zeros + 1)
        polynomial_below = np.array([1.0, *solved[zeros:]])
        parameters = np.array([*_convert_sections(structure, polynomial_below, unit), *above, delay])
    misfit = np.abs(MotionModel(structure, parameters).predict(lines) - lines.output) / lines.std
    return float(np.sum(misfit**2)), parameters


def _convert_sections(structure: SimulatorStructure, denominator: np.ndarray, unit: float) -> list[float]:
    """Split a denominator into first- and second-order sections; return the logarithms of their parameters.

    Args:
        structure: Structure of the model.
        denominator: Coefficients of the denominator, in ascending powers of (`unit` times s).
        unit: Unit of time of the coefficients [s].
    """
    roots = polynomial.polyroots(denominator)
    poles = np.where(roots.real > 0.0, -roots.conj(), roots) / unit
    poles = np.where(
        np.abs(poles) > 1.0 / MIN_TIME_CONSTANT, poles / np.abs(poles) / MIN_TIME_CONSTANT, poles
    )
    real = sorted((-pole.real for pole in poles if abs(pole.imag) <= 1e-9 * abs(pole)), reverse=True)
    complex_ones = sorted((pole for pole in poles if pole.imag > 1e-9 * abs(pole)), key=abs)
    values = []
    for _ in range(structure.first):
        values.append(-np.log(max(real.pop(), 1e-6) if real else abs(complex_ones[0])))
    pairs = [(abs(pole), max(-pole.real / abs(pole), 1e-3)) for pole in complex_ones]
    while len(real) > 1:
        first, second = max(real.pop(), 1e-6), max(real.pop(), 1e-6)
        pairs.append((np.sqrt(first * second), (first + second) / (2.0 * np.sqrt(first * second))))
    while len(pairs) < structure.second:
        pairs.append((1.0 / unit, 1.0))
    for w, zeta in sorted(pairs)[: structure.second]:
        values += [np.log(w), np.log(zeta)]
    return values
