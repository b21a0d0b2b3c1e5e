"""Bootstrap confidence intervals of the rms and the 99th percentile of restitution errors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import bootstrap

BOOTSTRAP_RESAMPLES = 1999  # number of bootstrap resamples
CONFIDENCE_LEVEL = 0.95
# Largest number of scenarios for which the BCa correction is computed; for more, it is negligible and slow.
MAX_BCA_SCENARIOS = 4096


class Interval(NamedTuple):
    """Confidence interval, in the unit of the estimated quantity."""

    low: float  # lower bound
    high: float  # upper bound


class ErrorIntervals(NamedTuple):
    """Confidence intervals of errors |e - e*|; NaN unless two or more scenarios have a contact that ended."""

    rms: Interval  # interval of the rms error [1]
    p99: Interval  # interval of the 99th percentile [1]

    def plain(self) -> dict[str, dict[str, float]]:
        return {name: interval._asdict() for name, interval in self._asdict().items()}


def compute_error_intervals(
    errors: Float[np.ndarray, "slots scenarios"],
    good: Bool[np.ndarray, "slots scenarios"],
    *,
    resamples: int = BOOTSTRAP_RESAMPLES,
    seed: int = 0,
) -> ErrorIntervals:
    """Compute bootstrap confidence intervals of the rms and the 99th percentile of restitution errors.

    The bootstrap resamples whole scenarios, because the contacts of a scenario are not independent. The
    interval of the rms is the BCa interval (bias-corrected and accelerated). With more than
    `MAX_BCA_SCENARIOS` scenarios it is the percentile interval. The interval of the 99th percentile is always
    the percentile interval, because a percentile is not a smooth function of the data, as BCa requires.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), chapters 13 and 14.

    Args:
        errors: restitution error e - e* of each contact [1].
        good: whether each contact has ended; the others are ignored.
        resamples: number of bootstrap resamples.
        seed: seed of the resamples.
    """
    magnitudes = np.where(good, np.abs(errors), 0)
    counts = np.sum(good, axis=0)
    has_good = counts > 0
    magnitudes, good, counts = magnitudes[:, has_good], good[:, has_good], counts[has_good]
    if np.sum(has_good) < 2:
        unknown = Interval(float("nan"), float("nan"))
        return ErrorIntervals(unknown, unknown)
    squares = np.sum(magnitudes**2, axis=0)
    if np.ptp(squares / counts) <= 1e-12 * np.max(squares / counts):
        return ErrorIntervals(*[Interval(float(np.max(magnitudes)), float(np.max(magnitudes)))] * 2)

    def root_mean_square(squares, counts, axis):
        return np.sqrt(np.sum(squares, axis=axis) / np.sum(counts, axis=axis))

    rms = bootstrap(
        (squares, counts),
        root_mean_square,
        paired=True,
        vectorized=True,
        n_resamples=resamples,
        batch=max(1, 2_000_000 // len(squares)),
        confidence_level=CONFIDENCE_LEVEL,
        method="BCa" if len(squares) <= MAX_BCA_SCENARIOS else "percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    tails = np.array([(1 - CONFIDENCE_LEVEL) / 2, (1 + CONFIDENCE_LEVEL) / 2])
    percentiles = _resample_percentile(magnitudes, good, 0.99, resamples, np.random.default_rng(seed))
    return ErrorIntervals(
        Interval(float(rms.low), float(rms.high)),
        Interval(*map(float, np.quantile(percentiles, tails))),
    )


def _resample_percentile(magnitudes, good, share, resamples, generator):
    """Return the quantile of order `share` of the |error| of ended contacts in each resample, (resamples,).

    A resample counts how often each scenario was drawn. Only the largest magnitudes are used, because the
    quantile lies among them.
    """
    slots, scenarios = magnitudes.shape
    contacts = np.flatnonzero(good)
    contacts = contacts[np.argsort(-magnitudes.reshape(-1)[contacts], kind="stable")]
    # The number of contacts above the quantile exceeds its mean by five standard deviations practically
    # never.
    expected = (1 - share) * len(contacts)
    largest = contacts[: int(np.ceil(expected + 5 * slots * np.sqrt(expected) + 5 * slots))]
    values = magnitudes.reshape(-1)[largest]
    counts = np.sum(good, axis=0)
    quantiles = np.empty(resamples)
    batch = max(1, 2_000_000 // scenarios)
    for first in range(0, resamples, batch):
        number = min(batch, resamples - first)
        drawn = generator.integers(0, scenarios, (number, scenarios))
        drawn += scenarios * np.arange(number)[:, None]
        weights = np.bincount(drawn.reshape(-1), minlength=number * scenarios).reshape(number, scenarios)
        above = np.cumsum(weights[:, largest % scenarios], axis=1)
        # Interpolate linearly, like `np.quantile`; ranks are counted from the largest value.
        rank = (1 - share) * (weights @ counts - 1)
        near, far = (
            values[np.argmax(above > index[:, None], axis=1)]
            for index in (np.floor(rank), np.floor(rank) + 1)
        )
        quantiles[first : first + number] = near + (rank - np.floor(rank)) * (far - near)
    return quantiles
