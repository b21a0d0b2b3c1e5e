"""Whether the force rises at the onset as a damper's jump that the sensor smooths.

A damped contact's force is B + K s since the onset, s ago; through a sensor that lags by l it is read as
I (1 - exp(-s/l)) + K s, with I = B - K l. The onset may lie at several places p around where the surface was
met. Of each lag and place I ~ N(0, s_I^2) and K ~ N(K_0, s_K^2), and the likelihood of the readings on the
way in has a closed form in five sums over them. Without a lag I may have either sign, as where contact begins
softly; only a jump, I > 0, speaks for a lag. The odds for one are those of the sum over the places, and of
the contacts before. Where I is next to nothing nobody can tell: the force of a damper B = K l is read as that
of contact without one. In NumPy, all lags and places at a time.
"""

import numpy as np

from .onset import SQUARINGS, STIFFNESS, STIFFNESS_VARIANCE, exponential

LAGS = (0.0, 0.001, 0.003)  # s
PLACES = 11
STEP = 0.0005  # s from place to place, at least a tick
FIRST = -6  # of the places, in steps
WAY = 0.012  # s of depth whose readings count
VARIANCE = 4.0  # s_I^2 [1/s^2]
LEAST_LIKELY = 1e-6  # of a likelihood: what one contact rules out, others may show
LIKELIER = 20.0  # than a sharp jump: then it counts as smoothed

_LAGS = np.repeat(np.array(LAGS)[:, None], PLACES, axis=1)
_STEPS = np.repeat(FIRST + np.arange(PLACES, dtype=float)[None], len(LAGS), axis=0)
_UNLAGGED = _LAGS == 0.0


class SmoothedJump:
    """What the readings on the way in tell of a lag, contact after contact."""

    __slots__ = (
        "_carried", "_force", "_jumps", "_lag", "_likelihood", "_mixed", "_moment", "_over", "_place",
        "_squares", "odds",
    )  # fmt: skip

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all contacts."""
        self._likelihood = np.ones(len(LAGS))
        self._carried = np.ones(len(LAGS))
        self._over = True
        self.odds = 0.0  # for a lag

    def begin(self, tick: float, pace: float) -> None:
        """Another contact, with a tick [s] of its own scale of time, slower by `pace`."""
        least = STEP * pace
        self._lag = np.where(_UNLAGGED, 1.0, _LAGS * pace)
        self._place = _STEPS * (tick if tick > least else least)
        zeros = np.zeros_like(_LAGS)
        # Sums over the readings beyond each place: of g^2, g s, s^2, g y, s y, with g = 1 - exp(-s/l).
        self._jumps = zeros + 1.0 / VARIANCE
        self._mixed = zeros
        self._squares = zeros + 1.0 / STIFFNESS_VARIANCE
        self._force = zeros
        self._moment = zeros + STIFFNESS / STIFFNESS_VARIANCE
        carried = self._carried * self._likelihood
        share = carried / np.fmax.reduce(carried, initial=0.0)
        self._carried = np.where(share > LEAST_LIKELY, share, LEAST_LIKELY)
        self._likelihood = np.ones(len(LAGS))
        self._over = False

    def take(self, depth: float, rate: float, force: float, variance: float) -> None:
        """A reading: depth [s], speed, force [1/s], its variance [1/s^2]."""
        self._over = self._over or not rate > 0.0 or depth > WAY
        if self._over:
            return
        s = depth - self._place
        beyond = s > 0.0
        s = np.where(beyond, s, 0.0)
        g = np.where(_UNLAGGED, beyond, 1.0 - exponential(s / self._lag, SQUARINGS))
        weighted = g / variance
        weight = s / variance
        self._jumps = self._jumps + weighted * g
        self._mixed = self._mixed + weighted * s
        self._squares = self._squares + weight * s
        # No force may be none of a number.
        self._force = self._force + np.where(beyond, weighted * force, 0.0)
        self._moment = self._moment + np.where(beyond, weight * force, 0.0)
        self._weigh()

    @property
    def smoothed(self) -> bool:
        """Whether the odds say so."""
        return self.odds > LIKELIER

    def _weigh(self) -> None:
        """The likelihood of each lag by all readings so far, and the odds."""
        a, b, c, y, z = self._jumps, self._mixed, self._squares, self._force, self._moment
        determinant = a * c - b * b
        explained = 0.5 * ((c * y * y - 2.0 * (b * y * z) + a * z * z) / determinant)
        possible = _UNLAGGED | (c * y - b * z > 0.0)
        most = np.fmax.reduce(np.where(possible, explained, -np.inf), axis=None)
        likely = exponential(most - explained, SQUARINGS) / np.sqrt(determinant)
        total = np.add.accumulate(np.where(possible, likely, 0.0), axis=1)[:, -1]
        self._likelihood = total
        weights = total * self._carried
        self.odds = float(np.add.accumulate(weights[1:])[-1] / ((len(LAGS) - 1) * weights[0]))
