"""Timing effects of the simulated hardware: delays that vary from tick to tick, and lost readings.

The effects are those of `jaxhil.simulation.timing`, but with different random numbers.
"""

from random import Random

from jaxhil.contact.float_law import FloatLaw
from jaxhil.mechanism.structs import Mechanism
from tuning.rig.discretisation import DELAY_ROUNDING_TOLERANCE, evaluate_row, series_rows, split_delay
from tuning.rig.moving_average import average_rows

SEED_OFFSET = 0x7131396  # separates these random numbers from the noise of the sensors


class TimingEffects:
    """Jitter and losses of the force readings on a simulated rig with one axis.

    Args:
        mechanism: mechanism and rig.
        seed: seed of the random numbers.
    """

    def __init__(self, mechanism: Mechanism, seed: int) -> None:
        rig = mechanism.rig
        self._random, self._jitter = Random(seed + SEED_OFFSET), rig.force_sensor.jitter
        self._loss, self._delay = rig.force_sensor.loss_probability, rig.force_sensor.delay
        self._simulator, self._period, self._hold = rig.simulator, rig.control_period, rig.command_hold
        self._plane = rig.contact_plane
        has_series = self._jitter > 0.0 and rig.simulator.window is None
        self._series = series_rows(rig.simulator, rig.control_period) if has_series else ()
        self.begin(1)

    def begin(self, size: int) -> None:
        """Begin a run; `size` is the number of periods that the ring buffer stores, a power of two."""
        self._inputs: list[tuple[list[float], float, float] | None] = [None] * size
        self._reading = 0.0

    def store(self, tick: int, state: list[float], start: float, end: float) -> None:
        """Store the state of the motion simulator and the commands [m] of the interval that begins now."""
        if self._jitter > 0.0:
            self._inputs[tick & (len(self._inputs) - 1)] = [*state], start, end

    def late_force(self, tick: int, law: FloatLaw) -> float | None:
        """Return the real force [N] that the sensor reads after a random delay; None without jitter."""
        if self._jitter == 0.0:
            return None
        deviation = self._jitter * (2.0 * self._random.random() - 1.0)
        whole, fraction = split_delay(self._simulator.delay + max(self._delay + deviation, 0.0), self._period)
        inputs = self._inputs[(tick - 1 - whole) & (len(self._inputs) - 1)] if tick > whole else None
        if inputs is None:
            return 0.0
        position, velocity = self._motion(fraction, *inputs)
        return law.force(position - self._plane, velocity) if position > self._plane else 0.0

    def hold_lost(self, tick: int, reading: float) -> float:
        """Return the reading [N]; if a random draw loses it, return the last reading that was not lost."""
        if not (self._loss > 0.0 and self._random.random() < self._loss and tick > 0):
            self._reading = reading
        return self._reading

    def _motion(self, fraction: float, state: list[float], start: float, end: float) -> tuple[float, float]:
        """Return position [m] and velocity [m/s] of the motion simulator at a fraction of an interval."""
        window = self._simulator.window
        if window is not None:
            kink = window / self._period % 1.0
            is_before = fraction <= kink + DELAY_ROUNDING_TOLERANCE
            rows = average_rows(window, self._period, self._hold, fraction, is_before)
            position, rate = (evaluate_row(row, state, start, end) for row in rows)
            return position, rate
        position = rate = 0.0
        for row in reversed(self._series):
            rate = position + fraction * rate
            position = evaluate_row(row, state, start, end - start) + fraction * position
        return position, rate / self._period if state or self._hold == "linear" else 0.0
