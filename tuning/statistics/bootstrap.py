"""Bootstrap confidence intervals of the rms error and the 99th percentile of a batch of scenarios."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import bootstrap

BOOTSTRAP_RESAMPLES = 1999
CONFIDENCE_LEVEL = 0.95
MAX_BCA_SCENARIOS = (
    4096  # number of scenarios above which the BCa correction is negligible and its jackknife is slow
)


class Interval(NamedTuple):
    """Confidence interval."""

    low: float
    high: float


class ErrorIntervals(NamedTuple):
    """Intervals of the rms and the 99th percentile of |e - e*|; NaN if fewer than two scenarios count."""

    rms: Interval
    p99: Interval

    def plain(self) -> dict[str, dict[str, float]]:
        """Return the intervals as plain data for files."""
        return {name: interval._asdict() for name, interval in self._asdict().items()}


def compute_error_intervals(
    errors: Float[np.ndarray, "slots scenarios"],
    good: Bool[np.ndarray, "slots scenarios"],
    *,
    resamples: int = BOOTSTRAP_RESAMPLES,
    level: float = CONFIDENCE_LEVEL,
    seed: int = 0,
) -> ErrorIntervals:
    """Return bootstrap confidence intervals of the rms and 99th percentile of |e - e*| over `good` contacts.

    Whole scenarios are resampled, because the contacts of a scenario depend on each other. The rms, a ratio
    of two means over scenarios, has the BCa interval (bias-corrected and accelerated), or with more than
    `MAX_BCA_SCENARIOS` scenarios the percentile interval. The 99th percentile, which is not smooth enough for
    an acceleration, has the percentile interval.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), chapters 13 and 14.
    """
    size = np.where(good, np.abs(errors), 0)
    counts = np.sum(good, axis=0)
    has_good = counts > 0
    size, good, counts = size[:, has_good], good[:, has_good], counts[has_good]
    if np.sum(has_good) < 2:
        unknown = Interval(float("nan"), float("nan"))
        return ErrorIntervals(unknown, unknown)
    squares = np.sum(size**2, axis=0)
    if np.ptp(squares / counts) <= 1e-12 * np.max(squares / counts):
        return ErrorIntervals(*[Interval(float(np.max(size)), float(np.max(size)))] * 2)

    def root_mean_square(squares, counts, axis):
        return np.sqrt(np.sum(squares, axis=axis) / np.sum(counts, axis=axis))

    rms = bootstrap(
        (squares, counts),
        root_mean_square,
        paired=True,
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, 2_000_000 // len(squares)),
        confidence_level=level,
        method="BCa" if len(squares) <= MAX_BCA_SCENARIOS else "percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    tails = np.array([(1 - level) / 2, (1 + level) / 2])
    percentiles = _resample_percentile(size, good, 0.99, resamples, np.random.default_rng(seed))
    return ErrorIntervals(
        Interval(float(rms.low), float(rms.high)),
        Interval(*map(float, np.quantile(percentiles, tails))),
    )


def _resample_percentile(size, good, share, resamples, generator):
    """Return the quantile of order `share` of `size` (slots, scenarios) at `good`, for each of the resamples.

    A resample is a count per scenario. Its quantile is among the largest contacts, so that only these are
    used.
    """
    slots, scenarios = size.shape
    contacts = np.flatnonzero(good)
    contacts = contacts[np.argsort(-size.reshape(-1)[contacts], kind="stable")]
    # Five standard deviations more than the expected number are far more than a resample can need.
    expected = (1 - share) * len(contacts)
    largest = contacts[: int(np.ceil(expected + 5 * slots * np.sqrt(expected) + 5 * slots))]
    values = size.reshape(-1)[largest]
    counts = np.sum(good, axis=0)
    quantiles = np.empty(resamples)
    batch = max(1, 2_000_000 // scenarios)
    for first in range(0, resamples, batch):
        number = min(batch, resamples - first)
        drawn = generator.integers(0, scenarios, (number, scenarios))
        drawn += scenarios * np.arange(number)[:, None]
        weights = np.bincount(drawn.reshape(-1), minlength=number * scenarios).reshape(number, scenarios)
        above = np.cumsum(weights[:, largest % scenarios], axis=1)
        # Linear interpolation as in `np.quantile`, with ranks counted from the largest value.
        rank = (1 - share) * (weights @ counts - 1)
        near, far = (
            values[np.argmax(above > index[:, None], axis=1)]
            for index in (np.floor(rank), np.floor(rank) + 1)
        )
        quantiles[first : first + number] = near + (rank - np.floor(rank)) * (far - near)
    return quantiles
