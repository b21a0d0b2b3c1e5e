"""Motion simulator of the oracle: exact output of a linear system for a constant or ramp command.

Between two breakpoints of the delayed command the output is a Taylor polynomial to machine precision, so that
position and velocity can be evaluated at any real time, counted in control periods ("ticks").
"""

from __future__ import annotations

from math import ceil, floor
from typing import Any

import numpy as np
from scipy.linalg import expm

TIME_TOLERANCE = 1e-9  # ticks: closer than this, two times are the same
TAYLOR_ORDER = 24


def delay_in_ticks(delay, period):
    """Return a delay in ticks, rounded to an integer if within 1e-9."""
    ticks = delay / period
    return float(round(ticks)) if abs(ticks - round(ticks)) <= TIME_TOLERANCE else ticks


def simulator_matrices(simulator) -> Any:
    """Return (A, B, C) of G(s), or None for the ideal simulator; states are scaled by the fastest pole."""
    model = simulator["model"]
    if model in ("ideal", "moving_average"):
        return None
    if model == "first_order":
        numerator, denominator = [1.0], [simulator["time_constant"], 1.0]
    elif model == "second_order":
        omega, zeta = 2.0 * np.pi * simulator["natural_frequency"], simulator["damping_ratio"]
        numerator, denominator = [1.0], [1.0 / omega**2, 2.0 * zeta / omega, 1.0]
    elif model == "third_order":
        a1, a2, a3 = simulator["coefficients"]
        numerator, denominator = [1.0], [a3, a2, a1, 1.0]
    elif model == "transfer_function":
        numerator, denominator = simulator["numerator"], simulator["denominator"]
    else:
        raise ValueError(f"unknown simulator model {model!r}")
    numerator = np.trim_zeros(np.asarray(numerator, float), "f")
    denominator = np.trim_zeros(np.asarray(denominator, float), "f")
    poles = np.roots(denominator)
    if len(numerator) >= len(denominator) or np.any(poles.real >= 0.0):
        raise ValueError("the simulator must be strictly proper and stable")
    if abs(numerator[-1] / denominator[-1] - 1.0) > 1e-9:
        raise ValueError("the simulator must have G(0) = 1")
    fastest, order = np.abs(poles).max(), len(denominator) - 1
    scaled = denominator * fastest ** np.arange(order, -1.0, -1.0)
    A = np.diag(np.ones(order - 1), 1)
    A[-1] = -scaled[:0:-1] / scaled[0]
    B = np.zeros(order)
    B[-1] = 1.0
    C = np.zeros(order)
    C[: len(numerator)] = (numerator * fastest ** np.arange(len(numerator) - 1, -1.0, -1.0))[::-1]
    return fastest * A, fastest * B, C / scaled[0]


def taylor_rows(A, B, C, length):
    """Return rows that map (state, u, ramp of u) to the Taylor coefficients of y and the next state."""
    order = len(B)
    terms = [np.eye(order, order + 2)]
    for k in range(TAYLOR_ORDER):
        following = length * (A @ terms[-1]) / (k + 1)
        if k < 2:
            following[:, order + k] += length * B / (k + 1)
        terms.append(following)
    return np.array([C @ term for term in terms]), np.sum(terms[::-1], axis=0)


