"""Exact discretisation of a moving average: the position is the mean of the command during a window.

The window has N + f control periods. During one control period, the start of the window moves through parts
of two sampling intervals: first on the line from command a to b and, after the fraction f, on the line from b
to c. The state is the position at the start of the sampling interval, and a, b, c. The rows are those of
`tuning.rig.discretisation`.
"""

import math

from tuning.rig.discretisation import DELAY_ROUNDING_TOLERANCE, DiscreteSimulator, MotionRows, ResponseRow

STATE_SIZE = 4  # position, and the commands a, b, c


def discretise_moving_average(
    window: float, period: float, hold: str, force_fraction: float, position_fraction: float
) -> DiscreteSimulator:
    """Return the exact discretisation of a moving average, in the form of `discretise_simulator`.

    Args:
        window: length of the window [s].
        period: control period [s].
        hold: interpolation of the command within a period, "linear" or "zoh".
        force_fraction: fraction of the period at which the force sensor samples [1].
        position_fraction: fraction of the period at which the position sensor samples [1].
    """
    width = window / period
    whole = math.floor(width + DELAY_ROUNDING_TOLERANCE)
    kink = width - whole

    def motion(fraction: float, is_before: bool) -> MotionRows:
        return average_rows(window, period, hold, fraction, is_before)

    def sampled(fraction: float) -> MotionRows:
        return motion(fraction, fraction <= kink + DELAY_ROUNDING_TOLERANCE)

    end = motion(1.0, False)
    units = [tuple(float(i == j) for i in range(STATE_SIZE + 2)) for j in range(1, STATE_SIZE)]
    return DiscreteSimulator(
        transition=(end.position, *units),
        start=motion(0.0, kink > 0.0),
        sample=sampled(force_fraction),
        end=end,
        measured=sampled(position_fraction).position,
        steady_command=(1.0,) * STATE_SIZE,
        steady_step=_steady_step(whole, kink, hold),
        window_intervals=whole,
    )


def average_rows(window: float, period: float, hold: str, fraction: float, is_before: bool) -> MotionRows:
    """Return the coefficients of the moving average and its rate at `fraction` of a sampling interval.

    During the interval, the start of the averaging window moves through parts of two earlier intervals.
    `is_before` is true while the window's start is in the first one.
    """
    width = window / period
    kink = width - math.floor(width + DELAY_ROUNDING_TOLERANCE)
    early, late = (fraction, 0.0) if is_before else (kink, fraction - kink)
    entering, leaving = _line_integral(0.0, fraction, hold), _line_integral(1.0 - kink, early, hold)
    second = _line_integral(0.0, late, hold)
    position = (1.0, *_weights(entering, leaving, second, width))
    rates = _line_value(1.0 - kink + early, hold), _line_value(late, hold)
    leaving, second = (rates[0], (0.0, 0.0)) if is_before else ((0.0, 0.0), rates[1])
    velocity = (0.0, *_weights(_line_value(fraction, hold), leaving, second, width * period))
    return MotionRows(position, velocity)


def _line_value(fraction: float, hold: str) -> tuple[float, float]:
    """Return two weights; applied to the commands at an interval's ends, they give the command in between.

    `fraction` is the fraction of the interval at which the command is computed.
    """
    return (1.0 - fraction, fraction) if hold == "linear" else (0.0, 1.0)


def _line_integral(start: float, length: float, hold: str) -> tuple[float, float]:
    """Return two weights; applied to the commands at an interval's ends, they give the command's integral.

    The integral covers the part from the fraction `start` of the interval to `start + length`.
    """
    before, after = _line_value(start + length / 2.0, hold)
    return length * before, length * after


def _weights(
    entering: tuple[float, float], first: tuple[float, float], second: tuple[float, float], width: float
) -> ResponseRow:
    """Return the weights of five commands in the change, or in the rate, of the moving average.

    The commands are a, b and c around the start of the window (the oldest first), then those at the ends of
    the sampling interval. `first`, `second` and `entering` are the weights of (a, b), (b, c) and the ends.
    """
    leaving = first[0], first[1] + second[0], second[1]
    return (*(-weight / width for weight in leaving), *(weight / width for weight in entering))


def _steady_step(whole: int, kink: float, hold: str) -> ResponseRow:
    """Return the moving average's state at an interval's start, under a command that is 0 there.

    The command grows by 1 per period, and the window is `whole + kink` periods long.
    """
    if hold == "linear":
        return (-(whole + kink) / 2.0, -1.0 - whole, -float(whole), 1.0 - whole)
    mean = (whole * (whole + 1) / 2.0 + kink * (whole + 1)) / (whole + kink)
    return (-mean, -2.0 - whole, -1.0 - whole, -float(whole))
