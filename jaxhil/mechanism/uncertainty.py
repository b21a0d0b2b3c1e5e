"""Random draws of the uncertain numbers of a mechanism, from the table ``[uncertainty]``.

The distribution of a number with the nominal value m is:

- ``uniform``, ``loguniform``: between ``low`` and ``high``, or ``factor[0] m`` and ``factor[1] m``;
- ``normal``: a normal distribution with mean m and standard deviation ``std``, truncated to the values that
  are allowed for the key.

If the number is a list, one draw scales all entries: by the drawn factor (``factor``), or by the ratio of the
drawn value to the first entry. If all entries are equal, all become the drawn value. With ``independent =
true`` every entry has its own draw. Each contact also begins at a random phase of a control period, because
the phase changes the restitution and cannot be controlled. Unless the table specifies otherwise, the phase is
uniform from 0 to 1. With six axes, only the phase of the first touch is drawn, and no phase if the file has a
``[start]``.

Draw i of a key depends on the seed, on i, on the key's entry in the table, and on the earlier keys in
``[correlation]`` (`jaxhil.mechanism.correlation`). The draw does not depend on the number of draws made at
once, on other uncertain keys or, for phases, on the number of contacts.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxhil.mechanism.correlation import correlate
from jaxhil.mechanism.number_ranges import Range, value_at
from jaxhil.mechanism.six_axes import AnyMechanism, numeric_keys_of
from jaxhil.mechanism.structs import Mechanism, Uncertainty

__all__ = [
    "PHASE_KEY",
    "compute_quantiles",
    "count_dimensions",
    "draw",
    "draw_at_points",
    "draw_extremes",
    "draw_quasi_random",
]

PHASE_KEY = "approach.phase"
DRAWS_PER_GENERATOR = 1024

_MIN_UNIFORM = 2.0**-54  # smaller uniform numbers are replaced by this
_MAX_UNIFORM = 1.0 - 2.0**-53  # largest uniform number of a generator
_UNIFORM_PHASE = Uncertainty(distribution="uniform", low=0.0, high=1.0)


def draw(mechanism: AnyMechanism, number: int, seed: int, first: int = 0) -> dict[str, np.ndarray]:
    """Return `number` random draws of every uncertain key, beginning with the draw of index `first`.

    The result contains an array for each key by its dotted path, in the unit of the key. Its shape is
    (number,) for a scalar, and (number, *entries) for a list. With one axis, ``approach.phase`` is (number,
    contacts). Each key has its own Philox generator for every 1024 draws. The quantile function of the key's
    distribution converts the generator's uniform numbers. Raise ValueError for a negative argument.
    """
    if number < 0 or seed < 0 or first < 0:
        raise ValueError(f"number, seed, first: found {number}, {seed}, {first}, expected integers >= 0")
    columns = count_dimensions(mechanism)
    uniform = {path: _draw_uniform(path, count, number, seed, first) for path, count in columns.items()}
    return _compute_values(mechanism, correlate(mechanism, uniform))


def draw_quasi_random(mechanism: AnyMechanism, number: int, seed: int) -> dict[str, np.ndarray]:
    """Return draws of every uncertain key from a scrambled Sobol sequence, in the format of `draw`.

    The draws cover the ranges of all uncertain numbers more evenly than random draws, most evenly if `number`
    is a power of two (Sobol 1967; scrambled as in `scipy.stats.qmc.Sobol`). Raise ValueError for a negative
    argument, or for more than 21201 uncertain entries.
    """
    # The import takes most of a second, and only this function needs SciPy's generator.
    from scipy.stats import qmc

    if number < 0 or seed < 0:
        raise ValueError(f"number, seed: found {number}, {seed}, expected integers >= 0")
    columns = count_dimensions(mechanism)
    sequence = qmc.Sobol(sum(columns.values()), scramble=True, rng=np.random.default_rng(seed))
    points = sequence.random_base2(max(0, math.ceil(math.log2(max(number, 1)))))[:number]
    return draw_at_points(mechanism, points)


def draw_at_points(mechanism: AnyMechanism, points: np.ndarray) -> dict[str, np.ndarray]:
    """Return the draws, as `draw` does, for points (number, dimensions) with coordinates from 0 to 1.

    `count_dimensions` returns the number of columns of each key. The table ``[correlation]`` correlates
    the coordinates. The quantile function of each key then converts them to values.
    """
    return _compute_values(mechanism, correlate(mechanism, _split_by_key(mechanism, points)))


def compute_quantiles(mechanism: AnyMechanism, points: np.ndarray) -> dict[str, np.ndarray]:
    """Return each key's quantiles at the probabilities `points` (number, dimensions), without correlation."""
    return _compute_values(mechanism, _split_by_key(mechanism, points))


def draw_extremes(mechanism: AnyMechanism) -> dict[str, np.ndarray]:
    """Return the smallest and the largest draw of every uncertain key, an array (2, ...) for each key."""
    ends = np.array([[0.0], [_MAX_UNIFORM]])
    return compute_quantiles(mechanism, np.repeat(ends, sum(count_dimensions(mechanism).values()), axis=1))


def count_dimensions(mechanism: AnyMechanism) -> dict[str, int]:
    """Return the number of random numbers that one draw of each key needs.

    The keys are sorted by path, with `approach.phase` last. `draw_at_points` needs columns in this order.
    """
    columns = {}
    for path in sorted(set(mechanism.uncertainty) - {PHASE_KEY}):
        independent = mechanism.uncertainty[path].independent
        columns[path] = np.size(value_at(mechanism, path)) if independent else 1
    if isinstance(mechanism, Mechanism):
        columns[PHASE_KEY] = mechanism.approach.contacts
    elif mechanism.approach is not None:
        columns[PHASE_KEY] = 1
    return columns


