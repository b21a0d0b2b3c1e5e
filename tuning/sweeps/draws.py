"""Draws of a sweep's scenarios. Scenario i and its sensor noise depend only on the seed and on i.

- `random` sampling draws independent scenarios (`jaxhil.mechanism.uncertainty.draw`).
- `sobol` sampling uses R = `SOBOL_REPLICATES` independently scrambled Sobol sequences. Scenario i is point
  i // R of sequence i % R. The means of the R sequences are independent and identically distributed, which
  yields a confidence interval (Owen, "Monte Carlo theory, methods and examples", ch. 17: randomised
  quasi-Monte Carlo).
"""

from functools import lru_cache
from typing import Any

import numpy as np

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.uncertainty import count_dimensions, draw, draw_at_points
from jaxhil.rig_models import choose_rig_model

SOBOL_REPLICATES = 16
SOBOL_BITS = 30  # number of bits of a coordinate of a Sobol point


def draw_scenarios(
    mechanism: AnyMechanism, sampling: str, seed: int, first: int, number: int
) -> tuple[dict[str, np.ndarray], Any]:
    """Draw scenarios `first` to `first + number - 1`; return the drawn values by key, and the scenarios."""
    draws = draw_values(mechanism, sampling, seed, first, number)
    return draws, choose_rig_model(mechanism).scenarios(mechanism, draws, seed, first)


def draw_values(
    mechanism: AnyMechanism, sampling: str, seed: int, first: int, number: int
) -> dict[str, np.ndarray]:
    """Draw the values of scenarios `first` to `first + number - 1`, and return them by key."""
    if sampling == "random":
        return draw(mechanism, number, seed, first)
    dimensions = sum(count_dimensions(mechanism).values())
    return draw_at_points(mechanism, draw_sobol_points(dimensions, seed, first, number))


def draw_sobol_points(dimension: int, seed: int, first: int, number: int) -> np.ndarray:
    """Return points `first` to `first + number - 1`, (number, dimension), from Sobol sequences in turn.

    Point i comes from sequence number i modulo `SOBOL_REPLICATES`. Each coordinate is the centre of a cell of
    width 2**-30, so that it is above 0 and below 1.
    """
    points = np.empty((number, dimension))
    for replicate in range(SOBOL_REPLICATES):
        offset = (replicate - first) % SOBOL_REPLICATES
        if offset < number:
            rows = len(range(offset, number, SOBOL_REPLICATES))
            begin = (first + offset) // SOBOL_REPLICATES
            points[offset::SOBOL_REPLICATES] = _get_sequence(dimension, seed, replicate).rows(begin, rows)
    return points


class _SobolSequence:
    """Scrambled Sobol sequence with access to any point; sequential access is fastest."""

    def __init__(self, dimension: int, seed: int, replicate: int):
        # This import takes almost a second, so that it is deferred until it is needed.
        from scipy.stats import qmc

        generator = np.random.default_rng([seed, replicate])
        self._engine = qmc.Sobol(dimension, scramble=True, bits=SOBOL_BITS, rng=generator)

    def rows(self, begin: int, number: int) -> np.ndarray:
        """Return points `begin` to `begin + number - 1` of the sequence, (number, dimension)."""
        if begin < self._engine.num_generated:
            self._engine.reset()
        if begin > self._engine.num_generated:
            self._engine.fast_forward(begin - self._engine.num_generated)
        return _draw_without_warning(self._engine, number) + 2.0 ** -(SOBOL_BITS + 1)


def _draw_without_warning(engine, number: int) -> np.ndarray:
    """Return the next points, without SciPy's warning that their number is not a power of two."""
    if number == 0:
        return np.empty((0, engine.d))
    if engine.num_generated:
        return engine.random(number)
    head = engine.random(1)
    return np.concatenate([head, engine.random(number - 1)]) if number > 1 else head


@lru_cache(maxsize=4 * SOBOL_REPLICATES)
def _get_sequence(dimension: int, seed: int, replicate: int) -> _SobolSequence:
    return _SobolSequence(dimension, seed, replicate)
