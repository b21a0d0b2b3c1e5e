"""Multisines of low crest factor: phases for given amplitudes, and commands that begin and end at rest.

Phases start from Schroeder's (1970) and from random ones; then the wave is clipped and its amplitudes are put
back, again and again, which lowers its peaks (Van der Ouderaa, Schoukens and Renneboog 1988).
"""

from __future__ import annotations

import numpy as np

STARTS = 8  # of random phases
ROUNDS = 200  # of clipping
CLIP = 0.7, 0.99  # of the peak, in the first round and in the last


def phases(amplitude: np.ndarray, lines: np.ndarray, rows: int, seed: int = 0) -> np.ndarray:
    """Phases [rad] of the lines (numbers of periods in `rows`) that make the wave's peak low."""
    power = amplitude**2 / np.sum(amplitude**2)
    # Schroeder: the phase's slope by frequency goes with the power below it.
    schroeder = -2.0 * np.pi * np.cumsum(np.cumsum(power) - power) * np.gradient(lines.astype(float))
    rng = np.random.default_rng(seed)
    starts = [schroeder, *rng.uniform(0.0, 2.0 * np.pi, (STARTS, len(lines)))]
    tried = [_clipped(amplitude, lines, rows, one) for one in starts]
    return min(tried, key=lambda one: crest_factor(wave(amplitude, lines, rows, one)))


def _clipped(amplitude: np.ndarray, lines: np.ndarray, rows: int, angle: np.ndarray) -> np.ndarray:
    best, least = angle, np.inf
    for level in np.linspace(*CLIP, ROUNDS):
        made = wave(amplitude, lines, rows, angle)
        if (found := crest_factor(made)) < least:
            best, least = angle, found
        peak = level * np.abs(made).max()
        angle = np.angle(np.fft.rfft(np.clip(made, -peak, peak))[lines])
    return best


def wave(amplitude: np.ndarray, lines: np.ndarray, rows: int, angle: np.ndarray) -> np.ndarray:
    """One period: sum of amplitude_l cos(2 pi l n / rows + angle_l)."""
    spectrum = np.zeros(rows // 2 + 1, complex)
    spectrum[lines] = 0.5 * rows * amplitude * np.exp(1j * angle)
    return np.fft.irfft(spectrum, rows)


def crest_factor(values: np.ndarray) -> float:
    """Peak over rms."""
    return float(np.abs(values).max() / np.sqrt(np.mean(values**2)))


def repeated(period: np.ndarray, times: int, fade: int) -> np.ndarray:
    """The period `times` over, with `fade` rows in front and behind through which it comes and goes."""
    whole = np.concatenate([period[-fade:], np.tile(period, times), period[:fade]])
    rise = np.sin(0.5 * np.pi * np.arange(fade) / fade) ** 2
    whole[:fade] *= rise
    whole[-fade:] *= rise[::-1]
    return whole


def ramp(begin: float, end: float, rows: int) -> np.ndarray:
    """From one position to another, at rest at both ends."""
    return begin + (end - begin) * np.sin(0.5 * np.pi * np.arange(rows + 1) / rows) ** 2
