"""Spectra of free motion: command and measured position at the excited lines, with the noise from the data.

A periodic command (a multisine) is averaged over its periods. Differences between periods are noise. Power at
lines without excitation is nonlinear distortion: odd lines show friction and dead bands, even lines show
asymmetry (Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2012). For any other
command the local polynomial method separates transient and noise: around each line, response and transient
are polynomials of degree 2 over 13 lines (Schoukens and others 2009). Lost rows are not used; a period is
averaged over its available rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

VARIANCE_SMOOTHING_LINES = 15  # lines over which the variance of the noise is averaged
SIDE_LINES, POLYNOMIAL_DEGREE = (
    6,
    2,
)  # local polynomial method: lines on either side, degree of the polynomials
MAX_TRANSIENT_VARIANCE_RATIO = (
    20.0  # ratio of the transient's variance to the noise's variance, above which a line is dropped
)
MIN_POWER_SHARE = 3e-3  # share of the largest power, above which a non-periodic command excites a line
MIN_AMPLITUDE_SHARE = 1e-3  # share of the largest amplitude, above which a periodic command excites a line


@dataclass(frozen=True)
class Spectrum:
    """Spectra of one run at its lines."""

    frequency: np.ndarray  # Hz
    command: np.ndarray  # complex amplitude [m]
    output: np.ndarray  # complex amplitude [m], without the transient
    std: np.ndarray  # m, of the output's complex noise
    response: np.ndarray  # complex, output over command; smoothed over neighbours without periods
    coherence: np.ndarray  # 0..1, share of the output's power that the command causes
    noise_std: float  # m, noise of a single position reading
    odd: float | None  # rms of the output at odd lines without excitation over that at excited lines
    even: float | None  # the same for even lines
    excess: tuple[float, float]  # power over noise power at odd and even lines without excitation
    periods: int  # number of averaged periods; 0 for a non-periodic command


def find_repetition(command: np.ndarray, valid: np.ndarray, shortest: int = 100) -> tuple[int, slice] | None:
    """Return the rows of one period, and the rows at which the command repeats the period before, or None.

    A command that differs during its fade-in repeats itself after it.
    """
    rows = len(command)
    centred = np.where(valid, command - command[valid].mean(), 0.0)
    size = 1 << int(np.ceil(np.log2(2 * rows)))
    spectrum = np.fft.rfft(centred, size)
    likeness = np.fft.irfft(np.abs(spectrum) ** 2, size)[: rows // 2 + 1]
    # Divide by the number of products, so that later repetitions are not smaller than the first one.
    likeness = likeness / (rows - np.arange(len(likeness)))
    peaks = 1 + np.flatnonzero((likeness[1:-1] >= likeness[:-2]) & (likeness[1:-1] > likeness[2:]))
    scale = np.std(command[valid])
    for lag in peaks[(peaks >= shortest) & (likeness[peaks] > 0.5 * likeness[0])]:
        both_valid = valid[lag:] & valid[:-lag]
        same = (np.abs(command[lag:] - command[:-lag]) <= 1e-4 * scale) | ~both_valid
        first, length = _find_longest_run(same)
        if length >= lag and np.mean(both_valid[first : first + length]) > 0.5:
            return int(lag), slice(lag + first, lag + first + length)
    return None


def _find_longest_run(flags: np.ndarray) -> tuple[int, int]:
    """Return the start and the length of the longest sequence of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    best = int(np.argmax(lengths))
    return int(edges[2 * best]), int(lengths[best])


def compute_spectrum(
    command: np.ndarray, output: np.ndarray, valid: np.ndarray, period: float, rest: int
) -> Spectrum | None:
    """Return the spectra of one run, by periods if the command repeats itself, else by local polynomials.

    `rest` is the number of rows that a transient lasts after a gap. Returns None if the run is too short.
    """
    result = find_repetition(command, valid)
    if result is not None:
        size, rows = result
        count = (rows.stop - rows.start) // size
        if count >= 2:
            rows = slice(rows.stop - count * size, rows.stop)
            shape = (count, size)
            return average_periods(
                command[rows].reshape(shape), output[rows].reshape(shape), valid[rows].reshape(shape), period
            )
    quiet = valid & ~_flag_rows_after_gaps(valid, rest)
    first, length = _find_longest_run(quiet)
    if length < 50 * SIDE_LINES:
        return None
    return fit_local_polynomials(command[first : first + length], output[first : first + length], period)


def _flag_rows_after_gaps(valid: np.ndarray, rest: int) -> np.ndarray:
    """Return flags of the rows within `rest` rows after a lost one."""
    last = np.maximum.accumulate(np.where(~valid, np.arange(len(valid)), -rest - 1))
    return np.arange(len(valid)) - last <= rest


