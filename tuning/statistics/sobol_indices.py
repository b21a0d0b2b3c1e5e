"""First-order and total Sobol indices, with intervals.

The indices of y = f(inputs) for independent inputs x_i are

    S_i = Var(E[y | x_i]) / Var(y),        T_i = E[Var(y | all but x_i)] / Var(y).

S_i is the share of the variance that x_i explains alone. T_i is the share that remains if only x_i is
unknown; it includes all interactions of x_i. If T_i is near 0, x_i may be fixed. If the sum of all S_i is
near 1, the inputs do not interact.

The design has two independent sets of scenarios A and B, and for every input a set AB_i, which is A with that
input from B (Saltelli, Annoni, Azzini, Campolongo, Ratto, Tarantola 2010, "Variance based sensitivity
analysis of model output"). `saltelli_design` returns its uniform numbers, which the quantile functions of the
inputs convert to scenarios; `sobol_indices` computes the indices from their results. An input may have
several columns: a number that is drawn independently for each contact is one input.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tuning.statistics.intervals import CONFIDENCE_LEVEL, Estimate

SOBOL_RESAMPLES = 1000
_MAX_NUMBERS_IN_MEMORY = 2**22  # limit on the numbers in memory during resampling


class SobolIndices(NamedTuple):
    """Sobol indices with their intervals, each (inputs,), as shares of the variance."""

    first_order: Estimate
    total: Estimate


def count_evaluations(inputs: int | Sequence[int], number: int) -> int:
    """Return the number of scenarios of the design, number (inputs + 2)."""
    return number * (len(_count_columns(inputs)) + 2)


def saltelli_design(inputs: int | Sequence[int], number: int, seed: int) -> np.ndarray:
    """Return the uniform numbers of the design in [0, 1), (number (inputs + 2), columns): A, B, AB_1, ...

    `inputs` is the number of inputs, or the number of columns of each input. A and B are the halves of a
    scrambled Sobol sequence with twice as many columns. The same seed gives the same design. Raise ValueError
    unless `number` is a power of two, seed >= 0, and every input has a column.
    """
    # The import takes most of a second, and only this function needs it.
    from scipy.stats import qmc

    columns = _count_columns(inputs)
    if seed < 0 or number < 2 or number & (number - 1):
        raise ValueError(f"number, seed: found {number}, {seed}, expected a power of two from 2, 0 or more")
    total = sum(columns)
    points = qmc.Sobol(2 * total, scramble=True, rng=np.random.default_rng(seed)).random(number)
    a, b = points[:, :total], points[:, total:]
    edges = np.cumsum([0, *columns])
    mixed = []
    for start, end in pairwise(edges):
        mixed.append(a.copy())
        mixed[-1][:, start:end] = b[:, start:end]
    return np.concatenate([a, b, *mixed])


def sobol_indices(
    values: np.ndarray,
    inputs: int | Sequence[int],
    number: int,
    seed: int = 0,
    level: float = CONFIDENCE_LEVEL,
    cap: float | None = None,
) -> SobolIndices:
    """Return the indices from the results (number (inputs + 2),) of the design's scenarios, in its order.

    With the results f_A, f_B, f_i of A, B, AB_i minus the mean of f_A and f_B, and the variance V of these:

        S_i = mean(f_B (f_i - f_A)) / V          (Saltelli et al. 2010, table 2 b)
        T_i = mean((f_A - f_i)^2) / (2 V)        (Jansen 1999; table 2 f)

    as in `scipy.stats.sobol_indices`. The interval is a bootstrap percentile interval: rows of A, B and all
    AB_i together are resampled `SOBOL_RESAMPLES` times (Archer, Saltelli, Sobol 1997). It assumes independent
    rows. Those of a Sobol sequence are more even, so that it covers more than stated, by far if f is smooth.
    Estimates may be below 0, since they are not clipped. An input that changed no result of the design has
    total 0 and an interval of width 0, which says little if the results are rare failures, counted as 0 or 1.

    Results at `cap` or above, and results that are not finite, count as `cap`; the indices are those of the
    clipped result. If nothing varies, indices are nan and intervals 0 to 1. Raise ValueError for a wrong
    number of results, for non-finite results without a cap, for a cap that is not finite, and for a level
    outside 0 to 1.
    """
    count = len(_count_columns(inputs))
    values = np.asarray(values, float)
    if values.shape != (number * (count + 2),):
        raise ValueError(f"values: found shape {values.shape}, expected ({number * (count + 2)},)")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: found {level}, expected between 0 and 1")
    if cap is not None:
        if not np.isfinite(cap):
            raise ValueError(f"cap: found {cap}, expected a finite number")
        values = np.where(np.isfinite(values), np.minimum(values, cap), cap)
    elif not np.all(np.isfinite(values)):
        raise ValueError("values: found some that are not finite, expected with a cap only")
    rows = values.reshape(count + 2, number)
    if np.all(rows[:2] == rows[0, 0]):
        unknown = Estimate(np.full(count, np.nan), np.zeros(count), np.ones(count))
        return SobolIndices(unknown, unknown)
    # The scale cancels; with it at 1, squares neither overflow nor underflow.
    rows = rows / np.max(np.abs(rows))
    rows = rows - np.mean(rows[:2])
    a, b, mixed = rows[0], rows[1], rows[2:]
    terms = np.stack(
        [*(b * (mixed - a)), *(0.5 * (a - mixed) ** 2), 0.5 * (a + b), 0.5 * (a**2 + b**2)], axis=1
    )

    estimate = _compute_indices(np.mean(terms, axis=0)[None])[0]
    resampled = _compute_indices(_resample_means(terms, seed))
    tail = (1.0 - level) / 2.0
    low, high = np.nanquantile(resampled, [tail, 1.0 - tail], axis=0)
    return SobolIndices(
        Estimate(estimate[:count], low[:count], high[:count]),
        Estimate(estimate[count:], low[count:], high[count:]),
    )


def _count_columns(inputs: int | Sequence[int]) -> tuple[int, ...]:
    """Return the number of columns of each input. Raise ValueError if an input has none."""
    columns = (1,) * inputs if isinstance(inputs, int) else tuple(inputs)
    if not columns or min(columns) < 1:
        raise ValueError(f"inputs: found {inputs!r}, expected one or more, each of one column or more")
    return columns


def _resample_means(terms: np.ndarray, seed: int) -> np.ndarray:
    """Return the means (RESAMPLES, terms) of the terms (number, terms) over rows drawn with replacement."""
    number = len(terms)
    rng = np.random.default_rng(seed)
    batch = max(1, _MAX_NUMBERS_IN_MEMORY // number)
    means = []
    for start in range(0, SOBOL_RESAMPLES, batch):
        size = min(batch, SOBOL_RESAMPLES - start)
        drawn = rng.integers(0, number, (size, number)) + number * np.arange(size)[:, None]
        weights = np.bincount(drawn.ravel(), minlength=size * number).reshape(size, number)
        means.append(weights @ terms / number)
    return np.concatenate(means)


def _compute_indices(means: np.ndarray) -> np.ndarray:
    """Return indices (resamples, 2 inputs) from the means of the terms."""
    variance = means[:, -1] - means[:, -2] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance[:, None] > 0.0, means[:, :-2] / variance[:, None], np.nan)
