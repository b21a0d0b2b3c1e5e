"""Seven metrics that compare one contact with the mechanism file; their mean is 0 if the file is correct.

All metrics except the noise metric are weighted sums of the differences between measured and predicted
readings. Their variance and their sensitivity to each parameter are therefore known. Readings near the onset
of contact are not used, because the force of damped contact jumps there, and the time of the jump is
uncertain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tuning.identification.monitor.predicted_readings import PredictedReadings
from tuning.identification.noise import compute_whitened_share, estimate_noise, fit_whitening_filter
from tuning.identification.records import LoggedRun

# Name, displayed unit, and factor that converts SI units to the displayed unit.
METRICS = (
    ("stiffness", "%", 100.0),  # relative change of the force that is in phase with the depth
    ("apparent damping", "N s/m", 1.0),  # change of the force in phase with the rate: damping or force delay
    ("mean force", "N", 1.0),  # change of the mean force in contact
    ("restitution", "1", 1.0),  # measured minus predicted restitution, for the same commands
    ("bias", "N", 1.0),  # change of the mean force reading out of contact
    ("noise", "%", 100.0),  # relative change of the force noise
    ("lag of motion", "ms", 1e3),  # delay of the measured position relative to the prediction
)
METRIC_NAMES = tuple(name for name, _, _ in METRICS)
BIAS_INDEX, NOISE_INDEX, LAG_INDEX = (METRIC_NAMES.index(name) for name in ("bias", "noise", "lag of motion"))
FORCE_METRICS = slice(0, NOISE_INDEX)  # metrics that are weighted sums of force readings
MIN_METRIC_ROWS = 20  # minimum number of readings for a metric
MAX_NOISE_ROWS = 2000  # maximum number of readings that determine the autocorrelation of the noise
MIN_MODEL_ERROR = 1e-3  # assumed minimum error of predicted readings as a share of the largest force or depth
ONSET_MARGIN_SIGMAS = 3.0  # width of the omitted range at an onset, in std of delays and surface position
DEEP_CONTACT_SHARE = 0.1  # maximum depth of omitted rows as a share of the largest depth


@dataclass(frozen=True)
class MetricWeights:
    """Weights of one contact's readings: each metric, except the noise, is a weighted sum of them."""

    # (metrics, rows), weights of the force readings in the first five metrics; NaN for a missing metric
    force: np.ndarray
    position: np.ndarray  # (rows,), weights of the position readings in the metric "lag of motion"
    rest: np.ndarray  # bool, (rows,), rows out of contact

    def shift(self, force: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the change of each metric if `force` [N] and `position` [m] are added to the readings."""
        result = np.zeros(len(METRIC_NAMES))
        result[FORCE_METRICS] = self.force @ force
        result[LAG_INDEX] = self.position @ position
        return result


@dataclass(frozen=True)
class ForceSensorSpec:
    """Properties of the force sensor according to the mechanism file."""

    std: float  # standard deviation of the noise [N]
    quantum: float  # N
    dead_zone: float  # N
    range: float  # N
    time_constant: float  # first-order lag [s]


def compute_weights(
    run: LoggedRun,
    expected: PredictedReadings,
    lane: int,
    sensors: ForceSensorSpec,
    slack: tuple[float, float],
    mass: float,
    period: float,
) -> MetricWeights:
    """Compute the weights of the readings in the metrics of a run's contact.

    Args:
        run: The run.
        expected: Predicted readings of several runs.
        lane: Index of the run in the predicted readings.
        sensors: Properties of the force sensor.
        slack: Standard deviations of the delays [s] and of the surface position [m].
        mass: Equivalent mass of the numerical model [kg].
        period: Control period [s].
    """
    rows = len(run.tick)
    parts = (expected.depth, expected.touching, expected.rate, expected.elastic, expected.force)
    depth, touching, rate, elastic, force = (part[:rows, lane] for part in parts)
    measured = np.asarray(run.force_measured, float)
    read = run.valid & np.isfinite(measured)
    speed = np.max(np.abs(np.gradient(depth, period)))
    # A lag of the sensor prolongs the onset by some time constants.
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
        # All metrics of readings in contact refer to the mean reading out of contact.
        table[:BIAS_INDEX] -= table[:BIAS_INDEX].sum(axis=1, keepdims=True) * tare
    return MetricWeights(table, _compute_delay_weights(run, expected, lane), rest)


def _compute_restitution_weights(run: LoggedRun, used: np.ndarray, mass: float, period: float) -> np.ndarray:
    """Return the weights of the force readings in the metric "restitution"; NaN if there is no rebound.

    By the balance of momentum and energy, an additional force r changes the restitution by -(sum of r v T) /
    (M v_0 |v_1|), with the speed v (v_0 before, v_1 after the contact), period T and mass M.
    """
    x = run.position_desired
    speed = np.gradient(x, period) if run.velocity_desired is None else run.velocity_desired
    before, after = float(speed[0]), float(speed[-1])
    if before <= 0.0 or after >= -0.05 * before:
        return np.full(len(x), np.nan)
    return used * -speed * period / (mass * before * abs(after))


def _compute_delay_weights(run: LoggedRun, expected: PredictedReadings, lane: int) -> np.ndarray:
    """Return the weights of the position readings in the metric "lag of motion": their delay [s]."""
    velocity = expected.velocity[: len(run.tick), lane]
    read = run.valid & np.isfinite(run.position_measured)
    varied = np.where(read, velocity - velocity[read].mean(), 0.0)
    power = float(varied @ varied)
    return -varied / power if read.sum() >= MIN_METRIC_ROWS and power > 0.0 else np.full(len(read), np.nan)


@dataclass
class NoiseColour:
    """Autocorrelation of a sensor's noise, estimated from the latest readings."""

    rows: np.ndarray  # latest readings, without their mean

    def extend(self, more: np.ndarray) -> float:
        """Add readings; return the factor by which autocorrelation increases the standard error of a mean."""
        self.rows = np.concatenate([self.rows, more - more.mean()])[-MAX_NOISE_ROWS:]
        filter_ = fit_whitening_filter(self.rows)
        return float(np.sqrt(compute_whitened_share(filter_)) / abs(np.sum(filter_)))


def compute_metrics(
    run: LoggedRun, expected: PredictedReadings, lane: int, weights: MetricWeights, sensors: ForceSensorSpec,
    colours: tuple[NoiseColour, NoiseColour],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the metrics of a contact, and their covariance due to noise; NaN marks a missing metric.

    Args:
        run: Run with the contact.
        expected: Predicted readings of several runs.
        lane: Index of the run in the predicted readings.
        weights: Weights of the readings in the metrics.
        sensors: Properties of the force sensor.
        colours: Autocorrelations of the force and position noise, which are updated with this run.
    """
    rows = len(run.tick)
    parts = (expected.force, expected.position, expected.velocity, expected.depth)
    force, position, velocity, depth = (part[:rows, lane] for part in parts)
    force_error = np.nan_to_num(np.asarray(run.force_measured, float) - force)
    position_error = np.nan_to_num(run.position_measured - position)
    value = weights.shift(force_error, position_error)
    value[NOISE_INDEX], noise_std, std = _compute_noise_metric(force_error[weights.rest], sensors, colours[0])
    residual = position_error - position_error.mean() + value[LAG_INDEX] * (velocity - velocity.mean())
    scatter = float(residual.std()) * colours[1].extend(residual) if np.isfinite(value[LAG_INDEX]) else np.nan
    covariance = np.zeros((len(METRIC_NAMES), len(METRIC_NAMES)))
    covariance[FORCE_METRICS, FORCE_METRICS] = (
        max(std, MIN_MODEL_ERROR * np.abs(force).max()) ** 2 * weights.force @ weights.force.T
    )
    covariance[NOISE_INDEX, NOISE_INDEX] = noise_std**2
    covariance[LAG_INDEX, LAG_INDEX] = (
        max(scatter, MIN_MODEL_ERROR * depth.max()) ** 2 * weights.position @ weights.position
    )
    return value, covariance


def _compute_noise_metric(
    rest: np.ndarray, sensors: ForceSensorSpec, colour: NoiseColour
) -> tuple[float, float, float]:
    """Return the relative change of the noise, its standard deviation, and the noise level [N].

    The noise level determines the covariance of the force metrics. It is the standard deviation of a
    reading times the factor of `NoiseColour.extend`. If readings show no noise, the mechanism file gives it.
    """
    stated = float(np.hypot(sensors.std, sensors.quantum / np.sqrt(12.0)))
    if len(rest) < MIN_METRIC_ROWS:
        return np.nan, np.nan, stated
    noise = estimate_noise(rest)
    if noise.silent:
        return np.nan, np.nan, stated
    spread = float(np.hypot(noise.std, noise.quantum / np.sqrt(12.0))) * colour.extend(rest)
    if sensors.std == 0.0:
        return np.nan, np.nan, spread
    return noise.std / sensors.std - 1.0, noise.std_std / sensors.std, spread