class Motion:
    """x_a(t) as polynomials: command c(m) -> latency, hold -> u(t) -> transport delay, G(s)."""

    def __init__(self, rig, period, position, velocity, history):
        """Start with `position` and `velocity` at t = 0 after uniform motion; keep `history` past ticks."""
        simulator = rig["simulator"]
        self.period, self.velocity = period, velocity
        self.latency = int(rig.get("command_latency", 0))
        self.hold = rig.get("command_hold", "linear")
        if self.latency not in (0, 1) or self.hold not in ("linear", "zoh"):
            raise ValueError("command_latency is 0 or 1, command_hold linear or zoh")
        self.delay = delay_in_ticks(simulator.get("delay", 0.0), period)
        self.matrices = simulator_matrices(simulator)
        self.window = delay_in_ticks(simulator.get("window", 0.0), period)
        self.kink = self.window % 1.0  # at this fraction of an interval the window's start passes a tick
        self.is_ideal = self.matrices is None and not self.window
        self.position = position
        self.commands: list[float] = [position]
        self.first = -ceil(self.delay + history) - 3
        self.substeps = 1
        if self.matrices is not None:
            A, B, _ = self.matrices
            self.substeps = max(1, ceil(2.0 * np.linalg.norm(A, 2) * period))
            self.series, self.transition = taylor_rows(A, B, self.matrices[2], period / self.substeps)
            gain: Any = -np.linalg.solve(A, B)
            if self.hold == "linear":
                start = self._command(self.first - self.latency)
                self.state = gain * start + np.linalg.solve(A, gain) * velocity
            else:
                # z = gain U - w with z(t + T) = z(t) + gain v T for every step of the staircase command.
                start = self._command(self.first + 1 - self.latency)
                steps = gain * velocity * period
                transition = expm(A * period)
                self.state = gain * start - np.linalg.solve(np.eye(len(B)) - transition, steps)
        self.intervals = []

    def append(self, command):
        self.commands.append(command)

    def _command(self, m) -> float:
        if m >= 0:
            return self.commands[m]
        return self.position + self.velocity * m * self.period

    def segment(self, j, i):
        """Return Taylor coefficients of x_a on substep i of the interval from j + delay, theta = 0..1."""
        while self.first + len(self.intervals) <= j:
            self.intervals.append(self._solve(self.first + len(self.intervals)))
        return self.intervals[j - self.first][i]

    def _solve(self, j):
        end = self._command(j + 1 - self.latency)
        start = self._command(j - self.latency) if self.hold == "linear" else end
        if self.window:
            return [self._average(j, 0), self._average(j, 1)]
        if self.matrices is None:
            return [np.array([start, end - start])]
        ramp, polynomials = (end - start) / self.substeps, []
        for i in range(self.substeps):
            drive = np.array([*self.state, start + ramp * i, ramp])
            polynomials.append(self.series @ drive)
            self.state = self.transition @ drive
        return polynomials

    def _average(self, j, part):
        """Return the mean of u over the moving-average window as a polynomial of theta.

        Part 0 is valid before `kink`, part 1 after it.
        """
        whole = int(self.window - self.kink + 0.5)
        oldest = j - whole - 1 + part  # interval in which the window starts
        left = 1.0 - self.kink if part == 0 else -self.kink  # its start in that interval, at theta = 0
        first, last = self._line(oldest), self._line(j)
        # Integral over the oldest interval from left + theta to 1, and over interval j from 0 to theta.
        shifted = np.array([first[0] + first[1] * left, first[1]])
        total = np.array([first[0] + first[1] / 2 - first[0] * left - first[1] * left**2 / 2, 0.0, 0.0])
        total[1:] += np.array([last[0], last[1] / 2]) - np.array([shifted[0], shifted[1] / 2])
        for k in range(oldest + 1, j):
            middle = self._line(k)
            total[0] += middle[0] + middle[1] / 2
        if oldest == j:  # the window is shorter than the interval: both integrals overlap
            total[0] -= last[0] + last[1] / 2
        return total / self.window

    def _line(self, j):
        """Return u in interval j as coefficients (u at its start, increase)."""
        end = self._command(j + 1 - self.latency)
        start = self._command(j - self.latency) if self.hold == "linear" else end
        return np.array([start, end - start])

    def locate_left(self, time):
        """Return (j, i, theta), theta in (0, 1], of the substep that ends at or contains the time."""
        scaled = (time - self.delay) * self.substeps
        q = ceil(scaled - TIME_TOLERANCE * self.substeps) - 1
        j = q // self.substeps
        return j, q - j * self.substeps, min(scaled - q, 1.0)

    def at_left(self, time):
        j, i, theta = self.locate_left(time)
        if self.window:
            i = int(theta > self.kink + TIME_TOLERANCE)
        return polynomial(self.segment(j, i))(theta)

    def segments_between(self, start, end):
        """Return (polynomial, origin, theta_a, theta_b) covering (start, end], in order."""
        q = floor((start - self.delay) * self.substeps + TIME_TOLERANCE)
        while True:
            origin = self.delay + q / self.substeps
            theta_a = max(0.0, (start - origin) * self.substeps)
            theta_b = min(1.0, (end - origin) * self.substeps)
            if theta_b <= TIME_TOLERANCE:
                return
            j = q // self.substeps
            if self.window:
                for part, low, high in ((0, 0.0, self.kink), (1, self.kink, 1.0)):
                    if min(theta_b, high) > max(theta_a, low):
                        yield self.segment(j, part), origin, max(theta_a, low), min(theta_b, high)
            elif theta_b > theta_a:
                yield self.segment(j, q - j * self.substeps), origin, theta_a, theta_b
            q += 1


def polynomial(coefficients):
    """Return the polynomial as a function (Horner's rule without NumPy's argument checks)."""
    last, *others = reversed(coefficients.tolist())

    def value(s):
        total = last + 0.0 * s
        for coefficient in others:
            total = coefficient + total * s
        return total

    return value
