"""Multisines with a low crest factor, and commands that begin and end at rest.

The optimisation of the phases starts from the phases of Schroeder (1970) and from random phases. It minimises
the L8 norm and then the L32 norm of the signal, which approximate the signal's peak (Guillaume, Schoukens,
Pintelon and Kollar 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import optimize

# Frequency response from the multisine to a limited signal, at each line, and the limit of the signal.
LimitedSignal = tuple[np.ndarray | complex, float]
UNLIMITED_SIGNAL: LimitedSignal = (1.0 + 0.0j, 1.0)

RANDOM_STARTS = 1  # number of optimisations that start from random phases
NORM_POWER_LOG2 = 3, 5  # base-2 logarithms of the orders of both norms, 8 and 32
MAX_SOLVER_ITERATIONS = 40  # maximum number of iterations of the solver for each norm


def optimise_phases(
    amplitude: np.ndarray,
    lines: np.ndarray,
    rows: int,
    limited: Sequence[LimitedSignal] = (UNLIMITED_SIGNAL,),
    seed: int = 0,
) -> np.ndarray:
    """Return the phases [rad] of a multisine that minimise the largest ratio of a signal's peak to its limit.

    Args:
        amplitude: Amplitude at each frequency line.
        lines: Harmonic number of each line: its number of cycles per period of the multisine.
        rows: Number of samples in one period of the multisine.
        limited: Frequency response and limit of each limited signal.
        seed: Seed of the random phases.
    """
    power = amplitude**2 / np.sum(amplitude**2)
    # Schroeder: the group delay at a line is proportional to the power at lower frequencies.
    schroeder = -2.0 * np.pi * np.cumsum(np.cumsum(power) - power) * np.gradient(lines.astype(float))
    rng = np.random.default_rng(seed)
    starts = [schroeder, *rng.uniform(0.0, 2.0 * np.pi, (RANDOM_STARTS, len(lines)))]
    candidates = [_reduce_peak(amplitude, lines, rows, limited, angles) for angles in starts]
    return min(
        candidates,
        key=lambda candidate: max(
            np.abs(s).max() for s in make_limited_signals(amplitude, lines, rows, candidate, limited)
        ),
    )


def _reduce_peak(amplitude, lines, rows, limited, angle) -> np.ndarray:
    size = max(
        np.abs(signal).max() for signal in make_limited_signals(amplitude, lines, rows, angle, limited)
    )

    def compute_log_norm(angle, doublings):
        """Return the logarithm of the signals' norm of order 2**`doublings`, and its gradient by `angle`."""
        power, total, slope = 2**doublings, 0.0, np.zeros(len(lines))
        for (response, limit), signal in zip(
            limited, make_limited_signals(amplitude, lines, rows, angle, limited), strict=True
        ):
            raised, derivative = signal / size, np.ones_like(signal)
            for _ in range(doublings):
                derivative = derivative * raised
                raised = raised * raised
            total += np.sum(raised)
            gradient_spectrum = np.conj(np.fft.rfft(derivative)[lines])
            slope += np.real(
                1j * amplitude * response / (limit * size) * np.exp(1j * angle) * gradient_spectrum
            )
        return np.log(total) / power, slope / total

    for doublings in NORM_POWER_LOG2:
        options = {"maxiter": MAX_SOLVER_ITERATIONS}
        result: Any = optimize.minimize(
            compute_log_norm, angle, (doublings,), method="L-BFGS-B", jac=True, options=options
        )
        angle = result.x
    return angle


def make_limited_signals(amplitude, lines, rows, angle, limited: Sequence[LimitedSignal]) -> list[np.ndarray]:
    """Return one period of each limited signal, divided by the signal's limit."""
    return [
        synthesise_multisine(amplitude * np.abs(r) / limit, lines, rows, angle + np.angle(r))
        for r, limit in limited
    ]


def synthesise_multisine(
    amplitude: np.ndarray, lines: np.ndarray, rows: int, angle: np.ndarray
) -> np.ndarray:
    """Return one period of a multisine: sum over l of amplitude_l cos(2 pi l n / rows + angle_l)."""
    spectrum = np.zeros(rows // 2 + 1, complex)
    spectrum[lines] = 0.5 * rows * amplitude * np.exp(1j * angle)
    return np.fft.irfft(spectrum, rows)


def crest_factor(values: np.ndarray) -> float:
    """Return the crest factor: the largest magnitude divided by the rms."""
    return float(np.abs(values).max() / np.sqrt(np.mean(values**2)))


def repeat_with_fades(period: np.ndarray, times: int, fade: int) -> np.ndarray:
    """Return `times` periods of a signal, plus a fade-in and a fade-out of `fade` samples each."""
    signal = np.concatenate([period[-fade:], np.tile(period, times), period[:fade]])
    rise = np.sin(0.5 * np.pi * np.arange(fade) / fade) ** 2
    signal[:fade] *= rise
    signal[-fade:] *= rise[::-1]
    return signal


def ramp(begin: float, end: float, rows: int) -> np.ndarray:
    """Return a smooth motion of `rows` periods from one position to another, with speed 0 at both ends."""
    return begin + (end - begin) * np.sin(0.5 * np.pi * np.arange(rows + 1) / rows) ** 2
