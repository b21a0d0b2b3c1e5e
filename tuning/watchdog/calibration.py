"""Calibration of the limits of a gain file from recorded runs.

The scenarios of a sweep's store are run again and recorded. A run is good if no contact's error exceeds the
sweep's limit. The watchdog's expected restitution is fitted to some of the runs; the limits are margins on
the extreme signals of the good ones among them. The rates of false and missed alarms come from the other
runs, with exact intervals and a verdict.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from jaxhil.errors import InputError
from jaxhil.mechanism.uncertainty import extremes
from jaxhil.rig.law_status import UNSTATED
from jaxhil.rig.limits import LIMITS
from jaxhil.rig.registry import COMPENSATORS
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.scenario import build_scenarios
from tuning.sweeps.store import Store, kept_part
from tuning.watchdog.alarms import JudgedRuns, features_of, good_runs, judge_chunk, reached, watchdog_rates
from tuning.watchdog.audited import Rules
from tuning.watchdog.expectation import Expectation, Features, fit_expectation
from tuning.watchdog.extent import Extent
from tuning.watchdog.fault_runs import fault_rates
from tuning.watchdog.margin import restitution_margin
from tuning.watchdog.recorded import LANES, Scenarios, recorded_chunks
from tuning.watchdog.verdict import ALLOWED, Allowed, judged

MARGIN = 1.5  # factor on the extreme signals of good runs
FITTED = 2048  # runs that suffice for the fit; 3/4 to 15/16 of all runs remain for the rates
SMALLEST = 0.02  # least limit on forces, as a share of the largest force reading
WITHOUT_STORE = 2048  # draws without a store; they bound false alarms if a third of the runs is good
LIMIT = 0.01  # limit of the restitution error [1] if no sweep states one
BRIDGED = 3  # bad readings, missed ticks or limited rates that are allowed in a row [ticks]
TARE = 0.1  # duration of the tare [s]
RETREAT = 0.005  # time of free approach [s] that, with the sensor's error, defines the free distance
BALANCE = 1e-6  # least limit of the energy balance over the approach's energy [1], far above rounding errors
ENOUGH = 0.01  # rms error of a sufficient expectation over the limit [1]


class Calibration(NamedTuple):
    """Limits of a gain file, and the watchdog's rates of alarm."""

    # by name [SI units], all of `jaxhil.rig.limits.LIMITS`; None for no limit
    limits: dict[str, float | None]
    rates: dict[str, Any]  # rates of the watchdog's alarms under these limits, as plain data


