"""Monitor of a rig: detection of the contact after which the rig deviates from its mechanism file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from jaxhil.errors import InputError
from jaxhil.mechanism.structs import Mechanism
from tuning.identification.clock_drift import reject_separate_clocks
from tuning.identification.monitor.change_detection import ALARM_THRESHOLD, detect_changes
from tuning.identification.monitor.metric_filter import MetricFilter
from tuning.identification.monitor.metrics import (
    METRIC_NAMES,
    METRICS,
    ForceSensorSpec,
    NoiseColour,
    compute_metrics,
    compute_weights,
)
from tuning.identification.monitor.predicted_readings import (
    PredictedReadings,
    predict_readings,
    simulate_motion,
)
from tuning.identification.monitor.uncertain_parameters import UncertainParameter, list_uncertain_parameters
from tuning.identification.records import Campaign, CampaignTiming, LoggedRun
from tuning.identification.unmodelled_effects import reject_unmodelled_effects

RUNS_PER_BATCH = 64  # number of runs that are computed together
SENSOR_DELAY_KEYS = "rig.force_sensor.delay", "rig.position_sensor.delay"
ContactState = Literal["good", "watch", "bad"]


@dataclass(frozen=True)
class ContactDeviation:
    """Metrics of one contact and their deviation from the prediction.

    Arrays contain one value per metric, in SI units and in the order of `METRIC_NAMES`.

    Attributes:
        source: Name of the log file.
        value: Metrics; 0 means agreement with the mechanism file, NaN that the log does not show the metric.
        predicted_std: Predicted standard deviation of each metric.
        z: Normalised deviation: (value - predicted value) / `predicted_std`.
        state: "good" before any alarm; then "watch" if the uncertainty of the mechanism file explains the
            mean metrics since the change, else "bad".
    """

    source: str
    value: np.ndarray
    predicted_std: np.ndarray
    z: np.ndarray
    state: ContactState


@dataclass(frozen=True)
class MetricChange:
    """Metric for which an alarm was raised, averaged over the contacts since the change of the rig.

    Attributes:
        name: Name of the metric.
        value: Mean of the metric, in SI units; 0 if the rig agrees with the mechanism file.
        std: Standard deviation of this mean due to noise.
    """

    name: str
    value: float
    std: float


@dataclass(frozen=True)
class MonitorResult:
    """Result of monitoring the contacts of a campaign.

    Attributes:
        contacts: Metrics of each contact.
        alarm: Index of the contact at which the alarm was raised, or None.
        since: Index of the contact at which the change probably began, or None.
        changes: Changes of the metrics that raised an alarm; the most significant one comes first.
    """

    contacts: tuple[ContactDeviation, ...]
    alarm: int | None
    since: int | None
    changes: tuple[MetricChange, ...]

    @property
    def state(self) -> ContactState:
        return self.contacts[-1].state

    @property
    def verdict(self) -> str:
        number = len(self.contacts)
        if self.alarm is None or self.since is None:
            return f"Good: the rig agrees with the file in all of {number} contacts"
        causes = ", ".join(_describe_change(change) for change in self.changes)
        where = f"since contact {self.since + 1} of {number} ({self.contacts[self.since].source}): {causes}"
        if self.state == "watch":
            return f"Watch: {where}; the file's uncertainty covers it: identify again when convenient"
        return f"Bad: {where}; beyond the file's uncertainty: do not rely on gains tuned with it"


def _describe_change(change: MetricChange) -> str:
    _, unit, scale = METRICS[METRIC_NAMES.index(change.name)]
    shown = "" if unit == "1" else f" {unit}"
    return f"{change.name} {scale * change.value:+.3g}{shown} (+- {scale * change.std:.2g})"


def monitor_contacts(campaign: Campaign, mechanism: Mechanism) -> MonitorResult:
    """Compare the contacts of a campaign with a mechanism and detect changes of the rig.

    Args:
        campaign: Runs in the order of their contacts.
        mechanism: Mechanism of the rig, with its uncertainty.

    Raises:
        InputError: If the logs have no contact, or cannot be compared with the mechanism.
    """
    reject_separate_clocks(campaign.timing)
    runs = [run for run in campaign.runs if run.kind in ("contact", "tap") and run.force_measured is not None]
    if not runs:
        raise InputError("logs: found no contact, expected a run of kind contact or tap")
    reject_unmodelled_effects(mechanism)
    numbers, correlation = list_uncertain_parameters(mechanism)
    sensor = mechanism.rig.force_sensor
    prediction = MetricFilter(correlation, float(np.hypot(sensor.noise_std, sensor.quantum)))
    monitor = _MonitorState(prediction)
    for run, features in zip(runs, _compute_run_metrics(runs, mechanism, campaign, numbers), strict=True):
        monitor.add(run.source, *features)
    if not any(np.isfinite(contact.value[0]) for contact in monitor.contacts):
        text = f"found {mechanism.rig.contact_plane:g} m, which no contact in the logs exceeds"
        raise InputError(f"rig.contact_plane: {text}, expected the position at which the hardware touches")
    return monitor.outcome()


def _compute_run_metrics(
    runs: Sequence[LoggedRun], mechanism: Mechanism, campaign: Campaign, numbers: Sequence[UncertainParameter]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield each run's metrics, their derivatives (one column per parameter) and their noise covariance."""
    rig, timing = mechanism.rig, campaign.timing
    sensor = rig.force_sensor
    sensors = ForceSensorSpec(
        sensor.noise_std, sensor.quantum, sensor.dead_zone, sensor.range, sensor.time_constant
    )
    stds = {number.path: number.std for number in numbers}
    delay = np.hypot(stds["rig.simulator.delay"], stds["rig.force_sensor.delay"])
    slack = float(delay), stds.get("rig.contact_plane", 0.0)
    colours = NoiseColour(np.empty(0)), NoiseColour(np.empty(0))
    for begin in range(0, len(runs), RUNS_PER_BATCH):
        block = runs[begin : begin + RUNS_PER_BATCH]
        expected, stepped = _predict_with_sensitivities(mechanism, block, timing, numbers)
        for lane, run in enumerate(block):
            rows = len(run.tick)
            run_weights = compute_weights(
                run, expected, lane, sensors, slack, campaign.equivalent_mass, timing.control_period
            )
            slopes = [run_weights.shift(f[:rows, lane], x[:rows, lane]) for f, x in stepped]
            value, noise = compute_metrics(run, expected, lane, run_weights, sensors, colours)
            yield value, np.array(slopes).T, noise