def average_periods(command: np.ndarray, output: np.ndarray, valid: np.ndarray, period: float) -> Spectrum:
    """Return the spectra from arrays of shape (periods, rows) [m].

    Every row of the period must be available in at least two periods.
    """
    count, size = command.shape
    valid_count = valid.sum(axis=0)
    counted = np.maximum(valid_count, 1)
    mean = np.where(valid, output, 0.0).sum(axis=0) / counted
    input_mean = np.where(valid, command, 0.0).sum(axis=0) / counted
    rest = np.where(valid, output - mean, 0.0)
    freedom = float(valid.sum() - np.sum(valid_count > 0))
    noise = float(np.sqrt(np.sum(rest**2) / max(freedom, 1.0)))
    U, Y = np.fft.rfft(input_mean) / size, np.fft.rfft(mean) / size
    spread = np.sum(np.abs(np.fft.rfft(rest, axis=1) / size) ** 2, axis=0)
    # The variance of a mean over n periods is 1/n of one reading's.
    variance = spread / max(freedom / size, 1e-9) * np.mean(1.0 / counted)
    variance = _smooth(variance)
    number = np.arange(len(U))
    excited = (np.abs(U) > MIN_AMPLITUDE_SHARE * np.abs(U[1:]).max()) & (number > 0)
    excited[len(U) - (size % 2 == 0) :] = False
    return _add_distortion(U, Y, variance, excited, number / (size * period), noise, count)


def _add_distortion(U, Y, variance, excited, frequency, noise, count) -> Spectrum:
    """Return the spectrum with the distortion at lines without excitation."""
    number = np.arange(len(U))
    last = number[excited].max()
    rms = np.sqrt(np.mean(np.abs(Y[excited]) ** 2))
    levels, excess = [], []
    for parity in (1, 0):
        silent = ~excited & (number % 2 == parity) & (number > 0) & (number <= last)
        power = np.abs(Y[silent]) ** 2
        levels.append(float(np.sqrt(power.mean()) / rms) if len(power) else None)
        excess.append(float(np.mean(power / variance[silent])) if len(power) else 1.0)
    signal = np.abs(Y[excited]) ** 2
    return Spectrum(
        frequency=frequency[excited],
        command=U[excited],
        output=Y[excited],
        std=np.sqrt(variance[excited]),
        response=Y[excited] / U[excited],
        coherence=signal / (signal + variance[excited] * count),
        noise_std=noise,
        odd=levels[0],
        even=levels[1],
        excess=(excess[0], excess[1]),
        periods=count,
    )


def _smooth(variance: np.ndarray) -> np.ndarray:
    """Return the running mean over `VARIANCE_SMOOTHING_LINES` lines, without the line at 0 Hz."""
    window = min(VARIANCE_SMOOTHING_LINES, len(variance) - 1)
    half = window // 2
    padded = np.concatenate([variance[1 : half + 1][::-1], variance[1:], variance[-half:][::-1]])
    kernel = np.ones(window) / window
    return np.concatenate([[variance[0]], np.convolve(padded, kernel, "valid")[: len(variance) - 1]])


def fit_local_polynomials(command: np.ndarray, output: np.ndarray, period: float) -> Spectrum:
    """Return the spectra by the local polynomial method: output without transient, and its noise."""
    size = len(command)
    level = command[0]
    U, Y = np.fft.rfft(command - level) / size, np.fft.rfft(output - level) / size
    power = _smooth(np.abs(U) ** 2)
    middle = np.arange(SIDE_LINES, len(U) - SIDE_LINES)
    middle = middle[power[middle] > MIN_POWER_SHARE * power[1:].max()]
    # A periodic command with too few periods to average leaves every other line without power.
    middle = middle[np.abs(U[middle]) ** 2 > MIN_POWER_SHARE * power[middle]]
    width = 2 * SIDE_LINES + 1
    r = np.arange(-SIDE_LINES, SIDE_LINES + 1) / SIDE_LINES
    powers = r[:, None] ** np.arange(POLYNOMIAL_DEGREE + 1)
    windows = sliding_window_view(U, width)[middle - SIDE_LINES]
    basis = np.concatenate(
        [windows[:, :, None] * powers, np.broadcast_to(powers, (len(middle), *powers.shape))], axis=2
    )
    right = sliding_window_view(Y, width)[middle - SIDE_LINES]
    q, triangle = np.linalg.qr(basis)
    projected = np.einsum("lij,li->lj", q.conj(), right)
    solved = np.linalg.solve(triangle, projected[:, :, None])[:, :, 0]
    left = right - np.einsum("lij,lj->li", q, projected)
    variance = np.sum(np.abs(left) ** 2, axis=1) / (width - 2 * (POLYNOMIAL_DEGREE + 1))
    output_line = Y[middle] - solved[:, POLYNOMIAL_DEGREE + 1]
    # If the command's spectrum is smooth as well, transient and response cannot be separated.
    row = np.zeros(basis.shape[2])
    row[POLYNOMIAL_DEGREE + 1] = 1.0
    unsure = np.sum(
        np.abs(np.linalg.solve(triangle.conj().swapaxes(1, 2), row[:, None])[:, :, 0]) ** 2, axis=1
    )
    signal = np.abs(output_line) ** 2
    coherent = signal / (signal + variance * (1.0 + unsure))
    keep = (coherent > 0.5) & (unsure < MAX_TRANSIENT_VARIANCE_RATIO)
    smoothed = np.maximum(_smooth(variance), 1e-300) * (1.0 + unsure)
    return Spectrum(
        frequency=middle[keep] / (size * period),
        command=U[middle][keep],
        output=output_line[keep],
        std=np.sqrt(smoothed[keep]),
        response=solved[keep, 0],
        coherence=coherent[keep],
        noise_std=float(np.sqrt(np.mean(variance) * size)),
        odd=None,
        even=None,
        excess=(1.0, 1.0),
        periods=0,
    )
