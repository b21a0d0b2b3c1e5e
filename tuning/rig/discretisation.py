"""Exact discretisation of the motion simulator's transfer function G(s), by matrix exponentials.

A transport delay commutes with a linear system. Therefore G is driven by the undelayed command, which is
linear within each control period ("sampling interval"), and a delayed sensor reading is the response of G at
an earlier time. The response at a given fraction of a sampling interval is linear in three quantities: the
state of G, the command at the interval's start, and the command at its end. A `ResponseRow` holds the
coefficients.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from jaxhil.mechanism.structs import Simulator

# Coefficients of (state, command at the sampling interval's start, command at its end).
ResponseRow = tuple[float, ...]
SERIES_DEGREE = 16  # degree of the power series of the motion in an interval
# distance from a whole number of periods within which a delay is rounded [periods]
DELAY_ROUNDING_TOLERANCE = 1e-9


class MotionRows(NamedTuple):
    """Coefficients of states and commands for position [m] and velocity [m/s] within a sampling interval."""

    position: ResponseRow
    velocity: ResponseRow


class DiscreteSimulator(NamedTuple):
    """Response of the motion simulator during one control period, as coefficient rows (`ResponseRow`)."""

    transition: tuple[ResponseRow, ...]  # state one period later
    start: MotionRows  # motion at the interval's start, as the limit from inside the interval
    sample: MotionRows  # motion at the sampling time of the force sensor
    end: MotionRows  # motion at the interval's end, as the limit from inside the interval
    measured: ResponseRow  # position at the sampling time of the position sensor
    # In uniform motion, the state is steady_command * command + steady_step * command increment per period.
    steady_command: ResponseRow  # [1/m]
    steady_step: ResponseRow  # [1/m]
    window_intervals: int | None = None  # whole periods in the window of a moving average; None for G(s)


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Split the delay of a reading [s] into whole intervals, and the time of the sample in its interval.

    This time is a fraction in (0, 1], measured from the start of the interval that contains the sample.
    """
    periods = delay / period
    whole = math.floor(periods + DELAY_ROUNDING_TOLERANCE)
    return whole, min(1.0, 1.0 - (periods - whole))


def discretise_simulator(
    simulator: Simulator, period: float, hold: str, force_fraction: float, position_fraction: float
) -> DiscreteSimulator:
    """Discretise G(s) exactly by the matrix exponential of the system augmented by its input (Van Loan 1978).

    The system is z' = A z + B u, with the state z and the command u. At the fraction s of the period T, the
    state is E(s) (z(0), u(0), u(T) - u(0)). E(s) contains the first rows of the matrix exponential of
    s T [[A, B, 0], [0, 0, 1/T], [0, 0, 0]].

    Args:
        simulator: motion simulator with the transfer function G(s).
        period: control period T [s].
        hold: interpolation of the command within a period, "linear" or "zoh".
        force_fraction: fraction of the period at which the force sensor samples [1].
        position_fraction: fraction of the period at which the position sensor samples [1].
    """
    numerator, denominator = transfer_function(simulator)
    order = len(denominator) - 1
    if order == 0:
        return _discretise_ideal(period, hold, force_fraction, position_fraction)
    # Time is measured in periods, so that the components of the state have similar magnitudes.
    powers = period ** np.arange(order + 1.0)
    system = np.eye(order, k=1)
    system[-1] = -(denominator[::-1] / denominator[0])[:order] * powers[:0:-1]
    output = np.zeros(order)
    output[: len(numerator)] = numerator[::-1] / denominator[0]
    output *= powers[:0:-1]
    drive = np.zeros(order)
    drive[-1] = 1.0

    def state_rows(fraction: float) -> np.ndarray:
        generator = np.zeros((order + 2, order + 2))
        generator[:order, :order] = system
        generator[order - 1, order] = 1.0
        generator[order, order + 1] = 1.0
        rows = expm(fraction * generator)[: order + 1]
        # Convert the columns from (z, u(0), u(1) - u(0)) to (z, u(0), u(1)), with time in periods.
        rows[:, order] -= rows[:, order + 1]
        return rows

    def motion(fraction: float) -> MotionRows:
        rows = state_rows(fraction)
        rates = system @ rows[:order] + np.outer(drive, rows[order])
        return MotionRows(_as_row(output @ rows[:order]), _as_row(output @ rates / period))

    transition = state_rows(1.0)[:order]
    steady_command = -np.linalg.solve(system, drive)
    if hold == "linear":
        steady_step = np.linalg.solve(system, steady_command)
    else:
        # A zero-order hold applies u(k+1) during interval k: z(k+1) = Ad z(k) + Bd u(k+1). Solve this for the
        # state of a uniform motion, z(k) = steady_command u(k+1) + steady_step (u(k+1) - u(k)).
        steady_step = -np.linalg.solve(np.eye(order) - transition[:, :order], steady_command)
    return DiscreteSimulator(
        transition=tuple(_as_row(row) for row in transition),
        start=motion(0.0),
        sample=motion(force_fraction),
        end=motion(1.0),
        measured=motion(position_fraction).position,
        steady_command=_as_row(steady_command),
        steady_step=_as_row(steady_step),
    )


