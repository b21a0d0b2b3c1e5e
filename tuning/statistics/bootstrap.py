"""Intervals of figures of a batch of scenarios by resampling: of its rms error, of its 99th percentile."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import bootstrap

RESAMPLES = 1999
LEVEL = 0.95
MANY = 4096  # scenarios


class Interval(NamedTuple):
    """Lower and upper end."""

    low: float
    high: float


class ErrorIntervals(NamedTuple):
    """Of the rms and of the 99th percentile of |e - e*|; NaN where fewer than two scenarios count."""

    rms: Interval
    p99: Interval

    def plain(self) -> dict[str, dict[str, float]]:
        """As plain data, for files."""
        return {name: one._asdict() for name, one in self._asdict().items()}


def error_intervals(
    errors: Float[np.ndarray, "slots scenarios"],
    good: Bool[np.ndarray, "slots scenarios"],
    *,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
    seed: int = 0,
) -> ErrorIntervals:
    """Bootstrap confidence intervals of the rms and the 99th percentile of |e - e*| over `good` contacts.

    Scenarios are resampled, each with all its contacts: those of one scenario depend on each other. Of the
    rms, a ratio of two means over scenarios, the interval is BCa (bias-corrected and accelerated); of the
    percentile, which is not smooth and has no use for an acceleration, the percentile interval. That is the
    interval of the rms too where there are so many scenarios that the correction is nothing and its jackknife
    is long.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), chapters 13 and 14.
    """
    size = np.where(good, np.abs(errors), 0)
    counts = np.sum(good, axis=0)
    met = counts > 0
    size, good, counts = size[:, met], good[:, met], counts[met]
    if np.sum(met) < 2:
        nowhere = Interval(float("nan"), float("nan"))
        return ErrorIntervals(nowhere, nowhere)
    squares = np.sum(size**2, axis=0)
    if np.ptp(squares / counts) <= 1e-12 * np.max(squares / counts):
        return ErrorIntervals(*[Interval(float(np.max(size)), float(np.max(size)))] * 2)

    def root_mean_square(squares, counts, axis):
        return np.sqrt(np.sum(squares, axis=axis) / np.sum(counts, axis=axis))

    found = bootstrap(
        (squares, counts),
        root_mean_square,
        paired=True,
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, 2_000_000 // len(squares)),
        confidence_level=level,
        method="BCa" if len(squares) <= MANY else "percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    tails = np.array([(1 - level) / 2, (1 + level) / 2])
    percentiles = _resampled_percentile(size, good, 0.99, resamples, np.random.default_rng(seed))
    return ErrorIntervals(
        Interval(float(found.low), float(found.high)),
        Interval(*map(float, np.quantile(percentiles, tails))),
    )


def _resampled_percentile(size, good, share, resamples, generator):
    """A quantile of the `good` ones of `size` (slots, scenarios), for so many resamplings of scenarios.

    Each resample is a count per scenario. Only the largest contacts are gone through: the quantile of a
    resample is among the first few of them, however often each counts.
    """
    slots, scenarios = size.shape
    contacts = np.flatnonzero(good)
    contacts = contacts[np.argsort(-size.reshape(-1)[contacts], kind="stable")]
    # Far more than a resample can need: five standard deviations above the share it looks for.
    expected = (1 - share) * len(contacts)
    largest = contacts[: int(np.ceil(expected + 5 * slots * np.sqrt(expected) + 5 * slots))]
    values = size.reshape(-1)[largest]
    counts = np.sum(good, axis=0)
    found = np.empty(resamples)
    batch = max(1, 2_000_000 // scenarios)
    for first in range(0, resamples, batch):
        number = min(batch, resamples - first)
        drawn = generator.integers(0, scenarios, (number, scenarios))
        drawn += scenarios * np.arange(number)[:, None]
        weights = np.bincount(drawn.reshape(-1), minlength=number * scenarios).reshape(number, scenarios)
        above = np.cumsum(weights[:, largest % scenarios], axis=1)
        # As `np.quantile` has it, counted from the largest: between two neighbours.
        rank = (1 - share) * (weights @ counts - 1)
        near, far = (
            values[np.argmax(above > place[:, None], axis=1)]
            for place in (np.floor(rank), np.floor(rank) + 1)
        )
        found[first : first + number] = near + (rank - np.floor(rank)) * (far - near)
    return found
