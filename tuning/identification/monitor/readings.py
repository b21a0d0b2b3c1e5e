"""What the rig of a mechanism file would read under the commands of a log. Nothing is fitted here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter

from jaxhil.errors import InputError
from jaxhil.mechanism.structs import Mechanism
from tuning.identification.contact_laws import Law
from tuning.identification.known import coefficients, contact_law, motion_model
from tuning.identification.motion import Motion
from tuning.identification.rational import Model
from tuning.identification.records import Run, Timing
from tuning.identification.sensor_filter import lag_weights


@dataclass(frozen=True)
class Readings:
    """Without noise, (rows, lanes); a run shorter than the longest one is padded."""

    force: np.ndarray  # N, bias and dead zone included
    elastic: np.ndarray  # N, its part that does not depend on the rate
    rate: np.ndarray  # m/s, of the depth; 0 out of contact
    touching: np.ndarray  # 1 in contact, 0 out of it; between, where the sensor lags
    depth: np.ndarray  # m, when the force was
    position: np.ndarray  # m
    velocity: np.ndarray  # m/s, of the position that is read


def motion_of(mechanism: Mechanism, runs: Sequence[Run], timing: Timing, slack: float) -> Motion:
    """Of the rig's motion simulator under the commands of runs; `slack` [s]: by how much the sensors' delays
    may exceed the file's. Raises `InputError` for a G that passes some of the command at once."""
    rig, model = mechanism.rig, motion_model(mechanism)
    above, below = model.fraction
    if len(above) == len(below) > 1:
        allowed = "fewer coefficients than in the denominator"
        raise InputError(f"rig.simulator.numerator: found {len(above)} coefficients, allowed {allowed}")
    # The position sensor's delay is not the force's.
    model = Model(model.structure, np.append(model.parameters[:-1], rig.simulator.delay))
    longest = max(rig.force_sensor.delay, rig.position_sensor.delay) + slack + timing.control_period
    return Motion(model, runs, timing, longest)


def readings(mechanism: Mechanism, runs: Sequence[Run], motion: Motion) -> Readings:
    """Of runs with at most one contact each, and their motion. Raises `InputError` for a law that no log can
    be held against."""
    rig, sensor, period = mechanism.rig, mechanism.rig.force_sensor, motion.period
    law = contact_law(mechanism.contact)
    if np.isfinite(mechanism.contact.clearance):
        found = f"found {mechanism.contact.clearance:g}"
        raise InputError(f"contact.clearance: {found}, allowed inf: one surface")
    table = np.array([coefficients(mechanism.contact, entry(run)) for run in runs]).T
    # A lag integrates the force from row to row.
    parts = (0.0,) if sensor.time_constant == 0.0 else (0.0, 0.5)
    moved = [motion.at(sensor.delay + part * period) for part in parts]
    columns = [_columns(law, table, x - rig.contact_plane, v) for x, v in moved]
    force, elastic, rate, touching = _lagged(columns, period, sensor.time_constant)
    force = force + sensor.bias
    force = np.sign(force) * np.maximum(np.abs(force) - sensor.dead_zone, 0.0)
    position, velocity = motion.of_positions().at(rig.position_sensor.delay)
    return Readings(force, elastic, rate, touching, moved[0][0] - rig.contact_plane, position, velocity)


def entry(run: Run) -> int:
    """Which entry of the contact lists a run's contact meets."""
    if run.contact_index is None or run.force_measured is None:
        return 0
    return max(int(run.contact_index[np.argmax(np.abs(np.nan_to_num(run.force_measured)))]), 0)


def _columns(law: Law, table: np.ndarray, depth: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Force, its part at no rate, rate and 1 where there is contact; 0 elsewhere."""
    inside = np.maximum(depth, 0.0)

    def force(v):
        return sum(c * one for c, one in zip(table, law.own(inside, v), strict=True))

    total = force(rate)
    touching = (depth > 0.0) & (law.pulls | (total > 0.0))
    return touching * np.array([total, force(np.zeros_like(rate)), rate, np.ones_like(rate)])


def _lagged(columns: list[np.ndarray], period: float, time_constant: float) -> np.ndarray:
    """Columns at every row, and half a period before it, as a first-order lag gives them."""
    if time_constant == 0.0:
        return columns[0]
    pole, (now, half, last) = lag_weights(period / time_constant)
    drive = now * columns[0] + half * columns[1]
    drive[:, 1:] += last * columns[0][:, :-1]
    lagged: Any = lfilter([1.0], [1.0, -pole], drive, axis=1)
    return lagged
