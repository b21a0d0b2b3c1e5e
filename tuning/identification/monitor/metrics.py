"""Metrics of one contact: seven values that are 0 if the mechanism file is correct.

All metrics except the noise are weighted sums of the differences between the readings and those that the file
predicts. Their noise and their sensitivity to any parameter of the file are therefore known. Readings near
the onset are not used: the force of damped contact jumps there, and a row on its other side carries no
information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tuning.identification.monitor.predicted_readings import PredictedReadings
from tuning.identification.noise import compute_whitened_share, estimate_noise, fit_whitening_filter
from tuning.identification.records import LoggedRun

# Name, displayed unit, and factor from the SI unit to it.
METRICS = (
    ("stiffness", "%", 100.0),  # change of the force in phase with the depth, relative to the file
    ("apparent damping", "N s/m", 1.0),  # change in phase with the rate: damping and force delay combined
    ("mean force", "N", 1.0),  # change of the mean in contact
    ("restitution", "1", 1.0),  # of the log minus that of the file under the same command
    ("bias", "N", 1.0),  # change of the mean out of contact
    ("noise", "%", 100.0),  # change of the force noise, relative to the file
    ("lag of motion", "ms", 1e3),  # delay of the measured position behind that of the file
)
METRIC_NAMES = tuple(name for name, _, _ in METRICS)
BIAS_INDEX, NOISE_INDEX, LAG_INDEX = (METRIC_NAMES.index(name) for name in ("bias", "noise", "lag of motion"))
FORCE_METRICS = slice(0, NOISE_INDEX)  # metrics that are sums of forces
MIN_METRIC_ROWS = 20  # rows that a metric needs
MAX_NOISE_ROWS = 2000  # rows at rest that determine the noise's colour
MIN_MODEL_ERROR = 1e-3  # least model error over the largest force or depth
ONSET_MARGIN_SIGMAS = 3.0  # standard deviations of delays and plane, within which an onset is uncertain
DEEP_CONTACT_SHARE = 0.1  # share of the greatest depth, beyond which rows are always used


@dataclass(frozen=True)
class MetricWeights:
    """Weights of one contact's readings in its metrics."""

    force: np.ndarray  # (metrics except noise and lag, rows); NaN in the row of a missing metric
    position: np.ndarray  # (rows,)
    rest: np.ndarray  # bool, (rows,), rows out of contact

    def shift(self, force: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the change of the metrics for changes of the force [N] and position readings [m]."""
        result = np.zeros(len(METRIC_NAMES))
        result[FORCE_METRICS] = self.force @ force
        result[LAG_INDEX] = self.position @ position
        return result


@dataclass(frozen=True)
class ForceSensorSpec:
    """Noise of the force sensor in the file, and its limits."""

    std: float  # N
    quantum: float  # N
    dead_zone: float  # N
    range: float  # N
    time_constant: float  # s


def compute_weights(
    run: LoggedRun,
    expected: PredictedReadings,
    lane: int,
    sensors: ForceSensorSpec,
    slack: tuple[float, float],
    mass: float,
    period: float,
) -> MetricWeights:
    """Return the weights of a run's readings.

    `slack` holds the standard deviations of the delays [s] and of the surface [m].
    """
    rows = len(run.tick)
    parts = (expected.depth, expected.touching, expected.rate, expected.elastic, expected.force)
    depth, touching, rate, elastic, force = (part[:rows, lane] for part in parts)
    measured = np.asarray(run.force_measured, float)
    read = run.valid & np.isfinite(measured)
    speed = np.max(np.abs(np.gradient(depth, period)))
    # A lag extends the onset by some of its time constants.
    margin = (
        ONSET_MARGIN_SIGMAS * (slack[0] + sensors.time_constant) + period
    ) * speed + ONSET_MARGIN_SIGMAS * slack[1]
    margin = min(margin, DEEP_CONTACT_SHARE * max(float(depth.max()), 0.0))
    used = read & (depth > margin) & (touching > 0.5) & (np.abs(measured) < sensors.range)
    if sensors.dead_zone:
        used &= np.abs(force) > 4.0 * sensors.std
    rest = read & (depth < -margin) & (touching < 1e-6) & (sensors.dead_zone == 0.0)
    table = np.full((NOISE_INDEX, rows), np.nan)
    tare = rest / max(rest.sum(), 1)
    if rest.sum() >= MIN_METRIC_ROWS:
        table[BIAS_INDEX] = tare
    if used.sum() >= MIN_METRIC_ROWS:
        columns = np.stack([elastic, rate])[:, used]
        size = np.linalg.norm(columns, axis=1)
        table[:BIAS_INDEX] = 0.0
        table[:2, used] = np.linalg.pinv((columns / size[:, None]).T) / size[:, None]
        table[2, used] = 1.0 / used.sum()
        table[3] = _compute_restitution_weights(run, used, mass, period)
        # Subtract the mean out of contact.
        table[:BIAS_INDEX] -= table[:BIAS_INDEX].sum(axis=1, keepdims=True) * tare
    return MetricWeights(table, _compute_delay_weights(run, expected, lane), rest)


def _compute_restitution_weights(run: LoggedRun, used: np.ndarray, mass: float, period: float) -> np.ndarray:
    """Return the weights of the restitution.

    By momentum and energy, an additional force r changes e by -(sum of r v T)/(M v_0 |v_1|).
    """
    x = run.position_desired
    speed = np.gradient(x, period) if run.velocity_desired is None else run.velocity_desired
    before, after = float(speed[0]), float(speed[-1])
    if before <= 0.0 or after >= -0.05 * before:
        return np.full(len(x), np.nan)
    return used * -speed * period / (mass * before * abs(after))


def _compute_delay_weights(run: LoggedRun, expected: PredictedReadings, lane: int) -> np.ndarray:
    """Return the weights of the position's delay, which are independent of a constant offset."""
    velocity = expected.velocity[: len(run.tick), lane]
    read = run.valid & np.isfinite(run.position_measured)
    varied = np.where(read, velocity - velocity[read].mean(), 0.0)
    power = float(varied @ varied)
    return -varied / power if read.sum() >= MIN_METRIC_ROWS and power > 0.0 else np.full(len(read), np.nan)


@dataclass
class NoiseColour:
    """Colour of the noise, from the rows at rest of all contacts so far."""

    rows: np.ndarray

    def factor(self, more: np.ndarray) -> float:
        """Add rows, and return the standard deviation of a mean over that of a mean of white noise."""
        self.rows = np.concatenate([self.rows, more - more.mean()])[-MAX_NOISE_ROWS:]
        filter_ = fit_whitening_filter(self.rows)
        return float(np.sqrt(compute_whitened_share(filter_)) / abs(np.sum(filter_)))


def compute_metrics(
    run: LoggedRun, expected: PredictedReadings, lane: int, weights: MetricWeights, sensors: ForceSensorSpec,
    colours: tuple[NoiseColour, NoiseColour],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the metrics of a contact and their covariance due to noise; NaN marks a missing metric.

    `colours` are those of force and position; they are updated.
    """
    rows = len(run.tick)
    parts = (expected.force, expected.position, expected.velocity, expected.depth)
    force, position, velocity, depth = (part[:rows, lane] for part in parts)
    force_error = np.nan_to_num(np.asarray(run.force_measured, float) - force)
    late = np.nan_to_num(run.position_measured - position)
    value = weights.shift(force_error, late)
    value[NOISE_INDEX], unsure, std = _compute_noise_metric(force_error[weights.rest], sensors, colours[0])
    left = late - late.mean() + value[LAG_INDEX] * (velocity - velocity.mean())
    scatter = float(left.std()) * colours[1].factor(left) if np.isfinite(value[LAG_INDEX]) else np.nan
    covariance = np.zeros((len(METRIC_NAMES), len(METRIC_NAMES)))
    covariance[FORCE_METRICS, FORCE_METRICS] = (
        max(std, MIN_MODEL_ERROR * np.abs(force).max()) ** 2 * weights.force @ weights.force.T
    )
    covariance[NOISE_INDEX, NOISE_INDEX] = unsure**2
    covariance[LAG_INDEX, LAG_INDEX] = (
        max(scatter, MIN_MODEL_ERROR * depth.max()) ** 2 * weights.position @ weights.position
    )
    return value, covariance


def _compute_noise_metric(
    rest: np.ndarray, sensors: ForceSensorSpec, colour: NoiseColour
) -> tuple[float, float, float]:
    """Return the metric of the force noise, its standard deviation, and the noise level [N] for sums."""
    stated = float(np.hypot(sensors.std, sensors.quantum / np.sqrt(12.0)))
    if len(rest) < MIN_METRIC_ROWS:
        return np.nan, np.nan, stated
    noise = estimate_noise(rest)
    if noise.silent:
        return np.nan, np.nan, stated
    spread = float(np.hypot(noise.std, noise.quantum / np.sqrt(12.0))) * colour.factor(rest)
    if sensors.std == 0.0:
        return np.nan, np.nan, spread
    return noise.std / sensors.std - 1.0, noise.std_std / sensors.std, spread
