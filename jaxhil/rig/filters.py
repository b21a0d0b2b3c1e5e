"""Discrete filters of the compensators, with one sample per control period.

Each filter evaluates its equation from left to right as written, and allocates no memory per tick.
"""

from math import floor
from typing import Annotated

from jaxhil.rig.types import Count, Index, Positive


class LeadFilter:
    """Lead filter (1 + T_1 s)/(1 + T_2 s) by Tustin's rule, T_1 = lead + lag, T_2 = lag.

    y = ((2 T_2 - T) y_prev + (2 T_1 + T) u - (2 T_1 - T) u_prev) / (2 T_2 + T)

    u is the input, y the output, and T the control period. The filter begins at rest, y_prev = u_prev = 0.
    Times are in s; the output has the input's unit.
    """

    __slots__ = ("_denominator", "_input", "_of_input", "_of_output", "_of_previous", "_output")

    def __init__(self, lead: float, lag: float, period: float) -> None:
        zero = lead + lag
        self._of_output = 2.0 * lag - period
        self._of_input = 2.0 * zero + period
        self._of_previous = 2.0 * zero - period
        self._denominator = 2.0 * lag + period
        self.reset()

    def reset(self) -> None:
        """Set the previous input and output to 0."""
        self._input = 0.0
        self._output = 0.0

    def step(self, value: float) -> float:
        """Return the filter's output for the next input `value`."""
        output = (
            self._of_output * self._output + self._of_input * value - self._of_previous * self._input
        ) / self._denominator
        self._input = value
        self._output = output
        return output


class VelocityFilter:
    """Filtered derivative s/(1 + T_v s) by Tustin's rule.

    w = ((2 T_v - T) w_prev + 2 (x - x_prev)) / (2 T_v + T)

    T is the control period. The previous values are 0 unless `start` sets them. x is a position [m], and w a
    velocity [m/s]; x may also be a force [N], and w then is the rate of the force [N/s]. Times are in s.
    """

    __slots__ = ("_denominator", "_of_velocity", "_period", "_position", "_velocity")

    def __init__(self, time_constant: float, period: float) -> None:
        self._period = period
        self._of_velocity = 2.0 * time_constant - period
        self._denominator = 2.0 * time_constant + period
        self._position = 0.0
        self._velocity = 0.0

    def start(self, position: float, velocity: float) -> None:
        """Set the previous values for a motion at `velocity` [m/s] that next reaches `position` [m]."""
        self._position = position - self._period * velocity
        self._velocity = velocity

    def step(self, position: float) -> float:
        """Return the filtered velocity [m/s]."""
        velocity = (
            self._of_velocity * self._velocity + 2.0 * (position - self._position)
        ) / self._denominator
        self._position = position
        self._velocity = velocity
        return velocity


class DelayLine:
    """Delay line for a position, with linear interpolation between samples for a delay tau >= 0.

    r = tau/T, q = floor(r + 1e-9), f = r - q, output (1 - f) x[n-q] + f x[n-q-1]

    x[n] is the position at step n, and T the control period. Call `start` before the first `step`. The
    constructor raises ValueError if the delay is longer than `MAX_DELAY_PERIODS` periods.
    """

    MAX_DELAY_PERIODS = 100_000

    __slots__ = ("_fraction", "_head", "_period", "_remainder", "_samples", "_size", "_whole")
    _head: Annotated[Count, "index"]

    def __init__(self, delay: float, period: Positive) -> None:
        ratio = delay / period
        if not 0.0 <= ratio <= self.MAX_DELAY_PERIODS:
            raise ValueError(f"a delay of {ratio!r} periods, expected 0 to {self.MAX_DELAY_PERIODS}")
        # The margin of 1e-9 gives the right integer if rounding makes the ratio slightly too small.
        self._whole = floor(ratio + 1e-9)
        self._fraction = ratio - self._whole
        self._remainder = 1.0 - self._fraction
        self._period = period
        self._size = self._whole + 2
        self._samples = [0.0] * self._size
        self._head = 0

    def start(self, position: float, velocity: float) -> None:
        """Set sample j < 0 (before the first step) to position + j T velocity; T: control period."""
        period = self._period
        samples = self._samples
        size = self._size
        for j in range(1, len(samples)):
            samples[j] = position + (j - size) * period * velocity
        self._head = 0

    def step(self, position: float) -> float:
        """Return the delayed position [m]."""
        head = self._head
        samples = self._samples
        samples[head] = position
        # A negative index counts from the end: the list stores exactly the latest `whole + 2` samples.
        newer: Index = head - self._whole
        older: Index = newer - 1
        delayed = self._remainder * samples[newer] + self._fraction * samples[older]
        head += 1
        self._head = 0 if head == self._size else head
        return delayed
