"""Calibration of the limits of a gain file from recorded runs.

The scenarios of a sweep are simulated again and recorded. A run is good if no restitution error of its
contacts exceeds the sweep's limit. Some of the runs determine the watchdog's expected restitution and the
limits, which are the extreme signals of the good runs times a margin. The other runs determine the rates of
false and missed alarms, with exact intervals and a verdict.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxhil.errors import InputError
from jaxhil.laws.shared.nominal_values import BIAS_WALK_TIME, force_delay
from jaxhil.mechanism.uncertainty import draw_extremes
from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.limits import LIMITS
from jaxhil.rig.registry import COMPENSATORS
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.scenario import build_scenarios
from tuning.sweeps.store import SweepStore, read_intact_chunk
from tuning.watchdog.alarms import (
    EvaluatedRuns,
    compute_alarm_rates,
    evaluate_runs,
    extract_features,
    find_good_runs,
    find_reached_contacts,
)
from tuning.watchdog.audit import AuditRules
from tuning.watchdog.expectation import ContactFeatures, ExpectationFit, fit_expectation
from tuning.watchdog.fault_injection import compute_fault_rates
from tuning.watchdog.margin import choose_restitution_margin
from tuning.watchdog.recording import LANES_PER_RECORDING, ScenarioSelection, record_selection
from tuning.watchdog.signal_extremes import SignalExtremes
from tuning.watchdog.verdict import DEFAULT_ALLOWED_RATES, AllowedAlarmRates, add_verdict

LIMIT_MARGIN = 1.5  # limit divided by the extreme signal of good runs [1]
FITTED_RUNS = 2048  # number of runs that determine the limits; at least 1/16, at most 1/4 of all runs
MIN_FORCE_LIMIT_SHARE = 0.02  # smallest limit of a force, divided by the largest force reading [1]
DEFAULT_DRAWS = 2048  # number of draws without a sweep; enough for the false-alarm rate if 1/3 are good runs
DEFAULT_ERROR_LIMIT = 0.01  # limit of the restitution error without a sweep [1]
MAX_BAD_TICKS_IN_A_ROW = 3  # largest number of successive bad readings, missed ticks or limited rates
TARE_DURATION = 0.1  # duration of the tare [s]
FREE_APPROACH_TIME = 0.005  # time before a contact in which the mechanism is not in free flight [s]
MIN_BALANCE_LIMIT = 1e-6  # smallest limit of the relative energy balance [1]; far above rounding errors
SUFFICIENT_FIT_ERROR = 0.01  # largest rms error of a sufficient fit of the restitution / limit [1]


class Calibration(NamedTuple):
    """Calibrated limits of a gain file, and the watchdog's alarm rates with these limits."""

    limits: dict[str, float | None]  # limits of `jaxhil.rig.limits.LIMITS` by name [SI units]; None: no limit
    rates: dict[str, Any]  # alarm rates and verdict, as JSON data


