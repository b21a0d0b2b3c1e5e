"""Detection of the onset of contact by a cumulative sum (CUSUM) of force readings.

    S = max(0, S + (y - bias)/sigma - DRIFT),    contact is detected if S > LEVEL

y is the force reading, positive if the surface pushes. The readings of this run with S = 0 in front of the
specified surface give the bias and the standard deviation sigma. The contact begins after the last reading
with S = 0.

The force of a soft contact can stay below DRIFT sigma for seconds. Therefore, behind the specified surface, a
second sum S' has the smaller drift EARLY_DRIFT. If S' > LEVEL at the last reading with S = 0, the contact
begins after the last reading with S' = 0.

Source: Page, "Continuous inspection schemes", Biometrika 41 (1954).
"""

from math import sqrt

DRIFT = 2.0  # excess over the bias [standard deviations] from which a reading increases S
EARLY_DRIFT = 1.0  # the same excess for S' [standard deviations]
LEVEL = 8.0  # level of S at which contact is detected [standard deviations]
SETTLING = 0.004  # time without detection after the start of a run [s]
MAX_MEAN = 2000.0  # limit on the memory of the bias [readings], because the bias may drift slowly
MIN_FLIGHT_READINGS = 9.0  # readings in free flight; with fewer, sigma is the specified noise


class OnsetDetector:
    """Detector of the onset of contact by a cumulative sum of force readings.

    Attributes:
        bias: bias of the force sensor, the mean of the readings in free flight [N].
        total: cumulative sum S [1]; 0 in free flight.
        early: cumulative sum S' [1]; 0 in front of the specified surface.
        missed: sum of the readings without bias since the last reading with S' = 0 [N].
    """

    __slots__ = ("_before", "_count", "_noise_variance", "_square", "bias", "early", "missed", "total")

    def __init__(self, noise: float) -> None:
        self._noise_variance = noise * noise
        self.restart()

    def restart(self) -> None:
        """Begin a run: forget the estimates of bias and noise, but keep the specified noise."""
        self._count = 0.0
        self._square = 0.0
        self._before = 0.0
        self.bias = 0.0
        self.total = 0.0
        self.early = 0.0
        self.missed = 0.0

    @property
    def variance(self) -> float:
        """Return the noise variance of a force reading [N^2]: the larger of specified and measured value."""
        measured = self._square if self._count > MIN_FLIGHT_READINGS else 0.0
        return max(self._noise_variance, measured)

    def update(self, force: float, side: float, floor: float, settled: bool, inside: bool) -> None:
        """Update the cumulative sums with one force reading [N].

        Args:
            force: force reading [N].
            side: sign of a force with which the surface pushes, 1 or -1.
            floor: force that is added to the standard deviation of the noise [N].
            settled: whether a contact may be detected; otherwise the sums are set to 0.
            inside: whether the hardware is behind the specified surface.
        """
        push = side * (force - self.bias)
        deviation = push / (sqrt(self.variance) + floor)
        self.total = max(0.0, self.total + deviation - DRIFT) if settled else 0.0
        self.early = max(0.0, self.early + deviation - EARLY_DRIFT) if settled and inside else 0.0
        self.missed = self.missed + push if self.early > 0.0 else 0.0

    def learn(self, force: float) -> None:
        """Update the estimates of bias and noise with one force reading [N] of free flight."""
        if self._count > 0.0:
            step = force - self._before
            self._square += (0.5 * (step * step) - self._square) / self._count
        self._before = force
        self._count += 1.0
        self.bias += (force - self.bias) / min(self._count, MAX_MEAN)