def _split_by_key(mechanism: AnyMechanism, points: np.ndarray) -> dict[str, np.ndarray]:
    """Split the columns of `points` (number, dimensions) into an array (number, columns) for each key."""
    columns = count_dimensions(mechanism)
    bounds = np.cumsum(list(columns.values()))[:-1]
    return dict(zip(columns, np.split(points, bounds, axis=1), strict=True))


def _draw_uniform(path: str, count: int, number: int, seed: int, first: int) -> np.ndarray:
    """Return uniform random numbers (number, count) for the key at `path`; the first row is draw `first`."""
    start = first // DRAWS_PER_GENERATOR
    blocks = [np.empty((0, count))]
    philox = np.random.Philox(key=0)
    initial_state: Any = philox.state
    for block in range(start, math.ceil((first + number) / DRAWS_PER_GENERATOR)):
        digest = hashlib.sha256(f"{seed} {block} {path}".encode()).digest()
        # A new key for the same generator is faster than a new generator, which asks the system for a seed.
        initial_state["state"]["key"] = np.frombuffer(digest[:16], "<u8")
        philox.state = initial_state
        # The numbers fill the array column by column, so that the first columns do not depend on `count`.
        blocks.append(np.random.Generator(philox).random((count, DRAWS_PER_GENERATOR)).T)
    skipped = first - start * DRAWS_PER_GENERATOR
    return np.concatenate(blocks)[skipped : skipped + number]


def _compute_values(mechanism: AnyMechanism, uniform: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    has_one_axis = isinstance(mechanism, Mechanism)
    ranges = numeric_keys_of(mechanism)
    return {
        path: _compute_key_values(
            np.asarray(value_at(mechanism, path), dtype=float),
            mechanism.uncertainty.get(path, _UNIFORM_PHASE),
            ranges[path],
            numbers,
            has_one_axis and path == PHASE_KEY,
        )
        for path, numbers in uniform.items()
    }


def _compute_key_values(
    nominal: np.ndarray,
    uncertainty: Uncertainty,
    allowed: Range,
    uniform: np.ndarray,
    per_contact: bool,
) -> np.ndarray:
    """Convert the uniform random numbers (draws, columns) of one key to the key's value in each draw."""
    number = uniform.shape[0]
    # The quantile at 0 is the lower bound, which an open range excludes.
    uniform = np.maximum(uniform, _MIN_UNIFORM)
    if per_contact:
        return _build_quantile_function(uncertainty, nominal, allowed)(uniform)
    if uncertainty.independent:
        values = _build_quantile_function(uncertainty, nominal.ravel(), allowed)(uniform)
        return values.reshape(number, *nominal.shape)
    if nominal.ndim == 0:
        return _build_quantile_function(uncertainty, nominal, allowed)(uniform[:, 0])
    first = nominal.flat[0]
    column = uniform.reshape(number, *[1] * nominal.ndim)
    if uncertainty.factor is not None:
        return nominal * _build_quantile_function(uncertainty, np.ones(()), allowed)(column)
    value = _build_quantile_function(uncertainty, np.asarray(first), allowed)(column)
    if np.all(nominal == first):
        return np.broadcast_to(value, (number, *nominal.shape)).copy()
    return nominal * (value / first)


def _build_quantile_function(
    uncertainty: Uncertainty, nominal: np.ndarray, allowed: Range
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a distribution's quantile function, whose argument broadcasts against `nominal`."""
    if uncertainty.distribution == "normal":
        assert uncertainty.std is not None
        return _truncated_normal(nominal, uncertainty.std, allowed)
    if uncertainty.factor is not None:
        low, high = uncertainty.factor
        scale = nominal
    else:
        assert uncertainty.low is not None and uncertainty.high is not None
        low, high = uncertainty.low, uncertainty.high
        scale = np.ones_like(nominal)
    if uncertainty.distribution == "uniform":
        return lambda u: scale * (low * (1.0 - u) + high * u)
    return lambda u: scale * np.clip(np.exp((1.0 - u) * math.log(low) + u * math.log(high)), low, high)


def _truncated_normal(mean: np.ndarray, std: float, allowed: Range) -> Callable[[np.ndarray], np.ndarray]:
    """Return the quantile function of a normal distribution that is truncated to the `allowed` values.

    The quantile at u is mean + std Phi^-1(Phi(a) + u (Phi(b) - Phi(a))), where a and b are the standardised
    bounds, and Phi is the standard normal distribution function. The formula is accurate because the mean is
    an allowed value, so that a and b are not in the same tail.
    """
    from scipy import special  # takes long to import, and most files do not need SciPy

    with np.errstate(over="ignore"):
        below = special.ndtr((allowed.low - mean) / std)
        above = special.ndtr((allowed.high - mean) / std)
    least = math.nextafter(allowed.low, math.inf) if allowed.low_open else allowed.low
    greatest = math.nextafter(allowed.high, -math.inf) if allowed.high_open else allowed.high
    # Draws are finite even if the key may be infinite.
    greatest = min(greatest, float(np.finfo(float).max))

    def quantile(uniform: np.ndarray) -> np.ndarray:
        probability = np.clip(below + uniform * (above - below), _MIN_UNIFORM, 1.0 - 2.0 * _MIN_UNIFORM)
        with np.errstate(over="ignore"):
            return np.clip(mean + std * special.ndtri(probability), least, greatest)

    return quantile
