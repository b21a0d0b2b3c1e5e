"""Calibration of the limits of a six-axis gain file, and the watchdog's rates of false and missed alarms.

Runs of drawn scenarios are recorded. A run is good if its contacts end well and its twist error is at most
half of the error limit. The error limit is that of the sweep whose scenarios are recorded or, without a
sweep, `ERROR_LIMIT`. One part of the runs determines the watchdog's limits: the extreme signals of its good
runs times a margin. The other part is replayed through the rig's controller with these limits. An alarm in a
good run is false. A missed alarm is a run without an alarm, although its error exceeds the error limit or the
mass of the numerical model is wrong. The runs with a wrong mass are repetitions of good runs.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxhil.laws.shared.nominal_values import BIAS_WALK_TIME
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.gain_file import SixAxisGainFile, check_six_axis_document
from jaxhil.rig.six_axes.limits import NO_SIX_AXIS_LIMITS, SIX_AXIS_LIMITS, complete_six_axis_limits
from jaxhil.rig.six_axes.vectors import COORDINATES
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.sixdof.controller_record import ControllerRecord
from jaxhil.sixdof.rollout import CAPTURED, REBOUNDED
from tuning.statistics.intervals import binomial_interval
from tuning.sweeps.draws import draw_values
from tuning.sweeps.store import SweepStore
from tuning.verification.six_axis_replay import (
    build_drawn_scenarios,
    draw_scenarios,
    record_scenarios,
    replay_record,
    replay_ticks,
)
from tuning.watchdog.calibration import Calibration, choose_error_limit, choose_scenarios
from tuning.watchdog.recording import ScenarioSelection
from tuning.watchdog.verdict import DEFAULT_ALLOWED_RATES, AllowedAlarmRates, add_verdict

# Number of draws (of a sweep at most its first ones); enough for a false-alarm rate of 1 % if 75 % are good.
SIX_AXIS_DRAWS = 512
LANES = 128  # number of scenarios that are recorded together
FITTED_SHARE = 4  # every fourth run determines the limits
ERROR_LIMIT = 0.1  # maximum twist error [1]; the watchdog should stop a run with a larger error
MARGIN = 1.5  # limit divided by the extreme signal of good runs [1]
TICKS_IN_A_ROW = 3.0  # maximum number of successive ticks with a bad reading, a missed tick or a limited rate
TARE_TIME = 0.1  # duration of the tare [s]
SETTLING = 0.03  # time from the last reading in contact to the audit [s]
SIGMAS = 12.0  # allowed spread of a tare's readings, divided by the noise's standard deviation
MIN_RETREAT = 0.005  # length of the retreat after a trip, minus the largest distance from the start [m]
MIN_DISTANCE = 1e-4  # lower bound of the limits of distances and angles [m, rad]
WATCHDOG_LIMITS = {"momentum_error": 0.05, "energy_gain": 0.1, "unpaid_impulse": 0.1}  # lower bounds [1]
LAG_RANGE = 0.5, 2.0  # lag limits, divided by the smallest and the largest lag in good runs
WRONG_MASS = 1.2  # mass matrix of the injected fault, divided by the model's mass matrix


class DrawnRun(NamedTuple):
    """Recorded run of a drawn scenario."""

    record: ControllerRecord
    error: float  # twist error [1]; NaN if the contacts have not ended
    good: bool  # whether every contact ends with an error of at most half of the limit


def calibrate_six_axes(
    loaded: LoadedGains,
    store: SweepStore | None = None,
    replaced: Mapping[str, float | None] | None = None,
    allowed: AllowedAlarmRates = DEFAULT_ALLOWED_RATES,
    progress: Callable[[int], None] = lambda runs: None,
    scenarios: int = SIX_AXIS_DRAWS,
    seed: int = 1,
) -> Calibration:
    """Calibrate the limits of a six-axis gain file, and estimate the rates of false and missed alarms.

    Args:
        loaded: gain file.
        store: sweep of this gain file whose first scenarios are simulated again. None: draw new scenarios.
        replaced: limits by name, used instead of the calibrated limits, also to estimate the alarm rates;
            None removes a limit.
        allowed: maximum acceptable alarm rates.
        progress: callback, called with the number of runs that have been completed since its last call.
        scenarios: number of draws; with a sweep, the largest number of its scenarios that are simulated.
        seed: seed of the draws without a sweep.

    Raises:
        InputError: If the sweep used another gain file.
    """
    gain_file = check_six_axis_document(loaded.document)
    chosen = None
    if store is not None:
        chosen = choose_scenarios(loaded, store, None)
        chosen = chosen._replace(number=min(chosen.number, scenarios))
        scenarios, seed = chosen.number, chosen.seed
    limit = choose_error_limit(None, store, ERROR_LIMIT)
    runs = _record(loaded, scenarios, seed, chosen, limit, progress)
    fitted = [run for index, run in enumerate(runs) if index % FITTED_SHARE == 0]
    used = [run for run in fitted if run.good] or [run for run in fitted if np.isfinite(run.error)] or fitted
    limits = signal_limits([run.record for run in used], gain_file.control_period, loaded.mechanism)
    limits |= audit_limits(gain_file, [run.record for run in used], limits["fading"])
    plain = {name: float(value) for name, value in limits.items()}
    final = {name: plain.get(name) for name in SIX_AXIS_LIMITS} | dict(replaced or {})
    held_out = [run for index, run in enumerate(runs) if index % FITTED_SHARE]
    rates = alarm_rates(gain_file, final, held_out, limit)
    rates = add_verdict(rates, allowed, scenarios)
    rates["calibrated_on"] = {
        "runs": "good" if used[0].good else "ended",
        "number": len(used),
        "seed": seed,
        "sampling": "random" if chosen is None else chosen.sampling,
        "sweep_sha256": None if store is None else store.manifest.sha256,
    }
    return Calibration(final, rates)


def _record(
    loaded: LoadedGains,
    scenarios: int,
    seed: int,
    chosen: ScenarioSelection | None,
    limit: float,
    progress: Callable[[int], None],
) -> list[DrawnRun]:
    """Record runs of new random draws or, if `chosen` is given, of the first scenarios of a sweep."""
    runs, mechanism = [], loaded.mechanism
    for first in range(0, scenarios, LANES):
        number = min(LANES, scenarios - first)
        if chosen is None:
            batch = draw_scenarios(mechanism, number, seed + first)
        else:
            draws = draw_values(mechanism, chosen.sampling, seed, first, number)
            batch = build_drawn_scenarios(mechanism, draws, seed, first)
        metrics, records = record_scenarios(mechanism, loaded.compensator, loaded.gains, batch)
        ended = np.isin(np.asarray(metrics.status)[0], (REBOUNDED, CAPTURED))
        errors = np.where(ended, np.asarray(metrics.twist_error)[0], np.nan)
        runs += [
            DrawnRun(record, float(error), bool(error <= 0.5 * limit))
            for record, error in zip(records, errors, strict=True)
        ]
        progress(number)
    return runs


def signal_limits(records: list[ControllerRecord], period: float, mechanism: Any) -> dict[str, float]:
    """Compute the limits of readings, commands and durations from the extreme signals of recorded runs."""
    sensor = mechanism.rig.force_sensor
    drift = np.array(sensor.bias_random_walk)
    force, torque = slice(0, 3), slice(3, 6)
    limits = {
        "held_readings": TICKS_IN_A_ROW,
        "limited_in_a_row": TICKS_IN_A_ROW,
        "missed_in_a_row": TICKS_IN_A_ROW,
        "settling": SETTLING,
        "tare_ticks": float(np.ceil(TARE_TIME / period)),
    }
    for kind, part in (("force", force), ("torque", torque)):
        reading = _largest(np.max(np.abs(record.wrench[:, part])) for record in records)
        command = _largest(np.max(np.abs(record.command[:, part])) for record in records)
        slew = _largest(np.max(np.abs(np.diff(record.command[:, part], axis=0))) for record in records)
        steady = np.hypot(sensor.noise_std[part], sensor.quantum[part])
        noise = max(np.hypot(steady, drift[part] * TARE_TIME**0.5))
        limits[f"{kind}_range"] = MARGIN * reading + SIGMAS * noise
        limits[f"{kind}_limit"] = MARGIN * max(command, reading)
        limits[f"{kind}_slew"] = MARGIN * max(slew, 0.1 * command) / period
        limits[f"tare_{kind}_spread"] = SIGMAS * noise + 0.01 * reading
        limits[f"{kind}_bias_limit"] = SIGMAS * noise + 0.05 * reading
    noise = max(5.0 * np.array(sensor.noise_std[force]) + 3.0 * BIAS_WALK_TIME**0.5 * drift[force])
    limits["fading"] = max(float(noise), 0.01 * limits["force_range"])
    return limits | _motion_limits(records, period)


def _motion_limits(records: list[ControllerRecord], period: float) -> dict[str, float]:
    """Return the limits of the measured and the commanded motion, and of the retreat after a trip."""
    limits = {}
    for name, column in (("measured", 3), ("command", 5)):
        lowest = np.min([np.min(record[column], axis=0) for record in records], axis=0)
        highest = np.max([np.max(record[column], axis=0) for record in records], axis=0)
        room = (MARGIN - 1) * (highest - lowest) + 0.001
        for axis, low, high in zip(COORDINATES, lowest - room, highest + room, strict=True):
            limits[f"{name}_lowest_{axis}"], limits[f"{name}_highest_{axis}"] = float(low), float(high)
    for prefix, part, angular in (("", slice(0, 3), ""), ("angular_", slice(3, 6), "angular_")):
        steps = [np.diff(record.sent[:, part], axis=0) for record in records]
        speed = _largest(np.max(np.linalg.norm(step, axis=1)) for step in steps) / period
        bends = (np.diff(step, axis=0) for step in steps)
        slowing = _largest(np.max(np.linalg.norm(bend, axis=1), initial=0.0) for bend in bends) / period**2
        limits[f"{prefix}velocity_limit"] = MARGIN * max(speed, 1e-3)
        limits[f"{prefix}deceleration"] = MARGIN * max(slowing, 1e-2)
        limits[f"retreat_{angular}velocity"] = max(speed, 1e-3)
    starts = [record.sent[0] - record.pose_measured[0] for record in records]
    for name, part in (("start_distance", slice(0, 3)), ("start_angle", slice(3, 6))):
        limits[name] = MARGIN * _largest(np.linalg.norm(start[part]) for start in starts) + MIN_DISTANCE
    depth = _largest(np.max(np.linalg.norm((r.sent - r.sent[0])[:, :3], axis=1)) for r in records)
    limits["retreat_distance"] = MIN_RETREAT + depth
    limits |= _stuck_limits(records)
    longest = _largest(np.count_nonzero(np.any(r.command != 0, axis=1)) for r in records)
    limits["longest_contact"] = MARGIN * longest * period + SETTLING
    return limits


def _stuck_limits(records: list[ControllerRecord]) -> dict[str, float]:
    """Return the largest motions that are allowed while a reading stays unchanged [m, rad]."""
    travels, turns, under_force = [0.0], [0.0], [0.0]
    for record in records:
        moved = np.linalg.norm(np.diff(record.pose_measured[:, :3], axis=0), axis=1)
        desired = np.abs(np.diff(record.pose_desired, axis=0))
        for channel in range(6):
            still = (np.diff(record.wrench[:, channel]) == 0) & (record.wrench[1:, channel] != 0)
            under_force.append(longest_sum(moved, still))
            still = np.diff(record.pose_measured[:, channel]) == 0
            (travels if channel < 3 else turns).append(longest_sum(desired[:, channel], still))
    names = ("force_stuck_travel", "position_stuck_travel", "rotation_stuck_travel")
    values = (under_force, travels, turns)
    return {name: MARGIN * max(found) + MIN_DISTANCE for name, found in zip(names, values, strict=True)}


def longest_sum(steps: np.ndarray, still: np.ndarray) -> float:
    """Return the largest sum of motion `steps` over successive ticks with an unchanged reading (`still`)."""
    sums = np.cumsum(np.where(still, steps, 0.0))
    last_moved = np.maximum.accumulate(np.where(still, 0.0, sums))
    return float(np.max(sums - last_moved, initial=0.0))


def audit_limits(
    gain_file: SixAxisGainFile, records: list[ControllerRecord], fading: float
) -> dict[str, float]:
    """Return the limits of the contact audit, from replays in which `fading` [N] is the only limit.

    The limits are wide enough for all contacts, also for those that have not ended, such as a capture.
    """
    wide = {**NO_SIX_AXIS_LIMITS, "settling": SETTLING, "fading": fading}
    audits, lags = [], []
    for record in records:
        controller = Controller6(gain_file._replace(limits=wide))
        # The controller keeps the numbers of an audit until the next one.
        audits.append(np.max([controller.last_audit for _ in replay_ticks(controller, record)], axis=0))
        lags.append(controller.loop_delay)
        controller.next_contact()
        audits.append(controller.last_audit)
    largest = dict(zip(WATCHDOG_LIMITS, np.max(audits, axis=0).tolist(), strict=True))
    limits = {name: max(least, MARGIN * largest[name]) for name, least in WATCHDOG_LIMITS.items()}
    lags = [lag for lag in lags if lag > 0]
    if lags:
        limits["lag_lowest"], limits["lag_highest"] = LAG_RANGE[0] * min(lags), LAG_RANGE[1] * max(lags)
    return limits


def alarm_rates(
    gain_file: SixAxisGainFile,
    limits: Mapping[str, float | None],
    runs: list[DrawnRun],
    error_limit: float = ERROR_LIMIT,
) -> dict[str, Any]:
    """Return the rates of false and missed alarms if `limits` are used, with 95 % confidence intervals.

    The watchdog should stop the runs whose twist error is larger than `error_limit` [1].
    """
    values = {name: value for name, value in limits.items() if value is not None}
    limited = gain_file._replace(limits=complete_six_axis_limits(values))
    good = [run.record for run in runs if run.good]
    bad = [run.record for run in runs if not run.error <= error_limit]
    constants = gain_file.constants
    wrong = constants._replace(
        mass_matrix=[[WRONG_MASS * entry for entry in row] for row in constants.mass_matrix],
        inverse_mass=[[entry / WRONG_MASS for entry in row] for row in constants.inverse_mass],
    )
    missed = sum(not is_stopped(limited._replace(constants=wrong), record) for record in good)
    mass = {
        "meaning": "a numerical model with a wrong mass",
        "unit": "1",
        "size": WRONG_MASS - 1,
        "largest_size": WRONG_MASS - 1,
        "error": WRONG_MASS - 1,
        "scenarios": len(good),
        "counted": bool(good),
        **_rate(missed, len(good)),
    }
    return {
        "false_alarms": _rate(sum(is_stopped(limited, record) for record in good), len(good)),
        "missed_alarms": _rate(sum(not is_stopped(limited, record) for record in bad), len(bad)),
        "limit": error_limit,
        "held_out_runs": len(runs),
        "fault_runs": [mass],
    }


def is_stopped(gain_file: SixAxisGainFile, record: ControllerRecord) -> bool:
    """Return whether the controller trips in a recorded run, or at the audit after the run."""
    controller = Controller6(gain_file)
    replay_record(controller, record)
    controller.next_contact()
    return controller.tripped


def _rate(alarms: int, runs: int) -> dict[str, Any]:
    """Return the numbers of runs and alarms, with the exact 95 % confidence interval of their ratio."""
    interval = binomial_interval(alarms, runs)
    return {"runs": runs, "alarms": alarms, "low": float(interval.low), "high": float(interval.high)}


def _largest(values: Any) -> float:
    """Return the largest value as a float."""
    return float(max(values))
