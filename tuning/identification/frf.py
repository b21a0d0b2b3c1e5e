"""Spectra of command and measured position in free motion, with the noise estimated from the data.

The periods of a periodic command (a multisine) are averaged. The differences between the periods give the
noise. Power at frequency lines without excitation indicates nonlinear distortion: friction and dead bands at
odd lines, asymmetry at even lines (Pintelon and Schoukens, System Identification: A Frequency Domain
Approach, 2012). For any other command, the local polynomial method separates the response from the transient
and the noise. It approximates response and transient by polynomials of degree 2 in a window of 13 frequency
lines (Schoukens et al. 2009).

The rig itself does not notice that its log lost a row. The command of a short gap is reconstructed
(`tuning.identification.logs.lost_rows`), so only the reading is missing. Averages over periods omit it. Where
every row is needed, a cubic spline interpolates it, because the motion has little power near the highest
frequencies. After a longer gap, the rows that the unknown commands affect are omitted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import CubicSpline

from tuning.identification.logs.lost_rows import MAX_RECONSTRUCTED_ROWS
from tuning.identification.noise import detect_resolution

MIN_PERIOD_ROWS = 100  # rows, shortest period that the search for a periodic command considers
VARIANCE_SMOOTHING_LINES = 15  # number of adjacent lines whose noise variance is averaged
SIDE_LINES = 6  # local polynomial method: lines on either side of the estimated line
POLYNOMIAL_DEGREE = 2  # local polynomial method: degree of response and transient
# Maximum ratio of the transient's variance to the noise variance; other lines are omitted.
MAX_TRANSIENT_VARIANCE_RATIO = 20.0
MIN_POWER_SHARE = 3e-3  # minimum power of an excited line as a share of the largest (non-periodic command)
# minimum amplitude of an excited line as a share of the largest amplitude (periodic command)
MIN_AMPLITUDE_SHARE = 1e-3


@dataclass(frozen=True)
class Spectrum:
    """Spectra of command and position of one run, at the frequency lines that the command excites."""

    frequency: np.ndarray  # excited lines [Hz]
    command: np.ndarray  # complex amplitude of the commanded position [m]
    output: np.ndarray  # complex amplitude of the measured position, without the transient [m]
    std: np.ndarray  # standard deviation of the complex noise of `output` [m]
    response: np.ndarray  # complex frequency response, smoothed if the command is not periodic
    coherence: np.ndarray  # 0..1, share of the output's power that the command causes
    noise_std: float  # standard deviation of the noise of a single position reading [m]
    # odd distortion: ratio of the rms output at odd lines without excitation to that at excited lines
    odd: float | None
    # even distortion: ratio of the rms output at even lines without excitation to that at excited lines
    even: float | None
    excess: tuple[float, float]  # ratio of output to noise power at odd and at even lines without excitation
    periods: int  # number of averaged periods; 0 for a non-periodic command


def find_repetition(command: np.ndarray, valid: np.ndarray) -> tuple[int, slice] | None:
    """Find the period of a command, and the range of rows in which the command is periodic.

    The command need not be periodic from its first row, because a multisine usually fades in.

    Args:
        command: Commanded position of each row.
        valid: Flags of the rows that were not lost.

    Returns:
        The number of rows per period, and the range of rows; or None if the command is not periodic.
    """
    rows = len(command)
    centred = np.where(valid, command - command[valid].mean(), 0.0)
    size = 1 << int(np.ceil(np.log2(2 * rows)))
    spectrum = np.fft.rfft(centred, size)
    correlation = np.fft.irfft(np.abs(spectrum) ** 2, size)[: rows // 2 + 1]
    # Divide the correlation by its number of products, so that it does not decrease with the lag.
    correlation = correlation / (rows - np.arange(len(correlation)))
    peaks = 1 + np.flatnonzero(
        (correlation[1:-1] >= correlation[:-2]) & (correlation[1:-1] > correlation[2:])
    )
    scale = np.std(command[valid])
    for lag in peaks[(peaks >= MIN_PERIOD_ROWS) & (correlation[peaks] > 0.5 * correlation[0])]:
        both_valid = valid[lag:] & valid[:-lag]
        same = (np.abs(command[lag:] - command[:-lag]) <= 1e-4 * scale) | ~both_valid
        first, length = _find_longest_run(same)
        if length >= lag and np.mean(both_valid[first : first + length]) > 0.5:
            return int(lag), slice(lag + first, lag + first + length)
    return None


def _find_longest_run(flags: np.ndarray) -> tuple[int, int]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    best = int(np.argmax(lengths))
    return int(edges[2 * best]), int(lengths[best])


def compute_spectrum(
    command: np.ndarray, output: np.ndarray, valid: np.ndarray, period: float, rest: int
) -> Spectrum | None:
    """Compute the spectra of one run: average the periods or, without periods, fit local polynomials.

    Args:
        command: Commanded position of each row [m].
        output: Measured position of each row [m].
        valid: Flags of the rows that were not lost.
        period: Control period [s].
        rest: Number of rows that the transient after a lost row disturbs.

    Returns:
        The spectra, or None if the run is too short.
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
    has_command = valid | _flag_short_gaps(valid)
    first, length = _find_longest_run(has_command & ~_flag_rows_after_gaps(has_command, rest))
    if length < 50 * SIDE_LINES:
        return None
    rows = slice(first, first + length)
    return fit_local_polynomials(command[rows], _interpolate(output[rows], valid[rows]), period)