def calibrate(
    loaded: LoadedGains,
    store: Store | None = None,
    scenarios: int | None = None,
    limit: float | None = None,
    lanes: int = LANES,
    replaced: Mapping[str, float | None] | None = None,
    allowed: Allowed = ALLOWED,
    progress: Callable[[int], None] = lambda runs: None,
    faulty: int = 0,
) -> Calibration:
    """Calibrate the limits of a gain file, and evaluate the watchdog's rates of false and missed alarms.

    Args:
        loaded: the gain file.
        store: sweep of that gain file whose scenarios are run again; None: draws of its uncertainty.
        scenarios: number of scenarios; by default all of the store, or 2048 draws.
        limit: limit of the restitution error [1]; by default the store's, else 0.01.
        lanes: number of scenarios that run at a time.
        replaced: limits that replace the calibrated ones, also for the rates.
        allowed: largest acceptable rates.
        progress: called with the number of further runs that are complete.
        faulty: number of scenarios of every injected fault (`tuning.watchdog.fault_runs`); 0: no faults.

    Returns:
        The limits, and the rates with their verdict.

    Raises:
        InputError: if the store is of another gain file or holds fewer scenarios, or if no run ends.
    """
    chosen = _chosen(loaded, store, scenarios)
    if limit is None:
        limit = store.manifest.limit if store is not None else None
    limit = LIMIT if limit is None else limit
    if not 0 < limit < np.inf:
        raise InputError(f"--limit: found {limit!r}, allowed a number above 0")
    rules, free_distance = watchdog_rules(loaded)
    parts = []
    for chunk in recorded_chunks(loaded, chosen, lanes):
        parts.append(judge_chunk(chunk, rules, free_distance))
        progress(len(parts[-1].index))
    runs = _joined(parts)
    fitted = runs.index % int(np.clip(len(runs.index) // FITTED, 4, 16)) == 0
    good = good_runs(runs, limit) & fitted
    used = good if np.any(good) else np.all(runs.status == OK, axis=0) & fitted
    if not np.any(used):
        raise InputError("limits: found no run all of whose contacts end, allowed gains with which they do")
    expectation = fit_reached(runs, limit, rules.mass, fitted)
    margin = restitution_margin(runs, expectation, limit, rules.mass, fitted, allowed.false_alarms)
    limits = {
        **guard_limits(loaded, runs, used, rules, free_distance),
        **expectation.limits(),
        "restitution_margin": margin.value,
    }
    replaced = replaced or {}
    final = {name: limits.get(name) for name in LIMITS} | dict(replaced)
    rates = watchdog_rates(runs, expectation, final, limit, rules.mass, ~(fitted | margin.runs))
    if faulty:
        watchdog = rules, free_distance, expectation, final
        rates["fault_runs"] = fault_rates(loaded, *watchdog, limit, faulty, chosen.seed, progress)
    rates = judged(rates, allowed, chosen.number)
    rates["widened_from"] = None if "restitution_margin" in replaced else margin.widened_from
    rates["calibrated_on"] = {
        "scenarios": chosen.number,
        "sampling": chosen.sampling,
        "seed": chosen.seed,
        "sweep_sha256": None if store is None else store.manifest.sha256,
        "runs": "good" if used is good else "ended, none good",
        "number": int(np.sum(used)),
        "margin": MARGIN,
    }
    return Calibration({name: _plain(value) for name, value in final.items()}, rates)


def watchdog_rules(loaded: LoadedGains) -> tuple[Rules, float]:
    """Return the rules of the watchdog's audit, and `free_distance` [m], from the mechanism alone."""
    mechanism = loaded.mechanism
    rig = mechanism.rig
    force, position, period = rig.force_sensor, rig.position_sensor, rig.control_period
    drawn = _largest(loaded)
    # This is the time that the loop waits for the force to die out, at the largest delays of all draws.
    wait = drawn["force_delay"] + 20 * drawn["force_lag"] + 2 * period
    mass = mechanism.bodies.mass
    noise = 3 * drawn["force_noise"] + drawn["force_bias"] + drawn["force_quantum"]
    rules = Rules(
        period=period,
        clearance=mechanism.contact.clearance,
        mass=mass,
        alignment=max(0.0, force.delay + force.time_constant - position.delay),
        settling=MARGIN * wait,
        fading=noise,
        has_status=_has_status(loaded),
    )
    error = 6 * drawn["position_noise"] + drawn["position_quantum"] + max(0.0, drawn["nearer"])
    free_distance = error + drawn["velocity"] * (RETREAT + drawn["position_delay"])
    return rules, min(free_distance, mechanism.contact.clearance / 4)


def fit_reached(
    runs: JudgedRuns, limit: float, mass: float, chosen: Bool[np.ndarray, "lanes"]
) -> Expectation:
    """Fit the expected restitution to the contacts reached in the chosen runs."""
    use = reached(runs, limit) & (runs.status == OK) & chosen & (runs.audited.approach > 0)
    run = np.broadcast_to(np.cumsum(chosen), use.shape)[use]
    features = Features(*(leaf[use] for leaf in features_of(runs.audited)))
    return fit_expectation(features, runs.reference[use], run, mass, ENOUGH * limit)


def guard_limits(
    loaded: LoadedGains, runs: JudgedRuns, used: Bool[np.ndarray, "lanes"], rules: Rules, free_distance: float
) -> dict[str, float | None]:
    """Return the limits of readings and commands, with margins on the extent of the runs `used`."""
    extent = Extent(*(leaf[used] for leaf in runs.extent))
    rig, period = loaded.mechanism.rig, rules.period
    most = {name: float(np.max(getattr(extent, name))) for name in Extent._fields}
    smallest = SMALLEST * most["reading"]
    drawn = _largest(loaded)
    measured = _widened(float(np.min(extent.measured_lowest)), most["measured_highest"], rules.clearance)
    sent = _widened(float(np.min(extent.sent_lowest)), most["sent_highest"], rules.clearance)
    speed = MARGIN * most["sent_speed"]
    acceleration = most["acceleration"]
    limited = rig.simulator.acceleration_limit
    duration = runs.audited.duration[:, used]
    within = 5 * period * most["speed"]
    return {
        "force_range": drawn["force_range"] if np.isfinite(drawn["force_range"]) else 2 * most["reading"],
        "measured_lowest": measured[0],
        "measured_highest": measured[1],
        "held_readings": float(BRIDGED),
        "force_stuck_travel": MARGIN * max(most["force_stuck"], within),
        "position_stuck_travel": MARGIN * max(most["position_stuck"], within),
        "free_distance": free_distance,
        "settling": rules.settling,
        "free_force": max(MARGIN * most["flight_force"], smallest),
        "late_fraction": LIMITS["late_fraction"].default,
        "missed_in_a_row": float(BRIDGED),
        "tare_ticks": float(max(10, round(TARE / period))),
        "tare_spread": max(2 * MARGIN * most["flight_spread"], smallest),
        "bias_limit": max(MARGIN * drawn["force_bias"], 5 * smallest),
        "force_limit": MARGIN * most["command"],
        "force_slew": MARGIN * max(most["slew"], smallest / period),
        "limited_in_a_row": float(BRIDGED),
        "command_lowest": sent[0],
        "command_highest": sent[1],
        "velocity_limit": speed,
        "start_distance": MARGIN * most["start"],
        "deceleration": min(acceleration, limited),
        "retreat_velocity": min(loaded.mechanism.approach.velocity, speed),
        "equivalent_mass": rules.mass,
        "alignment": rules.alignment,
        "fading": rules.fading,
        "energy_balance": _balance(runs, used),
        "longest_contact": MARGIN * float(np.nanmax(duration)),
    }


def _balance(runs: JudgedRuns, used) -> float:
    """Return the limit of the energy balance [1] from that of the runs `used`; at least `BALANCE`."""
    return max(BALANCE, MARGIN * float(np.nanmax(runs.audited.imbalance[:, used])))


def _widened(low: float, high: float, clearance: float) -> tuple[float | None, float]:
    """Widen a range of positions [m], which includes the gap between two surfaces, by half on either side.

    With one surface there is no lower limit, since the simulation does not show where an approach starts.
    """
    if np.isinf(clearance):
        return None, high + (MARGIN - 1) * (high - low)
    low, high = min(low, -clearance), max(high, 0.0)
    spare = (MARGIN - 1) * (high - low)
    return low - spare, high + spare


def _largest(loaded: LoadedGains) -> dict[str, float]:
    """Return the largest possible draws of the quantities that determine rules and limits."""
    scenarios = build_scenarios(loaded.mechanism, extremes(loaded.mechanism))
    force, position = scenarios.force_sensor, scenarios.position_sensor
    largest = {
        "force_delay": force.delay,
        "force_lag": force.time_constant,
        "force_noise": force.noise_std,
        "force_bias": np.abs(force.bias),
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
    """Return whether the law has a status on the rig, by which it opens a contact at any surface position."""
    law = COMPENSATORS.get(loaded.compensator)
    if law is None:
        return False
    mechanism = loaded.mechanism
    compensator = law(loaded.gains, mechanism.rig.control_period, mechanism.contact.clearance)
    return compensator.status != UNSTATED


def _chosen(loaded: LoadedGains, store: Store | None, scenarios: int | None) -> Scenarios:
    """Return the scenarios to run; raise `InputError` for another gain file's store or an invalid number."""
    if scenarios is not None and scenarios < 2:
        raise InputError(f"--scenarios: found {scenarios}, allowed 2 or more")
    if store is None:
        return Scenarios("random", 0, scenarios or WITHOUT_STORE)
    manifest = store.manifest
    if manifest.gains_sha256 != loaded.document["sha256"]:
        found, allowed = manifest.gains_sha256[:12], loaded.document["sha256"][:12]
        raise InputError(f"{store.folder}: gains_sha256: found {found}..., allowed {allowed}...")
    stored = held_scenarios(store)
    if scenarios is not None and scenarios > stored:
        raise InputError(f"--scenarios: found {scenarios}, allowed at most the store's {stored}")
    return Scenarios(manifest.sampling, manifest.seed, scenarios or stored)


def held_scenarios(store: Store) -> int:
    """Return the number of scenarios of a sweep, which may have stopped early.

    Raise `InputError` if a part is damaged.
    """
    stored = 0
    for part in range(store.manifest.parts):
        if kept_part(store, part) is None:
            break
        stored += store.manifest.part_rows(part)[1]
    return store.manifest.scenarios if store.manifest.until_width is None else stored


def _joined(parts: list[JudgedRuns]) -> JudgedRuns:
    def join(leaves):
        if isinstance(leaves[0], tuple):
            return type(leaves[0])(*(join(column) for column in zip(*leaves, strict=True)))
        return np.concatenate(leaves, axis=-1)

    return join(parts)


def _plain(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
