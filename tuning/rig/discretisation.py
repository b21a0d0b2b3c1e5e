"""Exact discretisation of the motion simulator G(s) in plain floats, by one matrix exponential.

A transport delay commutes with a linear system. So G is driven by the undelayed command, which is linear
within each control period ("sampling interval"), and a delayed reading is its response at an earlier time.
The response at the fraction s of a sampling interval is a constant row of numbers times (state, command at
the interval's start, command at its end).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from jaxhil.mechanism.structs import Simulator

ResponseRow = tuple[float, ...]
DELAY_ROUNDING_TOLERANCE = 1e-9  # rounding error [periods] within which a delay is a whole number of periods


class MotionRows(NamedTuple):
    """Rows for position [m] and velocity [m/s] at one fraction of a sampling interval."""

    position: ResponseRow
    velocity: ResponseRow


class DiscreteSimulator(NamedTuple):
    """Rows of the response over one period (see the module's text)."""

    transition: tuple[ResponseRow, ...]  # state one period later
    start: MotionRows  # start of the interval, as a limit from inside
    sample: MotionRows  # sample of the force
    end: MotionRows  # end of the interval, as a limit from inside
    measured: ResponseRow  # position at the sample of the position sensor
    steady_command: ResponseRow  # state of a uniform motion per current command [1/m]
    steady_step: ResponseRow  # state of a uniform motion per increment of the command in a period [1/m]


def split_delay(delay: float, period: float) -> tuple[int, float]:
    """Return the whole sampling intervals of a delay [s], and the fraction in (0, 1] of that interval."""
    periods = delay / period
    whole = math.floor(periods + DELAY_ROUNDING_TOLERANCE)
    return whole, min(1.0, 1.0 - (periods - whole))


def discretise_simulator(
    simulator: Simulator, period: float, hold: str, force_place: float, position_place: float
) -> DiscreteSimulator:
    """Discretise G(s) exactly by the exponential of the system augmented by its input (Van Loan 1978).

    With z' = A z + B u, z(s T) = E(s) (z, u(0), u(1) - u(0)), E the exponential of s T [[A, B, 0],
    [0, 0, 1/T], [0, 0, 0]]. `hold` is "linear" or "zoh"; `force_place` and `position_place` are the fractions
    of the period [s] at which the sensors sample.
    """
    numerator, denominator = transfer_function(simulator)
    order = len(denominator) - 1
    if order == 0:
        return _discretise_ideal(period, hold, force_place, position_place)
    # With time in periods the components of the state have similar magnitudes.
    powers = period ** np.arange(order + 1.0)
    system = np.eye(order, k=1)
    system[-1] = -(denominator[::-1] / denominator[0])[:order] * powers[:0:-1]
    output = np.zeros(order)
    output[: len(numerator)] = numerator[::-1] / denominator[0]
    output *= powers[:0:-1]
    drive = np.zeros(order)
    drive[-1] = 1.0

    def state_rows(place: float) -> np.ndarray:
        generator = np.zeros((order + 2, order + 2))
        generator[:order, :order] = system
        generator[order - 1, order] = 1.0
        generator[order, order + 1] = 1.0
        rows = expm(place * generator)[: order + 1]
        # This changes the columns from (z, u(0), u(1) - u(0)) to (z, u(0), u(1)).
        rows[:, order] -= rows[:, order + 1]
        return rows

    def motion(place: float) -> MotionRows:
        rows = state_rows(place)
        rates = system @ rows[:order] + np.outer(drive, rows[order])
        return MotionRows(_as_row(output @ rows[:order]), _as_row(output @ rates / period))

    transition = state_rows(1.0)[:order]
    steady_command = -np.linalg.solve(system, drive)
    if hold == "linear":
        steady_step = np.linalg.solve(system, steady_command)
    else:
        # With a stepwise command, z(k) = alpha u(k+1) + beta step and z(k+1) = Ad z(k) + Bd u(k+1).
        steady_step = -np.linalg.solve(np.eye(order) - transition[:, :order], steady_command)
    return DiscreteSimulator(
        transition=tuple(_as_row(row) for row in transition),
        start=motion(0.0),
        sample=motion(force_place),
        end=motion(1.0),
        measured=motion(position_place).position,
        steady_command=_as_row(steady_command),
        steady_step=_as_row(steady_step),
    )


def transfer_function(simulator: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """Return numerator and denominator of G(s) in descending powers of s; order 0 is the ideal simulator."""
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


def evaluate_row(row: ResponseRow, state: list[float], start: float, end: float) -> float:
    """Return one row times (state, command at the sampling interval's start, command at its end)."""
    total = row[-2] * start + row[-1] * end
    for weight, component in zip(row, state, strict=False):
        total += weight * component
    return total


def _discretise_ideal(
    period: float, hold: str, force_place: float, position_place: float
) -> DiscreteSimulator:
    slope = (-1.0 / period, 1.0 / period) if hold == "linear" else (0.0, 0.0)

    def place(at: float) -> MotionRows:
        return MotionRows((1.0 - at, at), slope)

    measured = place(position_place).position
    return DiscreteSimulator((), place(0.0), place(force_place), place(1.0), measured, (), ())


def _as_row(values: np.ndarray) -> ResponseRow:
    return tuple(float(value) for value in values)
