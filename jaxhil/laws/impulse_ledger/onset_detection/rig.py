"""Onset detection by a cumulative sum of force readings, with bias and noise of the sensor in free flight.

    S = max(0, S + (y - bias)/sigma - DRIFT),    contact is detected at S > LEVEL

y is the force in the direction in which the surface pushes. Its bias and standard deviation sigma are those
of the readings of this run with S = 0. Contact begins after the last reading with S = 0 before the detection.

Source: Page, "Continuous inspection schemes", Biometrika 41 (1954).
"""

from math import sqrt

DRIFT = 2.0  # standard deviations; a reading increases S if it exceeds the bias by more
LEVEL = 8.0  # sum at which contact is detected
SETTLING = 0.004  # s; until then after the start of a run, readings only serve the bias
LONGEST_MEAN = 2000.0  # readings; longest time scale of the mean of the bias
FEW = 9.0  # readings; with more, their differences show the noise


class OnsetDetector:
    """Detector of the onset of contact.

    Attributes:
        bias: mean of the readings in free flight [N].
        total: the cumulative sum S; 0 in free flight.
    """

    __slots__ = ("_before", "_count", "_known", "_square", "bias", "total")

    def __init__(self, noise: float) -> None:
        self._known = noise * noise
        self.restart()

    def restart(self) -> None:
        """Begin a run: forget the readings of bias and noise; keep the specified noise."""
        self._count = 0.0
        self._square = 0.0
        self._before = 0.0
        self.bias = 0.0
        self.total = 0.0

    @property
    def variance(self) -> float:
        """Return the variance of a force reading [N^2]: as specified, or larger as seen in free flight."""
        return max(self._known, self._square) if self._count > FEW else self._known

    def watch(self, force: float, side: float, floor: float, settled: bool) -> None:
        """Add one reading of the force [N] to the cumulative sum, or set it to 0 unless `settled`.

        `side` is the sign of a pushing force; `floor` [N] is added to the noise's standard deviation.
        """
        if not settled:
            self.total = 0.0
            return
        total = self.total + side * (force - self.bias) / (sqrt(self.variance) + floor) - DRIFT
        self.total = total if total > 0.0 else 0.0

    def learn(self, force: float) -> None:
        """Update bias and noise with one reading [N] of free flight."""
        if self._count > 0.0:
            step = force - self._before
            self._square += (0.5 * (step * step) - self._square) / self._count
        self._before = force
        self._count += 1.0
        self.bias += (force - self.bias) / min(self._count, LONGEST_MEAN)