def _flag_short_gaps(valid: np.ndarray) -> np.ndarray:
    """Flag the lost rows between valid rows in gaps that are short enough to reconstruct the command."""
    rows, last = np.arange(len(valid)), len(valid)
    before = np.maximum.accumulate(np.where(valid, rows, -last))
    after = np.minimum.accumulate(np.where(valid, rows, 2 * last)[::-1])[::-1]
    return ~valid & (after - before <= MAX_RECONSTRUCTED_ROWS + 1)


def _interpolate(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Replace the values that are not valid by a cubic spline through the others."""
    if valid.all():
        return values
    rows, filled = np.arange(len(values)), values.copy()
    filled[~valid] = CubicSpline(rows[valid], values[valid])(rows[~valid])
    return filled


def _flag_rows_after_gaps(valid: np.ndarray, rest: int) -> np.ndarray:
    """Return flags that mark every lost row and the `rest` rows that follow it."""
    last = np.maximum.accumulate(np.where(~valid, np.arange(len(valid)), -rest - 1))
    return np.arange(len(valid)) - last <= rest


def average_periods(command: np.ndarray, output: np.ndarray, valid: np.ndarray, period: float) -> Spectrum:
    """Compute the spectra of a periodic command from arrays of shape (periods, rows) [m].

    Rows that are not valid in any period are interpolated.
    """
    count, size = command.shape
    valid_count = valid.sum(axis=0)
    counted = np.maximum(valid_count, 1)
    mean, input_mean = (
        _interpolate(np.where(valid, values, 0.0).sum(axis=0) / counted, valid_count > 0)
        for values in (output, command)
    )
    rest = np.where(valid, output - mean, 0.0)
    degrees_of_freedom = float(valid.sum() - np.sum(valid_count > 0))
    noise = float(np.sqrt(np.sum(rest**2) / max(degrees_of_freedom, 1.0)))
    U, Y = np.fft.rfft(input_mean) / size, np.fft.rfft(mean) / size
    spread = np.sum(np.abs(np.fft.rfft(rest, axis=1) / size) ** 2, axis=0)
    # The variance of a mean over n periods is 1/n of the variance of a reading.
    variance = spread / max(degrees_of_freedom / size, 1e-9) * np.mean(1.0 / counted)
    # Without noise, rounding is the same in all periods, so that their differences do not show it.
    variance = np.maximum(_smooth(variance), _compute_rounding_variance(output[valid]) / size)
    number = np.arange(len(U))
    excited = (np.abs(U) > MIN_AMPLITUDE_SHARE * np.abs(U[1:]).max()) & (number > 0)
    excited[len(U) - (size % 2 == 0) :] = False
    return _add_distortion(U, Y, variance, excited, number / (size * period), noise, count)


def _compute_rounding_variance(readings: np.ndarray) -> float:
    """Return the variance of the rounding error of readings, at least that of float64."""
    return max(detect_resolution(readings), float(np.spacing(np.abs(readings).max()))) ** 2 / 12.0


def _add_distortion(U, Y, variance, excited, frequency, noise, count) -> Spectrum:
    """Return the spectrum, with the nonlinear distortion measured at the lines without excitation."""
    number = np.arange(len(U))
    last = number[excited].max()
    rms = np.sqrt(np.mean(np.abs(Y[excited]) ** 2))
    levels, excess = [], []
    for parity in (1, 0):
        unexcited = ~excited & (number % 2 == parity) & (number > 0) & (number <= last)
        power = np.abs(Y[unexcited]) ** 2
        levels.append(float(np.sqrt(power.mean()) / rms) if len(power) else None)
        excess.append(float(np.mean(power / variance[unexcited])) if len(power) else 1.0)
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
    window = min(VARIANCE_SMOOTHING_LINES, len(variance) - 1)
    half = window // 2
    padded = np.concatenate([variance[1 : half + 1][::-1], variance[1:], variance[-half:][::-1]])
    kernel = np.ones(window) / window
    return np.concatenate([[variance[0]], np.convolve(padded, kernel, "valid")[: len(variance) - 1]])


def fit_local_polynomials(command: np.ndarray, output: np.ndarray, period: float) -> Spectrum | None:
    """Compute the spectra of a non-periodic command by the local polynomial method; None without lines."""
    size = len(command)
    level = command[0]
    U, Y = np.fft.rfft(command - level) / size, np.fft.rfft(output - level) / size
    power = _smooth(np.abs(U) ** 2)
    middle = np.arange(SIDE_LINES, len(U) - SIDE_LINES)
    middle = middle[power[middle] > MIN_POWER_SHARE * power[1:].max()]
    # If a periodic command has too few periods for an average, every second line has no power.
    middle = middle[np.abs(U[middle]) ** 2 > MIN_POWER_SHARE * power[middle]]
    if len(middle) < 2:
        return None
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
    # Transient and response cannot be separated if the spectrum of the command is smooth.
    row = np.zeros(basis.shape[2])
    row[POLYNOMIAL_DEGREE + 1] = 1.0
    transient_variance = np.sum(
        np.abs(np.linalg.solve(triangle.conj().swapaxes(1, 2), row[:, None])[:, :, 0]) ** 2, axis=1
    )
    signal = np.abs(output_line) ** 2
    coherence = signal / (signal + variance * (1.0 + transient_variance))
    keep = (coherence > 0.5) & (transient_variance < MAX_TRANSIENT_VARIANCE_RATIO)
    smoothed = np.maximum(_smooth(variance), 1e-300) * (1.0 + transient_variance)
    return Spectrum(
        frequency=middle[keep] / (size * period),
        command=U[middle][keep],
        output=output_line[keep],
        std=np.sqrt(smoothed[keep]),
        response=solved[keep, 0],
        coherence=coherence[keep],
        noise_std=float(np.sqrt(np.mean(variance) * size)),
        odd=None,
        even=None,
        excess=(1.0, 1.0),
        periods=0,
    )
