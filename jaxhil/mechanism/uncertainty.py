"""Random values of a mechanism's uncertain numbers, from its ``[uncertainty]`` table.

Each number has a distribution around or beside its nominal value m:

- ``uniform``, ``loguniform``: between ``low`` and ``high``, or ``factor[0] m`` and ``factor[1] m``;
- ``normal``: mean m and standard deviation ``std`` of the underlying normal distribution, truncated
  to the values allowed for that key.

On a list one draw scales all of it: by the factor drawn, or, for values in the number's own unit,
by the draw for the first entry over that entry (when all entries are equal the draw is their
common value). With ``independent = true`` every entry has a draw of its own. The phase of each
contact within a control period is drawn as well, each contact its own, uniform on 0..1 unless the
table says otherwise: the phase alone moves the restitution, and nobody controls it. In six axes it is that
of the first touch, and there is none where the start is stated.

Draw number i depends on the seed, on i, on its own entry of the table, and on the keys that ``[correlation]``
names before it (`jaxhil.mechanism.correlation`): neither on how many draws are made at once, nor on the other
uncertain numbers, nor (for phases) on the number of contacts. Needs NumPy and SciPy, not jax.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxhil.mechanism.correlation import correlated
from jaxhil.mechanism.six_axes import SixAxisMechanism, numeric_keys_of
from jaxhil.mechanism.structs import Mechanism, Range, Uncertainty, numeric_keys, value_at

__all__ = ["PHASE", "at_points", "dimensions", "draw", "extremes", "quantiles", "quasi_random"]

AnyMechanism = Mechanism | SixAxisMechanism

PHASE = "approach.phase"
BLOCK = 1024

_TINY = 2.0**-54
_LARGEST = 1.0 - 2.0**-53  # of a generator's uniform numbers
_UNIFORM_PHASE = Uncertainty(distribution="uniform", low=0.0, high=1.0)


def draw(mechanism: AnyMechanism, number: int, seed: int, first: int = 0) -> dict[str, np.ndarray]:
    """Draws `first` to `first + number - 1` of every uncertain number of a valid mechanism.

    Returns by dotted path an array of shape ``(number,)`` for a number, ``(number, *entries)`` for
    a list, and on one axis ``(number, contacts)`` for ``approach.phase``, which is always there; units of
    the key. Uniform numbers come from a Philox generator per key and block of 1024 draws, and go
    through the inverse of the distribution function. Raises ValueError for a negative argument.
    """
    if number < 0 or seed < 0 or first < 0:
        raise ValueError(f"number, seed, first: found {number}, {seed}, {first}, allowed >= 0")
    columns = dimensions(mechanism)
    uniform = {path: _uniform(path, count, number, seed, first) for path, count in columns.items()}
    return _values(mechanism, correlated(mechanism, uniform))


def quasi_random(mechanism: AnyMechanism, number: int, seed: int) -> dict[str, np.ndarray]:
    """Like `draw`, with the uniform numbers of a scrambled Sobol sequence, one point per draw.

    The points fill the box of all uncertain numbers more evenly than random ones; best for a power
    of two. Sobol 1967, scrambled as in `scipy.stats.qmc.Sobol`. Raises ValueError for a negative
    argument, or when all uncertain entries together are more than 21201.
    """
    # Takes most of a second to import, and only this function needs it.
    from scipy.stats import qmc

    if number < 0 or seed < 0:
        raise ValueError(f"number, seed: found {number}, {seed}, allowed integers >= 0")
    columns = dimensions(mechanism)
    sequence = qmc.Sobol(sum(columns.values()), scramble=True, rng=np.random.default_rng(seed))
    points = sequence.random_base2(max(0, math.ceil(math.log2(max(number, 1)))))[:number]
    return at_points(mechanism, points)


def at_points(mechanism: AnyMechanism, points: np.ndarray) -> dict[str, np.ndarray]:
    """The draws that belong to points of the unit box, (number, sum of `dimensions`), as `draw` returns them.

    Coordinates that vary together are made to, and each goes through the inverse of its distribution
    function; 0 stands for the least draw.
    """
    return _values(mechanism, correlated(mechanism, _by_key(mechanism, points)))


def quantiles(mechanism: AnyMechanism, points: np.ndarray) -> dict[str, np.ndarray]:
    """Like `at_points`, each key by itself: its quantile at its coordinates, whatever it varies with."""
    return _values(mechanism, _by_key(mechanism, points))


def extremes(mechanism: AnyMechanism) -> dict[str, np.ndarray]:
    """Every uncertain number at one end of what can be drawn, then at the other, whatever it varies with."""
    ends = np.array([[0.0], [_LARGEST]])
    return quantiles(mechanism, np.repeat(ends, sum(dimensions(mechanism).values()), axis=1))


def dimensions(mechanism: AnyMechanism) -> dict[str, int]:
    """How many uniform numbers each key takes: sorted by path, the phases last."""
    columns = {}
    for path in sorted(set(mechanism.uncertainty) - {PHASE}):
        independent = mechanism.uncertainty[path].independent
        columns[path] = np.size(value_at(mechanism, path)) if independent else 1
    if isinstance(mechanism, Mechanism):
        columns[PHASE] = mechanism.approach.contacts
    elif mechanism.approach is not None:
        columns[PHASE] = 1
    return columns


def _by_key(mechanism: AnyMechanism, points: np.ndarray) -> dict[str, np.ndarray]:
    columns = dimensions(mechanism)
    edges = np.cumsum(list(columns.values()))[:-1]
    return dict(zip(columns, np.split(points, edges, axis=1), strict=True))


def _uniform(path: str, count: int, number: int, seed: int, first: int) -> np.ndarray:
    """Uniform numbers, shape (number, count), rows `first` on of an endless table of this path."""
    start = first // BLOCK
    blocks = [np.empty((0, count))]
    philox = np.random.Philox(key=0)
    fresh: Any = philox.state
    for block in range(start, math.ceil((first + number) / BLOCK)):
        digest = hashlib.sha256(f"{seed} {block} {path}".encode()).digest()
        # As a new generator with this key, which would ask the system for a seed first.
        fresh["state"]["key"] = np.frombuffer(digest[:16], "<u8")
        philox.state = fresh
        # Column by column, so that further columns leave the first ones as they are.
        blocks.append(np.random.Generator(philox).random((count, BLOCK)).T)
    skipped = first - start * BLOCK
    return np.concatenate(blocks)[skipped : skipped + number]


def _values(mechanism: AnyMechanism, uniform: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    one_axis = isinstance(mechanism, Mechanism)
    ranges = numeric_keys() if one_axis else numeric_keys_of(mechanism)
    return {
        path: _key_values(
            np.asarray(value_at(mechanism, path), dtype=float),
            mechanism.uncertainty.get(path, _UNIFORM_PHASE),
            ranges[path],
            numbers,
            one_axis and path == PHASE,
        )
        for path, numbers in uniform.items()
    }


def _key_values(
    nominal: np.ndarray,
    uncertainty: Uncertainty,
    allowed: Range,
    uniform: np.ndarray,
    per_contact: bool,
) -> np.ndarray:
    """The values of one key from its uniform numbers, shape (number, columns)."""
    number = uniform.shape[0]
    # Zero would be outside an open range.
    uniform = np.maximum(uniform, _TINY)
    if per_contact:
        return _quantile(uncertainty, nominal, allowed)(uniform)
    if uncertainty.independent:
        values = _quantile(uncertainty, nominal.ravel(), allowed)(uniform)
        return values.reshape(number, *nominal.shape)
    if nominal.ndim == 0:
        return _quantile(uncertainty, nominal, allowed)(uniform[:, 0])
    first = nominal.flat[0]
    column = uniform.reshape(number, *[1] * nominal.ndim)
    if uncertainty.factor is not None:
        return nominal * _quantile(uncertainty, np.ones(()), allowed)(column)
    value = _quantile(uncertainty, np.asarray(first), allowed)(column)
    if np.all(nominal == first):
        return np.broadcast_to(value, (number, *nominal.shape)).copy()
    return nominal * (value / first)


def _quantile(
    uncertainty: Uncertainty, nominal: np.ndarray, allowed: Range
) -> Callable[[np.ndarray], np.ndarray]:
    """The inverse distribution function, of uniform numbers that broadcast against `nominal`."""
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
    """Quantile mean + std Phi^-1(Phi(a) + u (Phi(b) - Phi(a))), a and b the standardised ends.

    Accurate since the mean is an allowed value, so that neither end is far in the other's tail.
    """
    from scipy import special  # takes long to import, and most files need none

    with np.errstate(over="ignore"):
        below = special.ndtr((allowed.low - mean) / std)
        above = special.ndtr((allowed.high - mean) / std)
    least = math.nextafter(allowed.low, math.inf) if allowed.low_open else allowed.low
    greatest = math.nextafter(allowed.high, -math.inf) if allowed.high_open else allowed.high
    # A key that may be infinite still has no infinite draws.
    greatest = min(greatest, float(np.finfo(float).max))

    def quantile(uniform: np.ndarray) -> np.ndarray:
        probability = np.clip(below + uniform * (above - below), _TINY, 1.0 - 2.0 * _TINY)
        with np.errstate(over="ignore"):
            return np.clip(mean + std * special.ndtri(probability), least, greatest)

    return quantile
