"""Which uncertain input drives a result: first-order and total Sobol indices, with intervals.

Of the variance of y = f(inputs), inputs independent,

    S_i = Var(E[y | x_i]) / Var(y),        T_i = E[Var(y | all but x_i)] / Var(y),

is the share that x_i explains by itself, and the share that would be left if only x_i were unknown: all that
it takes part in. T_i near 0: x_i may be fixed. The sum of S_i near 1: the inputs act one by one.

They take a design of their own. Two independent sets of scenarios A and B, and for every input the set AB_i:
A but for that input, which is B's (Saltelli, Annoni, Azzini, Campolongo, Ratto, Tarantola 2010, "Variance
based sensitivity analysis of model output"). `saltelli_design` gives its uniform numbers, which the quantile
functions of the inputs make scenarios of; `sobol_indices` makes indices of their results. An input may have
several columns: what is drawn independently for each contact is one input.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tuning.statistics.intervals import LEVEL, Estimate

RESAMPLES = 1000
_AT_ONCE = 2**22  # numbers of one block of resampling


class Indices(NamedTuple):
    """First-order and total Sobol indices with their intervals, each (inputs,), as shares of the variance."""

    first_order: Estimate
    total: Estimate


def evaluations(inputs: int | Sequence[int], number: int) -> int:
    """How many scenarios the design takes: number (inputs + 2)."""
    return number * (len(_columns(inputs)) + 2)


def saltelli_design(inputs: int | Sequence[int], number: int, seed: int) -> np.ndarray:
    """Uniform numbers of the design, (number (inputs + 2), columns), in [0, 1): A, B, AB_1, AB_2, ...

    `inputs` is how many, or how many columns each of them has. A and B are the halves of a scrambled Sobol
    sequence in twice as many columns. The same seed gives the same design. Raises ValueError unless `number`
    is a power of two, seed >= 0, and every input has a column.
    """
    # Takes most of a second to import, and only this function needs it.
    from scipy.stats import qmc

    columns = _columns(inputs)
    if seed < 0 or number < 2 or number & (number - 1):
        raise ValueError(f"number, seed: found {number}, {seed}, allowed a power of two from 2, 0 or more")
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
    level: float = LEVEL,
    cap: float | None = None,
) -> Indices:
    """Indices from the results (number (inputs + 2),) of the design's scenarios, in its order.

    With f_A, f_B, f_i of A, B, AB_i, less the mean of f_A and f_B, and their variance V, over the rows:

        S_i = mean(f_B (f_i - f_A)) / V          (Saltelli et al. 2010, table 2 b)
        T_i = mean((f_A - f_i)^2) / (2 V)        (Jansen 1999; table 2 f)

    the estimators of `scipy.stats.sobol_indices`. The interval: the quantiles (1 -+ level) / 2 of the same
    from rows drawn again with replacement, `RESAMPLES` times, A, B and all AB_i of a row together (Archer,
    Saltelli, Sobol 1997). The rows of a Sobol sequence are more even than the independent ones that this
    supposes: it covers more than it states, and by far where f is smooth. Shares are not cut at 0: estimates
    scatter about it. An input whose change changed no result of the design has total 0 and an interval
    without width: that says little where the results are rare failures, counted 0 and 1.

    Results at `cap` or above count as `cap`, and so do those that are not finite: the indices are then of the
    result so cut. Where nothing varies, indices are nan and intervals 0 to 1. Raises ValueError for another
    number of results, for non-finite ones without a cap, for a cap that is not finite, and for a level
    outside 0 to 1.
    """
    count = len(_columns(inputs))
    values = np.asarray(values, float)
    if values.shape != (number * (count + 2),):
        raise ValueError(f"values: found shape {values.shape}, allowed ({number * (count + 2)},)")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: found {level}, allowed between 0 and 1")
    if cap is not None:
        if not np.isfinite(cap):
            raise ValueError(f"cap: found {cap}, allowed a finite number")
        values = np.where(np.isfinite(values), np.minimum(values, cap), cap)
    elif not np.all(np.isfinite(values)):
        raise ValueError("values: found some that are not finite, allowed with a cap only")
    rows = values.reshape(count + 2, number)
    if np.all(rows[:2] == rows[0, 0]):
        unknown = Estimate(np.full(count, np.nan), np.zeros(count), np.ones(count))
        return Indices(unknown, unknown)
    # The scale drops out, and squares then neither overflow nor vanish.
    rows = rows / np.max(np.abs(rows))
    rows = rows - np.mean(rows[:2])
    a, b, mixed = rows[0], rows[1], rows[2:]
    terms = np.stack(
        [*(b * (mixed - a)), *(0.5 * (a - mixed) ** 2), 0.5 * (a + b), 0.5 * (a**2 + b**2)], axis=1
    )

    estimate = _ratios(np.mean(terms, axis=0)[None])[0]
    resampled = _ratios(_resampled_means(terms, seed))
    tail = (1.0 - level) / 2.0
    low, high = np.nanquantile(resampled, [tail, 1.0 - tail], axis=0)
    return Indices(
        Estimate(estimate[:count], low[:count], high[:count]),
        Estimate(estimate[count:], low[count:], high[count:]),
    )


def _columns(inputs: int | Sequence[int]) -> tuple[int, ...]:
    columns = (1,) * inputs if isinstance(inputs, int) else tuple(inputs)
    if not columns or min(columns) < 1:
        raise ValueError(f"inputs: found {inputs!r}, allowed one or more, each of one column or more")
    return columns


def _resampled_means(terms: np.ndarray, seed: int) -> np.ndarray:
    """Means of the terms (number, terms) over rows drawn with replacement, (RESAMPLES, terms)."""
    number = len(terms)
    rng = np.random.default_rng(seed)
    block = max(1, _AT_ONCE // number)
    means = []
    for start in range(0, RESAMPLES, block):
        size = min(block, RESAMPLES - start)
        drawn = rng.integers(0, number, (size, number)) + number * np.arange(size)[:, None]
        weights = np.bincount(drawn.ravel(), minlength=size * number).reshape(size, number)
        means.append(weights @ terms / number)
    return np.concatenate(means)


def _ratios(means: np.ndarray) -> np.ndarray:
    """Indices (resamples, 2 inputs) from the means of the terms."""
    variance = means[:, -1] - means[:, -2] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance[:, None] > 0.0, means[:, :-2] / variance[:, None], np.nan)
