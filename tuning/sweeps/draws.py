"""Scenarios by index: draw i is a function of the seed and of i alone.

Whatever the chunks, the devices, the number of scenarios or the interruptions, scenario i is the same, its
sensors' noise included.

- `random`: independent draws, from counter-based generators (`jaxhil.mechanism.uncertainty.draw`).
- `sobol`: R = `REPLICATES` scrambled Sobol sequences, each scrambled by itself; scenario i is point i // R of
  sequence i % R. The means of the R sequences are independent and alike, so that an interval can be stated
  (Owen, "Monte Carlo theory, methods and examples", ch. 17: randomised quasi-Monte Carlo).
"""

from functools import lru_cache
from typing import Any

import numpy as np

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.uncertainty import at_points, dimensions, draw
from jaxhil.rig_models import rig_model

REPLICATES = 16
BITS = 30  # of a Sobol point's coordinate


def drawn_scenarios(
    mechanism: AnyMechanism, sampling: str, seed: int, first: int, number: int
) -> tuple[dict[str, np.ndarray], Any]:
    """Draws and scenarios number `first` to `first + number - 1`; draws by dotted path, as of `draw`."""
    if sampling == "random":
        draws = draw(mechanism, number, seed, first)
    else:
        draws = at_points(mechanism, sobol_points(sum(dimensions(mechanism).values()), seed, first, number))
    return draws, rig_model(mechanism).scenarios(mechanism, draws, seed, first)


def sobol_points(dimension: int, seed: int, first: int, number: int) -> np.ndarray:
    """Points `first` to `first + number - 1` of the interleaved sequences, (number, dimension), within 0..1.

    No coordinate is 0 or 1: each is the middle of its cell of width 2**-30.
    """
    points = np.empty((number, dimension))
    for replicate in range(REPLICATES):
        place = (replicate - first) % REPLICATES
        if place < number:
            rows = len(range(place, number, REPLICATES))
            begin = (first + place) // REPLICATES
            points[place::REPLICATES] = _sequence(dimension, seed, replicate).rows(begin, rows)
    return points


class _Sequence:
    """One scrambled Sobol sequence, read anywhere; on from where it stands costs nothing more."""

    def __init__(self, dimension: int, seed: int, replicate: int):
        # Takes most of a second to import.
        from scipy.stats import qmc

        generator = np.random.default_rng([seed, replicate])
        self._engine = qmc.Sobol(dimension, scramble=True, bits=BITS, rng=generator)

    def rows(self, begin: int, number: int) -> np.ndarray:
        if begin < self._engine.num_generated:
            self._engine.reset()
        if begin > self._engine.num_generated:
            self._engine.fast_forward(begin - self._engine.num_generated)
        # A few points of a sequence have no balance to lose; all of them together have it.
        return _quiet_random(self._engine, number) + 2.0 ** -(BITS + 1)


def _quiet_random(engine, number: int) -> np.ndarray:
    if number == 0:
        return np.empty((0, engine.d))
    if engine.num_generated:
        return engine.random(number)
    # SciPy warns of a first batch that is no power of two.
    head = engine.random(1)
    return np.concatenate([head, engine.random(number - 1)]) if number > 1 else head


@lru_cache(maxsize=4 * REPLICATES)
def _sequence(dimension: int, seed: int, replicate: int) -> _Sequence:
    return _Sequence(dimension, seed, replicate)
