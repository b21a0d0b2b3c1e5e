"""Spectra of free motion: command and measured position at the lines, with the noise the data show.

A command that repeats itself (a multisine) is averaged over its periods: what differs from period to period
is noise, what appears at lines that were not excited is nonlinearity: odd ones for friction and dead bands,
even ones for asymmetry (Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2012).
Of any other command the local polynomial method takes the transient away and leaves the noise: around each
line the response and the transient are polynomials of degree 2 over 13 lines (Schoukens and others 2009).
Rows that were lost do not count; a period is averaged over the rows it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

SMOOTHED = 15  # lines over which the variance of the noise is averaged
SIDE, DEGREE = 6, 2  # of the local polynomial method: lines on each side, degree of the polynomials
UNSURE = 20.0  # variance of the transient's estimate over that of the noise, above which a line is left out
DRIVEN = 3e-3  # of the largest power: a line at which a command that does not repeat itself drives
EXCITED = 1e-3  # of the largest amplitude: an excited line


@dataclass(frozen=True)
class Spectrum:
    """What one run says at its lines."""

    frequency: np.ndarray  # Hz
    command: np.ndarray  # complex amplitude [m]
    output: np.ndarray  # complex amplitude [m], without the transient
    std: np.ndarray  # m, of the output's complex noise
    response: np.ndarray  # complex, output over command: averaged over neighbours where not by periods
    coherence: np.ndarray  # 0..1, share of the output that is the command's
    noise_std: float  # m, of the position readings in time
    odd: float | None  # output's rms at odd lines without excitation over that at excited ones
    even: float | None  # the same of even lines
    excess: tuple[float, float]  # power at odd and even lines without excitation over that of noise there
    periods: int  # averaged; 0 for a command that does not repeat itself


def repetition(command: np.ndarray, valid: np.ndarray, shortest: int = 100) -> tuple[int, slice] | None:
    """Rows in a period and the rows where the command repeats the period before, or None.

    A command whose fade-in differs from the rest repeats itself after it.
    """
    rows = len(command)
    centred = np.where(valid, command - command[valid].mean(), 0.0)
    size = 1 << int(np.ceil(np.log2(2 * rows)))
    spectrum = np.fft.rfft(centred, size)
    likeness = np.fft.irfft(np.abs(spectrum) ** 2, size)[: rows // 2 + 1]
    # Unbiased in the number of products, so that later repetitions are not smaller than the first.
    likeness = likeness / (rows - np.arange(len(likeness)))
    peaks = 1 + np.flatnonzero((likeness[1:-1] >= likeness[:-2]) & (likeness[1:-1] > likeness[2:]))
    scale = np.std(command[valid])
    for lag in peaks[(peaks >= shortest) & (likeness[peaks] > 0.5 * likeness[0])]:
        both = valid[lag:] & valid[:-lag]
        same = (np.abs(command[lag:] - command[:-lag]) <= 1e-4 * scale) | ~both
        first, length = _longest(same)
        if length >= lag and np.mean(both[first : first + length]) > 0.5:
            return int(lag), slice(lag + first, lag + first + length)
    return None


def _longest(flags: np.ndarray) -> tuple[int, int]:
    """Start and length of the longest stretch of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    if not len(edges):
        return 0, 0
    lengths = edges[1::2] - edges[::2]
    best = int(np.argmax(lengths))
    return int(edges[2 * best]), int(lengths[best])


def spectrum(
    command: np.ndarray, output: np.ndarray, valid: np.ndarray, period: float, rest: int
) -> Spectrum | None:
    """The spectra of one run: by periods where the command has any, else by local polynomials.

    `rest`: rows that a transient lasts after a gap. None where no stretch is long enough."""
    found = repetition(command, valid)
    if found is not None:
        size, rows = found
        count = (rows.stop - rows.start) // size
        if count >= 2:
            rows = slice(rows.stop - count * size, rows.stop)
            shape = (count, size)
            return periodic(
                command[rows].reshape(shape), output[rows].reshape(shape), valid[rows].reshape(shape), period
            )
    quiet = valid & ~_after_gaps(valid, rest)
    first, length = _longest(quiet)
    if length < 50 * SIDE:
        return None
    return aperiodic(command[first : first + length], output[first : first + length], period)


