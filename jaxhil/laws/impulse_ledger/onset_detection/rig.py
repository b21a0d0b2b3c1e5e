"""Onset of contact by a cumulative sum of force readings; bias and noise of the sensor in free flight.

    S = max(0, S + (y - bias)/sigma - DRIFT),    contact is detected at S > LEVEL

y is the force towards which the surface pushes. Its bias and standard deviation sigma are those of the
readings since the run began while S = 0. The last reading with S = 0 before a detection is the last one that
is taken to be free: contact begins after it.

Source: Page, "Continuous inspection schemes", Biometrika 41 (1954).
"""

from math import sqrt

DRIFT = 2.0  # standard deviations by which a reading must exceed the bias to count for contact
LEVEL = 8.0  # sum at which contact is detected
SETTLING = 0.004  # s; readings since a run began that only show the bias
LONGEST_MEAN = 2000.0  # readings over which the bias is averaged at most
FEW = 8.0  # differences of readings that show the noise


class OnsetDetector:
    """Detector of contact, with bias and noise of the force.

    Attributes:
        bias: mean of the readings in free flight [N].
        total: the cumulative sum S; 0 in free flight.
    """

    __slots__ = ("_before", "_count", "_differences", "_known", "_square", "bias", "total")

    def __init__(self, noise: float) -> None:
        self._known = noise * noise
        self._square = 0.0
        self.bias = 0.0
        self.restart()

    def restart(self) -> None:
        """Begin a run: average the bias anew; keep the noise."""
        self._count = 0.0
        self._differences = 0.0
        self._square = 0.0
        self._before = 0.0
        self.bias = 0.0
        self.total = 0.0

    @property
    def variance(self) -> float:
        """Variance of a force reading [N^2]: as specified, or as shown by readings in free flight."""
        variance = max(self._known, self._square) if self._differences > FEW else self._known
        return variance if variance > 0.0 else 0.0

    def watch(self, force: float, side: float, floor: float, settled: bool) -> None:
        """Add one reading [N] to the cumulative sum; `side` is the sign of a pushing force, `floor` [N] is
        added to the noise's standard deviation."""
        if not settled:
            self.total = 0.0
            return
        total = self.total + side * (force - self.bias) / (sqrt(self.variance) + floor) - DRIFT
        self.total = total if total > 0.0 else 0.0

    def learn(self, force: float) -> None:
        """Average bias and noise over one more reading [N] of free flight."""
        if self._count > 0.0:
            self._differences += 1.0
            step = force - self._before
            self._square += (0.5 * (step * step) - self._square) / self._differences
        self._before = force
        self._count += 1.0
        self.bias += (force - self.bias) / (self._count if self._count < LONGEST_MEAN else LONGEST_MEAN)
