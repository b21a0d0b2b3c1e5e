"""Predicted readings of a mechanism file's rig under the logged commands; nothing is fitted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

from jaxhil.errors import InputError
from jaxhil.mechanism.structs import Mechanism
from tuning.identification.contact_laws import Law
from tuning.identification.mechanism_models import (
    get_regression_coefficients,
    make_motion_model,
    make_regression_law,
)
from tuning.identification.motion import MotionResponse
from tuning.identification.rational import MotionModel
from tuning.identification.records import CampaignTiming, LoggedRun
from tuning.identification.sensor_filter import compute_lag_weights


@dataclass(frozen=True)
class PredictedReadings:
    """Predicted readings without noise, (rows, lanes); shorter runs are padded."""

    force: np.ndarray  # N, including bias and dead zone
    elastic: np.ndarray  # N, part that does not depend on the rate
    rate: np.ndarray  # m/s, rate of the depth; 0 out of contact
    touching: np.ndarray  # 1 in contact, 0 out of contact; values between with a sensor lag
    depth: np.ndarray  # m, at the time of the force
    position: np.ndarray  # m
    velocity: np.ndarray  # m/s, rate of the position that is read


def simulate_motion(
    mechanism: Mechanism, runs: Sequence[LoggedRun], timing: CampaignTiming, slack: float
) -> MotionResponse:
    """Return the response of the rig's motion simulator to the commands of runs.

    `slack` [s] is the amount by which the sensors' delays may exceed the file's.

    Raises:
        InputError: If G has direct feedthrough.
    """
    rig, model = mechanism.rig, make_motion_model(mechanism)
    above, below = model.fraction
    if len(above) == len(below) > 1:
        allowed = "fewer coefficients than in the denominator"
        raise InputError(f"rig.simulator.numerator: found {len(above)} coefficients, expected {allowed}")
    # The force does not depend on the position sensor's delay.
    model = MotionModel(model.structure, np.append(model.parameters[:-1], rig.simulator.delay))
    longest = max(rig.force_sensor.delay, rig.position_sensor.delay) + slack + timing.control_period
    return MotionResponse(model, runs, timing, longest)


def predict_readings(
    mechanism: Mechanism, runs: Sequence[LoggedRun], motion: MotionResponse
) -> PredictedReadings:
    """Return the predicted readings of runs with at most one contact each.

    Raises:
        InputError: If the contact law cannot be compared with a log.
    """
    rig, sensor, period = mechanism.rig, mechanism.rig.force_sensor, motion.period
    law = make_regression_law(mechanism.contact)
    if np.isfinite(mechanism.contact.clearance):
        finding = f"found {mechanism.contact.clearance:g}"
        raise InputError(f"contact.clearance: {finding}, expected inf: one surface")
    table = np.array(
        [get_regression_coefficients(mechanism.contact, find_contact_entry(run)) for run in runs]
    ).T
    # A lag integrates the force from row to row.
    parts = (0.0,) if sensor.time_constant == 0.0 else (0.0, 0.5)
    moved = [motion.at(sensor.delay + part * period) for part in parts]
    columns = [_compute_force_columns(law, table, x - rig.contact_plane, v) for x, v in moved]
    force, elastic, rate, touching = _apply_sensor_lag(columns, period, sensor.time_constant)
    force = force + sensor.bias
    force = np.sign(force) * np.maximum(np.abs(force) - sensor.dead_zone, 0.0)
    position, velocity = motion.at_row_times().at(rig.position_sensor.delay)
    return PredictedReadings(
        force, elastic, rate, touching, moved[0][0] - rig.contact_plane, position, velocity
    )


def find_contact_entry(run: LoggedRun) -> int:
    """Return the index in the contact lists for a run's contact."""
    if run.contact_index is None or run.force_measured is None:
        return 0
    return max(int(run.contact_index[np.argmax(np.abs(np.nan_to_num(run.force_measured)))]), 0)


def _compute_force_columns(law: Law, table: np.ndarray, depth: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return force, force at zero rate, rate, and a contact flag; all are 0 out of contact."""
    inside = np.maximum(depth, 0.0)

    def force(v):
        return sum(c * column for c, column in zip(table, law.entry_functions(inside, v), strict=True))

    total = force(rate)
    touching = (depth > 0.0) & (law.pulls | (total > 0.0))
    return touching * np.array([total, force(np.zeros_like(rate)), rate, np.ones_like(rate)])


def _apply_sensor_lag(columns: list[np.ndarray], period: float, time_constant: float) -> np.ndarray:
    """Return the columns after a first-order lag, from values at every row and half a period earlier."""
    if time_constant == 0.0:
        return columns[0]
    pole, (now, half, last) = compute_lag_weights(period / time_constant)
    drive = now * columns[0] + half * columns[1]
    drive[:, 1:] += last * columns[0][:, :-1]
    lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=1)
    return lagged
