"""Sensor readings of a tick: corrected wrench, aligned pose, contact detection, means of free flight."""

from math import floor
from typing import Annotated

from jaxhil.laws.impulse_ledger.six_axes.constants import (
    INITIAL_CONTACT_AGE,
    MAX_FLIGHT,
    MAX_MEAN,
    MAX_RECALL,
    MIN_RATE,
    ONSET_SIGMAS,
    RECENT,
    SAMPLES,
)
from jaxhil.rig.six_axes.registry import ModelConstants
from jaxhil.rig.six_axes.vectors import (
    AXES,
    Matrix,
    Vector,
    add_multiple,
    dot,
    product,
    subtract,
    wrench_at_chaser,
)
from jaxhil.rig.types import Count, Gains, Index, Positive

MASK = SAMPLES - 1
ROWS = 4 * AXES  # columns: filtered pose of the hardware; pose, twist and impulse of the model
MODEL_ROWS = 3 * AXES
ModelRows = Annotated[list[float], MODEL_ROWS]


class SixAxisReader:
    """Readings of the six-axis impulse ledger; README.md in the parent folder states the equations.

    Attributes:
        wrench: W, contact wrench about the chaser's origin C, without bias and tool inertia [N, N m].
        variance: mean of the squared norm |W|^2 if W is only noise [N^2/kg].
        pose: xi_a, filtered pose of the hardware, delayed like the wrench [m, rad].
        moved: change of `pose` since the last tick [m, rad].
        loud: whether the wrench is large enough to count as contact.
        quiet: number of ticks since the last reading in contact.
        tool: largest squared norm of the tool's inertia force in a reading of this contact [N^2/kg].
        has_flown: whether the means `lag` and `twist` include at least one tick of free flight.
        lag: mean of the model's pose minus `pose` in free flight [m, rad].
        twist: mean twist of the model in free flight [m/s, rad/s].
    """

    __slots__ = (
        "_age", "_back", "_back_share", "_back_ticks", "_bias", "_filter_gain", "_filtered", "_first",
        "_flight_ticks", "_force_variance", "_inverse", "_longest_flight", "_mass", "_metric",
        "_noise_angular", "_noise_linear", "_period", "_pole", "_readings", "_rows", "_settle",
        "_tool_correction", "_torque_variance", "lag", "loud", "moved", "pose", "quiet", "tool", "twist",
        "variance", "wrench",
    )  # fmt: skip
    _age: Count  # number of ticks since the beginning of the run
    _period: Positive
    _rows: Annotated[list[list[float]], SAMPLES, ROWS]
    _back_ticks: Count
    _inverse: Matrix
    _mass: Matrix
    _metric: Matrix  # A^T M^-1 A, with which |A W|^2 is a quadratic form of W
    _tool_correction: Matrix
    lag: Vector
    twist: Vector

    def __init__(self, gains: Gains, constants: ModelConstants, period: Positive) -> None:
        self._period = period
        self._mass = constants.mass_matrix
        self._inverse = constants.inverse_mass
        self._tool_correction = constants.tool_correction
        delay = gains["identification_delay"]
        filter_lag = min(gains["pose_filter"], delay)
        self._pole = filter_lag / (filter_lag + period)
        self._filter_gain = 1.0 / (1.0 - self._pole)
        self._back = (delay - filter_lag) / period
        if not self._back <= MAX_RECALL:
            raise ValueError(f"a delay of {self._back!r} periods, expected at most {MAX_RECALL!r}")
        self._back_ticks = floor(self._back)
        self._back_share = self._back - self._back_ticks
        self._force_variance = gains["force_noise"] * gains["force_noise"]
        self._torque_variance = gains["torque_noise"] * gains["torque_noise"]
        columns = [[row[j] for row in constants.tool_correction] for j in range(AXES)]
        metric = [[dot(left, product(self._inverse, right)) for right in columns] for left in columns]
        self._metric = metric
        self._noise_linear = metric[0][0] + metric[1][1] + metric[2][2]
        self._noise_angular = metric[3][3] + metric[4][4] + metric[5][5]
        self._settle = gains["settle"]
        self._longest_flight = MAX_FLIGHT / period
        self._rows = [[0.0] * ROWS for _ in range(SAMPLES)]
        self.reset()

    def reset(self) -> None:
        """Begin a new run: forget all readings and the means of free flight."""
        self._age = 0
        self._bias = [0.0] * AXES
        self._readings = 0.0
        self._flight_ticks = 0.0
        self._filtered = [0.0] * AXES
        self._first = [0.0] * AXES
        self.lag = [0.0] * AXES
        self.twist = [0.0] * AXES
        self.quiet = INITIAL_CONTACT_AGE
        self.tool = 0.0
        self.wrench = [0.0] * AXES
        self.pose = [0.0] * AXES
        self.moved = [0.0] * AXES
        self.variance = 0.0
        self.loud = False

    @property
    def has_flown(self) -> bool:
        """Return whether the averages `lag` and `twist` include at least one tick of free flight."""
        return self._flight_ticks > 0.0

    @property
    def is_recent(self) -> bool:
        """Return whether the last contact was less than the time `RECENT` ago."""
        return self.quiet * self._period < RECENT

    def read(
        self,
        wrench: Vector,
        pose_desired: Vector,
        twist_desired: Vector,
        pose_measured: Vector,
        impulse: Vector,
        in_contact: bool,
    ) -> None:
        """Process the inputs of a tick; arguments as in `SixAxisCompensator.step`.

        `impulse` is the impulse commanded so far [N s, N m s]; `in_contact` is true if a contact was in
        progress after the last tick.
        """
        begins = self._age == 0
        period = self._period
        pose = self._aligned(pose_desired, twist_desired, pose_measured, impulse)
        if begins:
            self.pose = add_multiple(pose, -period, twist_desired)
        self.moved = subtract(pose, self.pose)
        self.pose = pose
        # The hardware accelerates by M^-1 W, and the sensor reads (1 - M_t M^-1) W (equation a).
        corrected = product(self._tool_correction, wrench_at_chaser(wrench, pose))
        unbiased = subtract(corrected, self._bias)
        self.wrench = unbiased
        self.variance = self._noise_variance(pose)
        settles = self._age * period < self._settle
        is_recent = self.is_recent
        gate = ONSET_SIGMAS * ONSET_SIGMAS * self.variance
        gate += MIN_RATE * MIN_RATE * dot(twist_desired, product(self._mass, twist_desired))
        if in_contact or is_recent:
            gate += self.tool
        self.loud = not settles and dot(unbiased, product(self._inverse, unbiased)) > gate
        if not in_contact and not self.loud:
            self._fly(corrected, subtract(pose_desired, pose), twist_desired, not is_recent)
        self._age += 1

    def _noise_variance(self, pose: Vector) -> float:
        """Return the mean squared norm [N^2/kg] of the wrench noise if the chaser's frame C is at `pose`."""
        metric, angular = self._metric, self._noise_angular
        x, y, z = pose[:3]
        coupling = (metric[2][4] - metric[1][5]) * x + (metric[0][5] - metric[2][3]) * y
        coupling += (metric[1][3] - metric[0][4]) * z
        # The noise f of one force channel is the wrench (f, -p x f) about C's origin at p.
        moment = (angular - metric[3][3]) * x * x + (angular - metric[4][4]) * y * y
        moment += (angular - metric[5][5]) * z * z
        moment -= 2.0 * (metric[3][4] * x * y + metric[3][5] * x * z + metric[4][5] * y * z)
        force = self._noise_linear + 2.0 * coupling + moment
        return self._force_variance * force + self._torque_variance * angular

    def weigh_tool(self) -> None:
        """Raise `tool` to the squared norm of the tool's inertia force on this tick, if that is larger."""
        share = subtract(product(self._tool_correction, self.wrench), self.wrench)
        self.tool = max(self.tool, dot(share, product(self._inverse, share)))

    def recall_model(self, ticks: float) -> ModelRows:
        """Return pose, twist and impulse of the model `ticks` ticks ago, interpolated linearly."""
        whole = floor(ticks)
        share = ticks - whole
        newest = self._age - 1 - whole
        newer = self._model_at(newest)
        older = self._model_at(newest - 1)
        return [new + share * (old - new) for new, old in zip(newer, older, strict=True)]

    def _model_at(self, age: int) -> ModelRows:
        """Return pose, twist and impulse of the model on tick `age`; before tick 0, assume uniform motion."""
        if age >= 0:
            index: Index = age & MASK
            return self._rows[index][AXES:ROWS]
        first = self._rows[0]
        passed = age * self._period
        moved = [at + passed * rate for at, rate in zip(first[6:12], first[12:18], strict=True)]
        return [*moved, *first[12:18], *[0.0] * AXES]

    def _aligned(
        self, pose_desired: Vector, twist_desired: Vector, pose_measured: Vector, impulse: Vector
    ) -> Vector:
        """Store this tick's inputs in the delay line; return the filtered pose, delayed like the wrench."""
        age: Index = self._age & MASK
        pole, period = self._pole, self._period
        rows = self._rows
        if self._age == 0:
            # Start in steady state: in uniform motion, the filter lags by pole/(1 - pole) ticks.
            self._filtered = add_multiple(pose_measured, -(period * self._filter_gain), twist_desired)
        self._filtered = [
            at + pole * (old - at) for at, old in zip(pose_measured, self._filtered, strict=True)
        ]
        rows[age] = [*self._filtered, *pose_desired, *twist_desired, *impulse]
        if self._age == 0:
            self._first = list(self._filtered)
        ago = self._back - self._age
        if ago > 0.0:
            return add_multiple(self._first, -(period * ago), twist_desired)
        newer: Index = (self._age - self._back_ticks) & MASK
        older: Index = (self._age - self._back_ticks - 1) & MASK
        share = self._back_share
        return [
            new + share * (old - new) for new, old in zip(rows[newer][:AXES], rows[older][:AXES], strict=True)
        ]

    def _fly(self, wrench: Vector, lag: Vector, twist: Vector, is_uniform: bool) -> None:
        """Update the mean wrench (bias) in free flight; in uniform motion, also `lag` and `twist`."""
        self._readings = min(self._readings + 1.0, MAX_MEAN)
        share = 1.0 / max(self._readings, 1.0)
        self._bias = [mean + share * (now - mean) for mean, now in zip(self._bias, wrench, strict=True)]
        if not is_uniform:
            self._flight_ticks = 0.0
            return
        self._flight_ticks = min(self._flight_ticks + 1.0, self._longest_flight)
        share = 1.0 / max(self._flight_ticks, 1.0)
        self.lag = [mean + share * (now - mean) for mean, now in zip(self.lag, lag, strict=True)]
        self.twist = [mean + share * (now - mean) for mean, now in zip(self.twist, twist, strict=True)]