def calibrate(
    loaded: LoadedGains,
    store: SweepStore | None = None,
    scenarios: int | None = None,
    limit: float | None = None,
    lanes: int = LANES_PER_RECORDING,
    replaced: Mapping[str, float | None] | None = None,
    allowed: AllowedAlarmRates = DEFAULT_ALLOWED_RATES,
    progress: Callable[[int], None] = lambda runs: None,
    faulty: int = 0,
) -> Calibration:
    """Calibrate the limits of a gain file, and estimate the watchdog's rates of false and missed alarms.

    Args:
        loaded: gain file.
        store: sweep of this gain file whose scenarios are simulated again. None: draw new scenarios.
        scenarios: number of scenarios. Default: all scenarios of the sweep, or 2048 draws.
        limit: limit of the restitution error [1]. Default: the limit of the sweep, or 0.01.
        lanes: number of scenarios that are simulated together.
        replaced: limits by name, used instead of the calibrated limits, also to estimate the alarm rates.
        allowed: largest acceptable alarm rates.
        progress: callback, called with the number of runs that have been completed since its last call.
        faulty: number of scenarios for each injected fault (`tuning.watchdog.fault_injection`). 0: inject no
            faults.

    Returns:
        The limits, and the alarm rates with a verdict.

    Raises:
        InputError: If the sweep used another gain file or has fewer scenarios, or if no run ends.
    """
    chosen = choose_scenarios(loaded, store, scenarios)
    limit = choose_error_limit(limit, store, DEFAULT_ERROR_LIMIT)
    rules, free_distance = build_audit_rules(loaded)
    parts = []
    for chunk in record_selection(loaded, chosen, lanes):
        parts.append(evaluate_runs(chunk, rules, free_distance))
        progress(len(parts[-1].index))
    runs = _join_runs(parts)
    fitted = runs.index % int(np.clip(len(runs.index) // FITTED_RUNS, 4, 16)) == 0
    good = find_good_runs(runs, limit) & fitted
    used = good if np.any(good) else np.all(runs.status == OK, axis=0) & fitted
    if not np.any(used):
        raise InputError("limits: found no run in which all contacts end: tune better gains first")
    expectation = fit_reached_contacts(runs, limit, rules.mass, fitted)
    margin = choose_restitution_margin(runs, expectation, limit, rules.mass, fitted, allowed.false_alarms)
    limits = compute_guard_limits(loaded, runs, used, rules, free_distance) | expectation.limits()
    limits["restitution_margin"] = margin.value
    replaced = replaced or {}
    final = {name: limits.get(name) for name in LIMITS} | dict(replaced)
    rates = compute_alarm_rates(runs, expectation, final, limit, rules.mass, ~(fitted | margin.runs))
    if faulty:
        watchdog = rules, free_distance, expectation, final
        rates["fault_runs"] = compute_fault_rates(loaded, *watchdog, limit, faulty, chosen.seed, progress)
    rates = add_verdict(rates, allowed, chosen.number)
    rates["widened_from"] = None if "restitution_margin" in replaced else margin.widened_from
    rates["calibrated_on"] = _origin(chosen, store, used, used is good)
    return Calibration({name: _convert_to_plain(value) for name, value in final.items()}, rates)


def _origin(
    chosen: ScenarioSelection, store: SweepStore | None, used: Bool[np.ndarray, "lanes"], are_good: bool
) -> dict[str, Any]:
    """Describe the runs `used` for the limits as plain data; `are_good` is whether these are good runs."""
    return {
        "scenarios": chosen.number,
        "sampling": chosen.sampling,
        "seed": chosen.seed,
        "sweep_sha256": None if store is None else store.manifest.sha256,
        "runs": "good" if are_good else "ended, none good",
        "number": int(np.sum(used)),
        "margin": LIMIT_MARGIN,
    }


def choose_error_limit(limit: float | None, store: SweepStore | None, default: float) -> float:
    """Return `limit`, else the sweep's limit, else `default`; raise `InputError` unless it is positive."""
    if limit is None and store is not None:
        limit = store.manifest.limit
    limit = default if limit is None else limit
    if not 0 < limit < np.inf:
        raise InputError(f"--limit: found {limit!r}, expected a number above 0")
    return limit


def build_audit_rules(loaded: LoadedGains) -> tuple[AuditRules, float]:
    """Compute the parameters of the watchdog's audit and the free distance [m] from the mechanism.

    The mechanism counts as in free flight if it is farther than the free distance from every surface.
    """
    mechanism = loaded.mechanism
    rig = mechanism.rig
    position, period = rig.position_sensor, rig.control_period
    drawn = _find_largest_draws(loaded)
    # Time that the simulated loop waits for the force to decay, with the largest delays of all draws.
    wait = drawn["force_delay"] + 20 * drawn["force_lag"] + 2 * period
    mass = mechanism.bodies.mass
    noise = 3 * drawn["force_noise"] + drawn["force_bias"] + drawn["force_quantum"] + drawn["force_drift"]
    rules = AuditRules(
        period=period,
        clearance=mechanism.contact.clearance,
        mass=mass,
        alignment=max(0.0, force_delay(mechanism) - position.delay),
        settling=LIMIT_MARGIN * wait,
        fading=noise,
        has_status=_has_status(loaded),
    )
    error = 6 * drawn["position_noise"] + drawn["position_quantum"] + max(0.0, drawn["nearer"])
    free_distance = error + drawn["velocity"] * (FREE_APPROACH_TIME + drawn["position_delay"])
    return rules, min(free_distance, mechanism.contact.clearance / 4)


def fit_reached_contacts(
    runs: EvaluatedRuns, limit: float, mass: float, chosen: Bool[np.ndarray, "lanes"]
) -> ExpectationFit:
    """Fit the expected restitution to the chosen runs, up to the first bad contact of each run."""
    use = find_reached_contacts(runs, limit) & (runs.status == OK) & chosen & (runs.audited.approach > 0)
    run = np.broadcast_to(np.cumsum(chosen), use.shape)[use]
    features = ContactFeatures(*(leaf[use] for leaf in extract_features(runs.audited)))
    return fit_expectation(features, runs.reference[use], run, mass, SUFFICIENT_FIT_ERROR * limit)


def compute_guard_limits(
    loaded: LoadedGains,
    runs: EvaluatedRuns,
    used: Bool[np.ndarray, "lanes"],
    rules: AuditRules,
    free_distance: float,
) -> dict[str, float | None]:
    """Return the limits of readings and commands: extreme signals in the runs `used`, times a margin."""
    extent = SignalExtremes(*(leaf[used] for leaf in runs.extent))
    rig, period = loaded.mechanism.rig, rules.period
    most = {name: float(np.max(getattr(extent, name))) for name in SignalExtremes._fields}
    smallest = MIN_FORCE_LIMIT_SHARE * most["reading"]
    drawn = _find_largest_draws(loaded)
    measured = _widen_range(float(np.min(extent.measured_lowest)), most["measured_highest"], rules.clearance)
    sent = _widen_range(float(np.min(extent.sent_lowest)), most["sent_highest"], rules.clearance)
    speed = LIMIT_MARGIN * most["sent_speed"]
    acceleration = most["acceleration"]
    limited = rig.simulator.acceleration_limit
    duration = runs.audited.duration[:, used]
    within = 5 * period * most["speed"]
    return {
        "force_range": drawn["force_range"] if np.isfinite(drawn["force_range"]) else 2 * most["reading"],
        "measured_lowest": measured[0],
        "measured_highest": measured[1],
        "held_readings": float(MAX_BAD_TICKS_IN_A_ROW),
        "force_stuck_travel": LIMIT_MARGIN * max(most["force_stuck"], within),
        "position_stuck_travel": LIMIT_MARGIN * max(most["position_stuck"], within),
        "free_distance": free_distance,
        "settling": rules.settling,
        # On the rig, the flight after a tare lasts longer than in the simulation.
        "free_force": max(LIMIT_MARGIN * most["flight_force"], smallest) + drawn["force_drift"],
        "late_fraction": LIMITS["late_fraction"].default,
        "missed_in_a_row": float(MAX_BAD_TICKS_IN_A_ROW),
        "tare_ticks": float(max(10, round(TARE_DURATION / period))),
        "tare_spread": max(2 * LIMIT_MARGIN * most["flight_spread"], smallest) + drawn["force_drift"],
        "bias_limit": max(LIMIT_MARGIN * drawn["force_bias"], 5 * smallest) + drawn["force_drift"],
        "force_limit": LIMIT_MARGIN * most["command"],
        "force_slew": LIMIT_MARGIN * max(most["slew"], smallest / period),
        "limited_in_a_row": float(MAX_BAD_TICKS_IN_A_ROW),
        "command_lowest": sent[0],
        "command_highest": sent[1],
        "velocity_limit": speed,
        "start_distance": LIMIT_MARGIN * most["start"],
        "deceleration": min(acceleration, limited),
        "retreat_velocity": min(loaded.mechanism.approach.velocity, speed),
        "equivalent_mass": rules.mass,
        "alignment": rules.alignment,
        "fading": rules.fading,
        "energy_balance": _compute_balance_limit(runs, used),
        "longest_contact": LIMIT_MARGIN * float(np.nanmax(duration)),
    }


def _compute_balance_limit(runs: EvaluatedRuns, used) -> float:
    """Return the limit of the relative energy balance [1], calibrated on the runs `used`."""
    return max(MIN_BALANCE_LIMIT, LIMIT_MARGIN * float(np.nanmax(runs.audited.imbalance[:, used])))


def _widen_range(low: float, high: float, clearance: float) -> tuple[float | None, float]:
    """Widen a range of positions [m] on both sides by half its width.

    With two surfaces, the range includes the gap between them. With one surface there is no lower limit,
    because an approach on the rig may start farther away than in the simulation.
    """
    if np.isinf(clearance):
        return None, high + (LIMIT_MARGIN - 1) * (high - low)
    low, high = min(low, -clearance), max(high, 0.0)
    spare = (LIMIT_MARGIN - 1) * (high - low)
    return low - spare, high + spare


def _find_largest_draws(loaded: LoadedGains) -> dict[str, float]:
    """Return the largest possible values of the uncertain quantities on which the limits depend.

    The keys are the names of the quantities; the values are in SI units.
    """
    scenarios = build_scenarios(loaded.mechanism, draw_extremes(loaded.mechanism))
    force, position = scenarios.force_sensor, scenarios.position_sensor
    largest = {
        "force_delay": force.delay,
        "force_lag": force.time_constant,
        "force_noise": force.noise_std,
        "force_bias": np.abs(force.bias),
        # three standard deviations of the change of the bias
        "force_drift": 0.0 if force.bias_walk is None else 3 * BIAS_WALK_TIME**0.5 * force.bias_walk,
        "force_quantum": force.quantum,
        "force_range": force.range,
        "position_delay": position.delay,
        "position_noise": position.noise_std,
        "position_quantum": position.quantum,
        "velocity": scenarios.velocity,
        "nearer": -scenarios.contact_plane,
    }
    return {name: float(np.max(values)) for name, values in largest.items()}


def _has_status(loaded: LoadedGains) -> bool:
    """Return whether the compensator reports a status (`jaxhil.rig.law_status`) on the rig.

    If it does, a force command other than 0 shows a contact, even without a known surface position.
    """
    law = COMPENSATORS.get(loaded.compensator)
    if law is None:
        return False
    mechanism = loaded.mechanism
    compensator = law(loaded.gains, mechanism.rig.control_period, mechanism.contact.clearance)
    return compensator.status != UNSTATED


def choose_scenarios(
    loaded: LoadedGains, store: SweepStore | None, scenarios: int | None
) -> ScenarioSelection:
    """Return the scenarios to simulate: those of the sweep or, without a sweep, random draws.

    Raise `InputError` if the sweep used another gain file, or if the number of scenarios is out of range.
    """
    if scenarios is not None and scenarios < 2:
        raise InputError(f"--scenarios: found {scenarios}, expected 2 or more")
    if store is None:
        return ScenarioSelection("random", 0, scenarios or DEFAULT_DRAWS)
    manifest = store.manifest
    if manifest.gains_sha256 != loaded.document["sha256"]:
        found, allowed = manifest.gains_sha256[:12], loaded.document["sha256"][:12]
        raise InputError(f"{store.folder}: gains_sha256: found {found}..., expected {allowed}...")
    stored = count_stored_scenarios(store)
    if scenarios is not None and scenarios > stored:
        raise InputError(f"--scenarios: found {scenarios}, expected at most {stored} (those of the sweep)")
    return ScenarioSelection(manifest.sampling, manifest.seed, scenarios or stored)


def count_stored_scenarios(store: SweepStore) -> int:
    """Return the number of complete scenarios of a sweep, which may have stopped early.

    Raise `InputError` if a chunk is damaged.
    """
    stored = 0
    for part in range(store.manifest.parts):
        if read_intact_chunk(store, part) is None:
            break
        stored += store.manifest.chunk_range(part)[1]
    return store.manifest.scenarios if store.manifest.until_width is None else stored


def _join_runs(parts: list[EvaluatedRuns]) -> EvaluatedRuns:
    def join(leaves):
        if isinstance(leaves[0], tuple):
            return type(leaves[0])(*(join(column) for column in zip(*leaves, strict=True)))
        return np.concatenate(leaves, axis=-1)

    return join(parts)


def _convert_to_plain(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
