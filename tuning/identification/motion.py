"""Motion of the mechanism at the times of the sensor readings, computed from the logged commands.

The response of a linear motion simulator to held or linearly interpolated commands is known exactly at any
time. Within a control period, it is a linear function of the state and of the commands at both ends of the
period (Van Loan 1978). The position at any time, even between two ticks, is therefore exact and without
noise. The simulation of the loop uses the same method (`jaxhil.simulation.motion_curves`). All runs are
computed together, one per lane (column of the arrays). The command is assumed to move uniformly before the
first row of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np

from tuning.identification.moving_average_model import MovingAverageModel
from tuning.identification.rational import MotionModel
from tuning.identification.records import CampaignTiming, LoggedRun

TICK_TOLERANCE = 1e-9  # distance from a tick within which a time counts as the tick [periods]
# Maximum size of the cached motions [bytes], and their minimum number. Fits of several contact laws repeat
# the same delays.
MAX_CACHED_BYTES, MIN_CACHED_MOTIONS = 3.2e7, 2


class MotionResponse:
    """Position and velocity of the mechanism, predicted by a model from the commands of several runs."""

    def __init__(
        self,
        model: MotionModel,
        runs: Sequence[LoggedRun],
        timing: CampaignTiming,
        longest: float,
        late: np.ndarray | None = None,
        shortest: float = 0.0,
    ):
        """Compute the states of the model at all ticks.

        Args:
            model: Model of the motion simulator.
            runs: Runs, one per lane.
            timing: Timing of commands and readings.
            longest: Longest sensor delay [s] that `at` must support, without the delay of the model.
            late: Delay [s] that a separate clock adds to the force readings of each run, or None. The mean
                of `LoggedRun.force_late` is subtracted from it.
            shortest: Shortest sensor delay [s] that `at` must support; it may be negative. Sums with the
                delay of the model that are not negative are always supported.
        """
        self.delay, self.period = model.delay, timing.control_period
        if any(run.force_late is not None for run in runs):
            read = [0.0 if run.force_late is None else np.nanmean(run.force_late) for run in runs]
            late = -np.array(read) if late is None else late - np.array(read)
        self.late = late if late is not None and np.any(late) else None
        least, most = (0.0, 0.0) if late is None else (min(late.min(), 0.0), max(late.max(), 0.0))
        self.shift = timing.shift
        self.rows = max(len(run.tick) for run in runs)
        self.window = model.window if isinstance(model, MovingAverageModel) else 0.0
        # A moving average is the difference of two values of the input's integral.
        numerator, denominator = (np.ones(1), np.array([self.period, 0.0])) if self.window else model.fraction
        self.order = len(denominator) - 1
        self.A, self.B, self.C = _make_companion_form(numerator, denominator, self.period)
        longest = max(self.delay, 0.0) + longest + most + self.window
        self.history = int(np.ceil(longest / self.period)) + timing.command_latency + 4
        # If readings in a row belong to later ticks, or a delay is negative, commands of later ticks are
        # needed.
        earliest = min(self.delay + min(shortest, 0.0), 0.0) + least
        ahead = max(1, -self.shift) + int(np.ceil(-earliest / self.period))
        command = self._commands(runs, ahead)
        latency = timing.command_latency
        self.end = command[1 : len(command) - latency]
        self.start = self.end if timing.command_hold == "zoh" else command[: len(command) - 1 - latency]
        # Interval k of `start` and `end` begins at tick k + latency - history and lasts one period.
        self.offset = self.history - latency
        self.states = self._advance(timing.command_hold)
        self.max_cached_bytes = MAX_CACHED_BYTES
        self._cache: dict[float, tuple[np.ndarray, np.ndarray]] = {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for copies and digests, with an empty cache."""
        return {**vars(self), "_cache": {}}

    def at(self, delay: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the position [m] and velocity [m/s] that a sensor with a delay of `delay` [s] measures.

        Both are read-only and have the shape (rows, lanes).
        """
        if delay in self._cache:
            return self._cache[delay]
        if self.late is None:
            position, velocity = self._at(delay, slice(None))
        else:
            lanes = [self._at(delay + late, slice(i, i + 1)) for i, late in enumerate(self.late)]
            position, velocity = np.hstack([x for x, _ in lanes]), np.hstack([v for _, v in lanes])
        position.flags.writeable = velocity.flags.writeable = False
        size = 2 * position.nbytes * (len(self._cache) + 1)
        if len(self._cache) >= MIN_CACHED_MOTIONS and size > self.max_cached_bytes:
            del self._cache[next(iter(self._cache))]
        self._cache[delay] = position, velocity
        return position, velocity

    def _at(self, delay: float, lanes: slice) -> tuple[np.ndarray, np.ndarray]:
        if not self.window:
            return self._compute_output(delay, lanes)
        now, before = (self._compute_output(delay + age, lanes) for age in (0.0, self.window))
        position, rate = (self.period / self.window * (a - b) for a, b in zip(now, before, strict=True))
        return position, rate

    def _compute_output(self, delay: float, lanes: slice) -> tuple[np.ndarray, np.ndarray]:
        lag = (self.delay + delay) / self.period + self.shift
        whole_periods = int(np.floor(lag + TICK_TOLERANCE))
        fraction = min(1.0, 1.0 - (lag - whole_periods))
        first = self.offset - 1 - whole_periods
        if first < 0:
            raise ValueError(f"delay: found {delay:g} s, expected at most `longest`")
        taken = slice(first, first + self.rows)
        start, end, states = self.start[taken, lanes], self.end[taken, lanes], self.states[:, taken, lanes]
        state, from_start, from_end = self._after(fraction)
        position = np.concatenate([self.C @ state, [self.C @ from_start, self.C @ from_end]])
        rate = np.concatenate(
            [(self.C @ self.A) @ state, [self.C @ self.A @ from_start, self.C @ self.A @ from_end]]
        )
        if self.order == 0:
            position, rate = np.array([1.0 - fraction, fraction]), np.array([-1.0, 1.0])
        else:
            rate[-2] += (self.C @ self.B) * (1.0 - fraction)
            rate[-1] += (self.C @ self.B) * fraction
        terms = (*states, start, end)
        return _sum_weighted(position, terms), _sum_weighted(rate / self.period, terms)

    def at_row_times(self) -> MotionResponse:
        """Return the motion at the times of the rows instead of those of the force readings."""
        rows = copy(self)
        rows.late = None
        return rows

    def of(
        self, lanes: np.ndarray, begin: int = 0, max_cached_bytes: float = MAX_CACHED_BYTES
    ) -> MotionResponse:
        """Return the motion of some lanes from row `begin` on; `lanes` may contain a lane several times."""
        result = copy(self)
        result.max_cached_bytes = max_cached_bytes
        result.offset, result.rows = self.offset + begin, self.rows - begin
        result.start, result.end = self.start[:, lanes], self.end[:, lanes]
        result.states = self.states[:, :, lanes]
        result.late = None if self.late is None else self.late[lanes]
        return result

    def _commands(self, runs: Sequence[LoggedRun], ahead: int) -> np.ndarray:
        """Return the commands of the runs, with `history` rows before and `ahead` after, one lane per run.

        Before a run, the command moves uniformly (contact, tap) or rests; after the run, it is held.
        """
        lanes = []
        for run in runs:
            x = run.position_desired
            if run.kind in ("contact", "tap"):
                step = (
                    (x[1] - x[0]) if run.velocity_desired is None else run.velocity_desired[0] * self.period
                )
            else:
                step = 0.0
            before = x[0] + step * np.arange(-self.history, 0)
            lanes.append(np.concatenate([before, x, np.full(self.rows - len(x) + ahead, x[-1])]))
        return np.ascontiguousarray(np.array(lanes).T)

    def _after(self, fraction: float):
        """Return three matrices that advance the state by a fraction of a control period.

        They multiply the state, the input at the start of the period, and the input at its end.
        """
        n = self.order
        system = np.zeros((n + 2, n + 2))
        system[:n, :n], system[:n, n], system[n, n + 1] = self.A, self.B, 1.0
        full = compute_matrix_exponential(system * fraction)[:n]
        return full[:, :n], full[:, n] - full[:, n + 1], full[:, n + 1]

    def _advance(self, hold: str) -> np.ndarray:
        """Return the states at the ends of all periods, (order, periods + 1, lanes), for a command hold."""
        state, from_start, from_end = self._after(1.0)
        lanes = self.end.shape[1]
        states = np.empty((len(self.end) + 1, self.order, lanes))
        if not self.order:
            return states.swapaxes(0, 1)
        drive = from_start[:, None] * self.start[:, None] + from_end[:, None] * self.end[:, None]
        if self.window:
            states[0] = 0.0
            np.cumsum(drive, axis=0, out=states[1:])
            return np.ascontiguousarray(states.swapaxes(0, 1))
        closed = np.eye(self.order) - state
        from_both = from_start + from_end
        # In uniform motion, the input increases by the same step in each period n, and the state is alpha +
        # beta n.
        step = self.end[1] - self.end[0]
        beta = np.linalg.solve(closed, np.outer(from_both, step))
        ahead = from_both if hold == "zoh" else from_end
        now = self.end[0] - step if hold == "zoh" else self.start[0]
        states[0] = np.linalg.solve(closed, np.outer(from_both, now) + np.outer(ahead, step) - beta)
        for n in range(len(self.end)):
            states[n + 1] = state @ states[n] + drive[n]
        return np.ascontiguousarray(states.swapaxes(0, 1))


def _sum_weighted(weights: np.ndarray, terms: Sequence[np.ndarray]) -> np.ndarray:
    """Return the weighted sum of arrays of the same shape."""
    total = weights[0] * terms[0]
    product = np.empty_like(total)
    for weight, term in zip(weights[1:], terms[1:], strict=True):
        total += np.multiply(weight, term, out=product)
    return total


def _make_companion_form(numerator: np.ndarray, denominator: np.ndarray, period: float):
    """Return the companion form (A, B, C) of a transfer function; the unit of time is the control period.

    The coefficients are in descending powers of s. For order 0 the matrices are empty.
    """
    order = len(denominator) - 1
    scale = period ** np.arange(order, -1.0, -1.0)
    below = denominator / scale
    above = numerator / period ** np.arange(len(numerator) - 1, -1.0, -1.0)
    A = np.diag(np.ones(max(order - 1, 0)), 1)[:order, :order] if order else np.zeros((0, 0))
    B, C = np.zeros(order), np.zeros(order)
    if order:
        A[-1] = -below[:0:-1] / below[0]
        B[-1] = 1.0
        C[: len(above)] = above[::-1] / below[0]
    return A, B, C


def compute_matrix_exponential(matrix: np.ndarray) -> np.ndarray:
    """Return the matrix exponential by scaling, Taylor series and squaring, accurate to rounding.

    For hundreds of small matrices, this function is faster than SciPy's routine, which must choose a method
    first.
    """
    halvings = max(6, int(np.ceil(np.log2(np.abs(matrix).sum(axis=0).max(initial=1.0)))))
    identity = np.eye(len(matrix))
    scaled, total = matrix / 2.0**halvings, identity
    for term in range(13, 0, -1):
        total = identity + scaled @ total / term
    for _ in range(halvings):
        total = total @ total
    return total