def _after_gaps(valid: np.ndarray, rest: int) -> np.ndarray:
    """Rows within `rest` of the last lost one."""
    last = np.maximum.accumulate(np.where(~valid, np.arange(len(valid)), -rest - 1))
    return np.arange(len(valid)) - last <= rest


def periodic(command: np.ndarray, output: np.ndarray, valid: np.ndarray, period: float) -> Spectrum:
    """From arrays of (periods, rows) [m]; every row of the period must be there in two of them."""
    count, size = command.shape
    there = valid.sum(axis=0)
    counted = np.maximum(there, 1)
    mean = np.where(valid, output, 0.0).sum(axis=0) / counted
    input_mean = np.where(valid, command, 0.0).sum(axis=0) / counted
    rest = np.where(valid, output - mean, 0.0)
    # Periods drift apart as a whole where the sensor does; that is no noise of the lines.
    freedom = float(valid.sum() - np.sum(there > 0))
    noise = float(np.sqrt(np.sum(rest**2) / max(freedom, 1.0)))
    U, Y = np.fft.rfft(input_mean) / size, np.fft.rfft(mean) / size
    spread = np.sum(np.abs(np.fft.rfft(rest, axis=1) / size) ** 2, axis=0)
    # Of a row that n periods have, the mean's variance is 1/n of one reading's.
    variance = spread / max(freedom / size, 1e-9) * np.mean(1.0 / counted)
    variance = _smooth(variance)
    number = np.arange(len(U))
    excited = (np.abs(U) > EXCITED * np.abs(U[1:]).max()) & (number > 0)
    excited[len(U) - (size % 2 == 0) :] = False
    return _with_distortion(U, Y, variance, excited, number / (size * period), noise, count)


def _with_distortion(U, Y, variance, excited, frequency, noise, count) -> Spectrum:
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
    """Running mean over `SMOOTHED` lines, without the line at 0."""
    window = min(SMOOTHED, len(variance) - 1)
    half = window // 2
    padded = np.concatenate([variance[1 : half + 1][::-1], variance[1:], variance[-half:][::-1]])
    kernel = np.ones(window) / window
    return np.concatenate([[variance[0]], np.convolve(padded, kernel, "valid")[: len(variance) - 1]])


def aperiodic(command: np.ndarray, output: np.ndarray, period: float) -> Spectrum:
    """By the local polynomial method: the output less its transient, and the noise of each line."""
    size = len(command)
    level = command[0]
    U, Y = np.fft.rfft(command - level) / size, np.fft.rfft(output - level) / size
    power = _smooth(np.abs(U) ** 2)
    middle = np.arange(SIDE, len(U) - SIDE)
    middle = middle[power[middle] > DRIVEN * power[1:].max()]
    # Of periods too few to average, every other line is silent.
    middle = middle[np.abs(U[middle]) ** 2 > DRIVEN * power[middle]]
    width = 2 * SIDE + 1
    r = np.arange(-SIDE, SIDE + 1) / SIDE
    powers = r[:, None] ** np.arange(DEGREE + 1)
    windows = sliding_window_view(U, width)[middle - SIDE]
    basis = np.concatenate(
        [windows[:, :, None] * powers, np.broadcast_to(powers, (len(middle), *powers.shape))], axis=2
    )
    right = sliding_window_view(Y, width)[middle - SIDE]
    q, triangle = np.linalg.qr(basis)
    projected = np.einsum("lij,li->lj", q.conj(), right)
    solved = np.linalg.solve(triangle, projected[:, :, None])[:, :, 0]
    left = right - np.einsum("lij,lj->li", q, projected)
    variance = np.sum(np.abs(left) ** 2, axis=1) / (width - 2 * (DEGREE + 1))
    output_line = Y[middle] - solved[:, DEGREE + 1]
    # Where the command's spectrum is smooth itself, transient and response cannot be told apart.
    row = np.zeros(basis.shape[2])
    row[DEGREE + 1] = 1.0
    unsure = np.sum(
        np.abs(np.linalg.solve(triangle.conj().swapaxes(1, 2), row[:, None])[:, :, 0]) ** 2, axis=1
    )
    signal = np.abs(output_line) ** 2
    coherent = signal / (signal + variance * (1.0 + unsure))
    keep = (coherent > 0.5) & (unsure < UNSURE)
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
