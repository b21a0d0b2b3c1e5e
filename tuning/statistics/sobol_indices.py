"""First-order and total Sobol indices, with intervals.

For a function y = f(x_1, x_2, ...) of independent inputs x_i, the indices are

    S_i = Var(E[y | x_i]) / Var(y),        T_i = E[Var(y | all but x_i)] / Var(y).

The first-order index S_i is the fraction of the variance of y that x_i alone explains. The total index T_i is
the fraction that remains if all inputs but x_i are known; it includes the interactions of x_i with other
inputs. If T_i is near 0, x_i has no influence. If the sum of all S_i is near 1, the inputs do not interact.

The design consists of two independent sets of scenarios A and B, and of a set AB_i for each input. AB_i
equals A, except that input i has its values from B (Saltelli, Annoni, Azzini, Campolongo, Ratto, Tarantola
2010, "Variance based sensitivity analysis of model output"). `saltelli_design` returns uniform random
numbers, which the quantile functions of the inputs convert to scenarios. `sobol_indices` computes the indices
from the results of the scenarios. An input can have several columns: for example, a parameter that is drawn
independently for each contact is one input with one column per contact.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from tuning.statistics.intervals import CONFIDENCE_LEVEL, IntervalEstimate

SOBOL_RESAMPLES = 1000  # number of bootstrap resamples
_MAX_NUMBERS_IN_MEMORY = 2**22  # largest number of random numbers that are drawn together


class SobolIndices(NamedTuple):
    """Sobol indices of all inputs, with their intervals."""

    first_order: IntervalEstimate  # fraction of the variance that each input alone explains [1], (inputs,)
    total: IntervalEstimate  # fraction of the variance that each input with its interactions explains [1]


def count_evaluations(inputs: int | Sequence[int], number: int) -> int:
    """Return the number of scenarios in the design: `number` times (number of inputs + 2)."""
    return number * (len(_count_columns(inputs)) + 2)


def saltelli_design(inputs: int | Sequence[int], number: int, seed: int) -> np.ndarray:
    """Generate the design of the scenarios for Sobol indices: uniform random numbers from 0 to below 1.

    The rows are the sets A, B, AB_1, AB_2, ... with `number` rows each. A and B are the two halves of the
    columns of a scrambled Sobol sequence.

    Args:
        inputs: number of inputs, or a list with the number of columns of each input.
        number: number of rows in each set, a power of two, at least 2.
        seed: seed of the scrambling, 0 or more.

    Returns:
        Random numbers, (number (inputs + 2), columns of all inputs).

    Raises:
        ValueError: If an argument is out of its range.
    """
    # Only this function needs the import, which takes most of a second.
    from scipy.stats import qmc

    columns = _count_columns(inputs)
    if seed < 0 or number < 2 or number & (number - 1):
        raise ValueError(
            f"number, seed: found {number}, {seed}, expected a power of two from 2, and seed >= 0"
        )
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
    """Compute first-order and total Sobol indices, with bootstrap percentile intervals.

    f_A, f_B and f_i are the results of the sets A, B and AB_i, minus the mean of A and B. With the variance V
    of f_A and f_B, the indices are

        S_i = mean(f_B (f_i - f_A)) / V          (Saltelli et al. 2010, table 2 b)
        T_i = mean((f_A - f_i)^2) / (2 V)        (Jansen 1999; Saltelli et al. 2010, table 2 f)

    as in `scipy.stats.sobol_indices`. Estimates are not clipped, so that they may be below 0. The bootstrap
    resamples the same rows of A, B and all AB_i (Archer, Saltelli, Sobol 1997), and assumes that the rows are
    independent. The rows of a Sobol sequence are more even, so that the intervals are conservative. An input
    that changes no result has the total index 0 and an interval of width 0. If the results are only 0 or 1,
    with rare failures, more scenarios may still show an effect of this input. If all results are equal, the
    indices are NaN and the intervals 0 to 1.

    Args:
        values: results of the scenarios in the order of `saltelli_design`, (number (inputs + 2),).
        inputs: number of inputs, or a list with the number of columns of each input.
        number: number of rows in each set of the design.
        seed: seed of the bootstrap.
        level: confidence level, between 0 and 1.
        cap: value that replaces larger results and results that are not finite; None to replace nothing.

    Raises:
        ValueError: If the number of results is wrong, if results are not finite and there is no cap, or if
            `cap` or `level` is out of its range.
    """
    count = len(_count_columns(inputs))
    values = np.asarray(values, float)
    if values.shape != (number * (count + 2),):
        raise ValueError(f"values: found shape {values.shape}, expected ({number * (count + 2)},)")
    if not 0.0 < level < 1.0:
        raise ValueError(f"level: found {level}, expected a number between 0 and 1")
    if cap is not None:
        if not np.isfinite(cap):
            raise ValueError(f"cap: found {cap}, expected a finite number")
        values = np.where(np.isfinite(values), np.minimum(values, cap), cap)
    elif not np.all(np.isfinite(values)):
        raise ValueError("values: found values that are not finite, expected finite values or a cap")
    rows = values.reshape(count + 2, number)
    if np.all(rows[:2] == rows[0, 0]):
        unknown = IntervalEstimate(np.full(count, np.nan), np.zeros(count), np.ones(count))
        return SobolIndices(unknown, unknown)
    # The scale cancels in the indices. With values of at most 1, squares cannot overflow.
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
        IntervalEstimate(estimate[:count], low[:count], high[:count]),
        IntervalEstimate(estimate[count:], low[count:], high[count:]),
    )


def _count_columns(inputs: int | Sequence[int]) -> tuple[int, ...]:
    """Return the number of columns of each input; raise ValueError if an input has no column."""
    columns = (1,) * inputs if isinstance(inputs, int) else tuple(inputs)
    if not columns or min(columns) < 1:
        raise ValueError(f"inputs: found {inputs!r}, expected one or more inputs, each with a column or more")
    return columns


def _resample_means(terms: np.ndarray, seed: int) -> np.ndarray:
    """Return the means of the columns of `terms` in each bootstrap resample, (resamples, columns)."""
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
    """Return the Sobol indices, (resamples, 2 inputs): means of the numerators divided by the variance."""
    variance = means[:, -1] - means[:, -2] ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance[:, None] > 0.0, means[:, :-2] / variance[:, None], np.nan)
