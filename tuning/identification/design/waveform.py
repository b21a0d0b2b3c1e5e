"""Multisines of low crest factor: phases for given amplitudes, and commands that begin and end at rest.

The phases start from Schroeder's (1970) and from random ones. Then means of increasing even powers of the
wave are minimized, which converge to its peak (Guillaume, Schoukens, Pintelon and Kollar 1991).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import optimize

LimitedSignal = tuple[
    np.ndarray | complex, float
]  # response of a signal to the wave, at its lines, and its limit
UNLIMITED_SIGNAL: LimitedSignal = (1.0 + 0.0j, 1.0)

RANDOM_STARTS = 1  # number of random starts
NORM_POWER_LOG2 = 3, 5  # base-2 logarithms of the powers: the 8th, then the 32nd
MAX_SOLVER_ITERATIONS = 40  # solver iterations for each power


def optimise_phases(
    amplitude: np.ndarray,
    lines: np.ndarray,
    rows: int,
    limited: Sequence[LimitedSignal] = (UNLIMITED_SIGNAL,),
    seed: int = 0,
) -> np.ndarray:
    """Return phases [rad] of the lines that keep peaks low.

    The largest ratio of a peak to its limit is minimized.

    Args:
        amplitude: Amplitude at each line.
        lines: Number of periods in `rows` for each line.
        rows: Rows of one period.
        limited: Limited signals: the response from the wave at the lines, and the limit.
        seed: Seed of the random starts.
    """
    power = amplitude**2 / np.sum(amplitude**2)
    # Schroeder: the group delay at a line is proportional to the power below it.
    schroeder = -2.0 * np.pi * np.cumsum(np.cumsum(power) - power) * np.gradient(lines.astype(float))
    rng = np.random.default_rng(seed)
    starts = [schroeder, *rng.uniform(0.0, 2.0 * np.pi, (RANDOM_STARTS, len(lines)))]
    tried = [_reduce_peak(amplitude, lines, rows, limited, angles) for angles in starts]
    return min(
        tried,
        key=lambda candidate: max(
            np.abs(s).max() for s in make_limited_signals(amplitude, lines, rows, candidate, limited)
        ),
    )


def _reduce_peak(amplitude, lines, rows, limited, angle) -> np.ndarray:
    size = max(
        np.abs(signal).max() for signal in make_limited_signals(amplitude, lines, rows, angle, limited)
    )

    def mean(angle, doublings):
        """Return the logarithm of the mean of a power of all signals, and its derivative by the phases."""
        power, total, slope = 2**doublings, 0.0, np.zeros(len(lines))
        for (response, limit), signal in zip(
            limited, make_limited_signals(amplitude, lines, rows, angle, limited), strict=True
        ):
            raised, one_less = signal / size, np.ones_like(signal)
            for _ in range(doublings):
                one_less = one_less * raised
                raised = raised * raised
            total += np.sum(raised)
            pull = np.conj(np.fft.rfft(one_less)[lines])
            slope += np.real(1j * amplitude * response / (limit * size) * np.exp(1j * angle) * pull)
        return np.log(total) / power, slope / total

    for doublings in NORM_POWER_LOG2:
        result: Any = optimize.minimize(
            mean, angle, (doublings,), method="L-BFGS-B", jac=True, options={"maxiter": MAX_SOLVER_ITERATIONS}
        )
        angle = result.x
    return angle


def make_limited_signals(amplitude, lines, rows, angle, limited: Sequence[LimitedSignal]) -> list[np.ndarray]:
    """Return one period of each limited signal over its limit."""
    return [
        synthesise_multisine(amplitude * np.abs(r) / limit, lines, rows, angle + np.angle(r))
        for r, limit in limited
    ]


def synthesise_multisine(
    amplitude: np.ndarray, lines: np.ndarray, rows: int, angle: np.ndarray
) -> np.ndarray:
    """Return one period, the sum of amplitude_l cos(2 pi l n / rows + angle_l)."""
    spectrum = np.zeros(rows // 2 + 1, complex)
    spectrum[lines] = 0.5 * rows * amplitude * np.exp(1j * angle)
    return np.fft.irfft(spectrum, rows)


def crest_factor(values: np.ndarray) -> float:
    """Return the peak over the rms."""
    return float(np.abs(values).max() / np.sqrt(np.mean(values**2)))


def repeat_with_fades(period: np.ndarray, times: int, fade: int) -> np.ndarray:
    """Return the period repeated `times`, with `fade` further rows at each end for a smooth start and end."""
    whole = np.concatenate([period[-fade:], np.tile(period, times), period[:fade]])
    rise = np.sin(0.5 * np.pi * np.arange(fade) / fade) ** 2
    whole[:fade] *= rise
    whole[-fade:] *= rise[::-1]
    return whole


def ramp(begin: float, end: float, rows: int) -> np.ndarray:
    """Return a motion from one position to another, at rest at both ends."""
    return begin + (end - begin) * np.sin(0.5 * np.pi * np.arange(rows + 1) / rows) ** 2