def _predict_with_sensitivities(
    mechanism: Mechanism,
    runs: Sequence[LoggedRun],
    timing: CampaignTiming,
    numbers: Sequence[UncertainParameter],
) -> tuple[PredictedReadings, list[tuple[np.ndarray, np.ndarray]]]:
    """Return the predicted readings, and their changes if each parameter rises by its standard deviation."""
    slack = max(number.std for number in numbers if number.path in SENSOR_DELAY_KEYS)
    motion, differences = simulate_motion(mechanism, runs, timing, slack), []
    expected = predict_readings(mechanism, runs, motion)
    for parameter in numbers:
        stepped = parameter.step_parameter(mechanism)
        moved = (
            simulate_motion(stepped, runs, timing, slack)
            if parameter.path.startswith("rig.simulator.")
            else motion
        )
        read = predict_readings(stepped, runs, moved)
        differences.append((read.force - expected.force, read.position - expected.position))
    return expected, differences


class _MonitorState:
    """State of the monitor after the latest contact; after an alarm, `prediction` is not updated."""

    def __init__(self, prediction: MetricFilter):
        self.prediction = prediction
        self.measurements: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.contacts: list[ContactDeviation] = []
        self.alarm: int | None = None
        self.since = 0
        self.alarms = np.zeros(len(METRIC_NAMES), bool)  # metrics that raised an alarm

    def add(self, source: str, value: np.ndarray, slopes: np.ndarray, noise: np.ndarray) -> None:
        deviation, std = self.prediction.deviation(value, slopes, noise)
        self.measurements.append((value, slopes, noise))
        self.contacts.append(ContactDeviation(source, value, std, deviation / std, "good"))
        ratio, first_contact = detect_changes(np.array([contact.z for contact in self.contacts]))
        self.alarms |= ratio > ALARM_THRESHOLD
        if not self.alarms.any():
            self.prediction.learn(value, slopes, noise)
            return
        if self.alarm is None:
            # Keep the first estimate: if the rig drifts, a later estimate would be the time of the steepest
            # change.
            self.alarm, self.since = len(self.contacts) - 1, int(first_contact[np.argmax(ratio)])
        covered = self.prediction.covers(*self._mean())
        self.contacts[-1] = replace(self.contacts[-1], state="watch" if covered else "bad")

    def outcome(self) -> MonitorResult:
        if self.alarm is None:
            return MonitorResult(tuple(self.contacts), None, None, ())
        value, _, noise = self._mean()
        std = np.sqrt(np.diag(noise))
        order = sorted(np.flatnonzero(self.alarms), key=lambda i: -abs(value[i] / std[i]))
        result = tuple(MetricChange(METRIC_NAMES[i], float(value[i]), float(std[i])) for i in order)
        return MonitorResult(tuple(self.contacts), self.alarm, self.since, result)

    def _mean(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the mean metrics since the change, their mean derivatives, and their noise covariance."""
        values, slopes, noises = (
            np.array(part) for part in zip(*self.measurements[self.since :], strict=True)
        )
        number = np.isfinite(values).sum(axis=0)
        counted = np.maximum(number, 1)
        value = np.where(number > 0, np.nansum(values, axis=0) / counted, np.nan)
        return (
            value,
            np.nan_to_num(slopes).mean(axis=0),
            np.nansum(noises, axis=0) / np.outer(counted, counted),
        )