def transfer_function(simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of the simulator's transfer function, in descending powers of s."""
    if simulator.model == "ideal":
        return np.ones(1), np.ones(1)
    if simulator.model == "transfer_function":
        return np.array(simulator.numerator), np.array(simulator.denominator)
    if simulator.model == "third_order":
        return np.ones(1), np.array([*reversed(simulator.coefficients or ()), 1.0])
    if simulator.model == "first_order":
        return np.ones(1), np.array([simulator.time_constant, 1.0])
    frequency = 2 * math.pi * (simulator.natural_frequency or math.nan)
    damping = simulator.damping_ratio or math.nan
    return np.array([frequency**2]), np.array([1.0, 2 * damping * frequency, frequency**2])


def series_rows(simulator: Simulator, period: float) -> tuple[ResponseRow, ...]:
    """Return the power series of the simulator's position in the time since an interval's start [periods].

    Row k, multiplied by the vector (state, command at the interval's start, increase of the command in the
    interval), is the coefficient of power k. For poles up to 1 rad per period, only rounding errors remain.
    """
    numerator, denominator = transfer_function(simulator)
    order = len(denominator) - 1
    generator, row = np.zeros((order + 2, order + 2)), np.zeros(order + 2)
    generator[order, order + 1] = 1.0
    if order:
        powers = period ** np.arange(order + 1.0)
        generator[:order, :order] = np.eye(order, k=1)
        generator[order - 1, :order] = -(denominator[::-1] / denominator[0])[:order] * powers[:0:-1]
        generator[order - 1, order] = 1.0
        row[: len(numerator)] = numerator[::-1] / denominator[0]
        row[:order] *= powers[:0:-1]
    else:
        row[0] = 1.0
    rows = [row]
    for power in range(1, SERIES_DEGREE + 1):
        rows.append(rows[-1] @ generator / power)
    return tuple(map(_as_row, rows))


def evaluate_row(row: ResponseRow, state: list[float], start: float, end: float) -> float:
    """Return the scalar product of `row` and (`state`, `start`, `end`).

    `start` and `end` are the commands [m] at the start and the end of the sampling interval.
    """
    total = row[-2] * start + row[-1] * end
    for weight, component in zip(row, state, strict=False):
        total += weight * component
    return total


def _discretise_ideal(
    period: float, hold: str, force_fraction: float, position_fraction: float
) -> DiscreteSimulator:
    slope = (-1.0 / period, 1.0 / period) if hold == "linear" else (0.0, 0.0)

    def motion(fraction: float) -> MotionRows:
        return MotionRows((1.0 - fraction, fraction), slope)

    return DiscreteSimulator(
        transition=(),
        start=motion(0.0),
        sample=motion(force_fraction),
        end=motion(1.0),
        measured=motion(position_fraction).position,
        steady_command=(),
        steady_step=(),
    )


def _as_row(values: np.ndarray) -> ResponseRow:
    return tuple(float(value) for value in values)
