"""Prediction of the sensor readings from a mechanism file and the logged commands, without a fit."""

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
    """Predicted sensor readings of several runs, without noise.

    Arrays have the shape (rows, lanes), with one run per lane; shorter runs are padded.
    """

    force: np.ndarray  # force reading, including bias and dead zone [N]
    elastic: np.ndarray  # force reading for a depth with rate 0 [N]
    rate: np.ndarray  # rate of the depth after the delay and lag of the force sensor [m/s]; 0 out of contact
    # 1 in contact, 0 out of contact; a lag of the sensor gives values between 0 and 1 at onset and release
    touching: np.ndarray
    depth: np.ndarray  # penetration at the time of the force reading [m]; negative out of contact
    position: np.ndarray  # position reading [m]
    velocity: np.ndarray  # rate of the position reading [m/s]


def simulate_motion(
    mechanism: Mechanism, runs: Sequence[LoggedRun], timing: CampaignTiming, slack: float
) -> MotionResponse:
    """Compute the response of the rig's motion simulator to the logged commands.

    Args:
        mechanism: Mechanism with the motion simulator.
        runs: Runs, one per lane.
        timing: Timing of commands and readings.
        slack: Time [s] by which sensor delays in later predictions may exceed those of the mechanism.

    Raises:
        InputError: If the motion simulator's transfer function G(s) has direct feedthrough.
    """
    rig, model = mechanism.rig, make_motion_model(mechanism)
    above, below = model.fraction
    if len(above) == len(below) > 1:
        expected = "fewer coefficients than in the denominator"
        raise InputError(f"rig.simulator.numerator: found {len(above)} coefficients, expected {expected}")
    # Exclude the delay of the position sensor, which does not affect the force.
    model = MotionModel(model.structure, np.append(model.parameters[:-1], rig.simulator.delay))
    longest = max(rig.force_sensor.delay, rig.position_sensor.delay) + slack + timing.control_period
    return MotionResponse(model, runs, timing, longest)


def predict_readings(
    mechanism: Mechanism, runs: Sequence[LoggedRun], motion: MotionResponse
) -> PredictedReadings:
    """Predict the sensor readings of runs with at most one contact each.

    Args:
        mechanism: Mechanism with the contact law and the sensors.
        runs: Runs, one per lane.
        motion: Motion of the mechanism in these runs.

    Raises:
        InputError: If the contact law is not supported, or if there are two surfaces (finite clearance).
    """
    rig, sensor, period = mechanism.rig, mechanism.rig.force_sensor, motion.period
    law = make_regression_law(mechanism.contact)
    if np.isfinite(mechanism.contact.clearance):
        finding = f"found {mechanism.contact.clearance:g}"
        raise InputError(
            f"contact.clearance: {finding}, expected inf (only contact with one surface is supported)"
        )
    table = np.array(
        [get_regression_coefficients(mechanism.contact, find_contact_entry(run)) for run in runs]
    ).T
    # A lag integrates the force between two rows, so it also needs the force half a period before each row.
    parts = (0.0,) if sensor.time_constant == 0.0 else (0.0, 0.5)
    moved = [motion.at(sensor.delay + part * period) for part in parts]
    columns = [_compute_force_columns(law, table, x - rig.contact_plane, v) for x, v in moved]
    force, elastic, rate, touching = _apply_sensor_lag(columns, period, sensor.time_constant)
    force = force + sensor.bias
    beyond = np.abs(force) - sensor.dead_zone
    if sensor.dead_zone_kind == "cut":
        force = np.where(beyond > 0.0, force, 0.0)
    else:
        force = np.sign(force) * np.maximum(beyond, 0.0)
    position, velocity = motion.at_row_times().at(rig.position_sensor.delay)
    return PredictedReadings(
        force, elastic, rate, touching, moved[0][0] - rig.contact_plane, position, velocity
    )


def find_contact_entry(run: LoggedRun) -> int:
    """Return which entry of the parameter lists in `[contact]` belongs to the contact of a run."""
    if run.contact_index is None or run.force_measured is None:
        return 0
    return max(int(run.contact_index[np.argmax(np.abs(np.nan_to_num(run.force_measured)))]), 0)


def _compute_force_columns(law: Law, table: np.ndarray, depth: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the force, the force for rate 0, the rate, and a contact flag; all are 0 out of contact.

    Args:
        law: Contact law.
        table: Coefficients of the law, shape (coefficients, lanes).
        depth: Penetration [m], shape (rows, lanes).
        rate: Rate of the penetration [m/s], shape (rows, lanes).
    """
    inside = np.maximum(depth, 0.0)

    def force(v):
        return sum(c * column for c, column in zip(table, law.entry_functions(inside, v), strict=True))

    total = force(rate)
    touching = (depth > 0.0) & (law.pulls | (total > 0.0))
    return touching * np.array([total, force(np.zeros_like(rate)), rate, np.ones_like(rate)])


def _apply_sensor_lag(columns: list[np.ndarray], period: float, time_constant: float) -> np.ndarray:
    """Apply the first-order lag of the force sensor to signals.

    Args:
        columns: Signals at every row and, if there is a lag, half a period before every row.
        period: Control period [s].
        time_constant: Time constant of the lag [s]; 0 for none.
    """
    if time_constant == 0.0:
        return columns[0]
    pole, (now, half, last) = compute_lag_weights(period / time_constant)
    drive = now * columns[0] + half * columns[1]
    drive[:, 1:] += last * columns[0][:, :-1]
    lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=1)
    return lagged
