"""`calibrate` finds the limits of a gain file, from what good runs did.

The scenarios of a sweep's store are run again, recorded, and judged: a run is good if no contact's error
exceeds the sweep's limit. To some of the runs the watchdog's expected restitution is fitted, and limits are
margins on what the good ones among them needed; what shares of the other runs are stopped for nothing, or
missed, is stated with exact intervals, and with a verdict on them.
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

MARGIN = 1.5  # on what good runs did
FITTED = 2048  # runs that are enough to fit to: all others judge, at least 3 of 4 and at most 15 of 16
SMALLEST = 0.02  # of the largest force reading: what a limit on forces leaves a sensor at least
WITHOUT_STORE = 2048  # draws: enough to bound false alarms if a third of the runs is good
LIMIT = 0.01  # of the restitution error, where no sweep states one
BRIDGED = 3  # ticks: bad readings, missed ticks, cut rates in a row
TARE = 0.1  # s
RETREAT = 0.005  # s of free approach: what counts as out of contact besides what the sensor may err
BALANCE = 1e-6  # of the approach's energy: what rounding leaves is far below, one wrong force far above
ENOUGH = 0.01  # of the limit: rms error of an expectation that need not be better


class Calibration(NamedTuple):
    """What a gain file says of its limits."""

    # by name [SI units], all of `jaxhil.rig.limits.LIMITS`; None for no limit
    limits: dict[str, float | None]
    rates: dict[str, Any]  # what is known of the watchdog's alarms under them, plain data


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
    """Limits for the rig, and the watchdog's rates of false and missed alarms, judged by what is `allowed`.

    Args: `loaded`, the gain file; `store`, a sweep's of that gain file, whose scenarios are run again, all of
    them or the first so many `scenarios`; without a store so many draws of the file's own uncertainty (2048).
    `limit` of the restitution error: the store's own by default, else 0.01. `replaced` limits are as given,
    whatever the runs say, and the rates are under them. So many `lanes` are run at a time; `progress` is
    given how many more runs are done. With `faulty` scenarios of every fault, faults are injected to count
    missed alarms (`tuning.watchdog.fault_runs`). Raises `InputError` for a store of another gain file, or a
    number that it does not hold.
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
    found = {name: limits.get(name) for name in LIMITS} | dict(replaced)
    rates = watchdog_rates(runs, expectation, found, limit, rules.mass, ~(fitted | margin.runs))
    if faulty:
        known = rules, free_distance, expectation, found
        rates["fault_runs"] = fault_rates(loaded, *known, limit, faulty, chosen.seed, progress)
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
    return Calibration({name: _plain(value) for name, value in found.items()}, rates)


def watchdog_rules(loaded: LoadedGains) -> tuple[Rules, float]:
    """By what rules the watchdog audits, worked out from the mechanism alone, and `free_distance` [m]."""
    mechanism = loaded.mechanism
    rig = mechanism.rig
    force, position, period = rig.force_sensor, rig.position_sensor, rig.control_period
    drawn = _largest(loaded)
    # The loop's own wait for the force to die out, with a margin that a drawn delay cannot use up.
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
    """The expectation, fitted to the contacts reached in the chosen runs."""
    use = reached(runs, limit) & (runs.status == OK) & chosen & (runs.audited.approach > 0)
    place = np.broadcast_to(np.cumsum(chosen), use.shape)[use]
    features = Features(*(leaf[use] for leaf in features_of(runs.audited)))
    return fit_expectation(features, runs.reference[use], place, mass, ENOUGH * limit)


def guard_limits(
    loaded: LoadedGains, runs: JudgedRuns, used: Bool[np.ndarray, "lanes"], rules: Rules, free_distance: float
) -> dict[str, float | None]:
    """The limits of readings and commands: margins on the extent of the runs `used`."""
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
    """Rounding is far below `BALANCE`; a drawn mass that is not the file's is not."""
    return max(BALANCE, MARGIN * float(np.nanmax(runs.audited.imbalance[:, used])))


def _widened(low: float, high: float, clearance: float) -> tuple[float | None, float]:
    """A stroke with half as much again on either side; the gap between two surfaces is part of it.

    Of one surface the far side is free: from how far an approach comes, no run of the simulation says.
    """
    if np.isinf(clearance):
        return None, high + (MARGIN - 1) * (high - low)
    low, high = min(low, -clearance), max(high, 0.0)
    spare = (MARGIN - 1) * (high - low)
    return low - spare, high + spare


def _largest(loaded: LoadedGains) -> dict[str, float]:
    """The largest that can be drawn of what the rules go by."""
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
    """Return whether the law has a status on the rig, which opens a contact wherever the surface lies."""
    law = COMPENSATORS.get(loaded.compensator)
    if law is None:
        return False
    mechanism = loaded.mechanism
    made = law(loaded.gains, mechanism.rig.control_period, mechanism.contact.clearance)
    return made.status != UNSTATED


def _chosen(loaded: LoadedGains, store: Store | None, scenarios: int | None) -> Scenarios:
    if scenarios is not None and scenarios < 2:
        raise InputError(f"--scenarios: found {scenarios}, allowed 2 or more")
    if store is None:
        return Scenarios("random", 0, scenarios or WITHOUT_STORE)
    manifest = store.manifest
    if manifest.gains_sha256 != loaded.document["sha256"]:
        found, allowed = manifest.gains_sha256[:12], loaded.document["sha256"][:12]
        raise InputError(f"{store.folder}: gains_sha256: found {found}..., allowed {allowed}...")
    held = held_scenarios(store)
    if scenarios is not None and scenarios > held:
        raise InputError(f"--scenarios: found {scenarios}, allowed at most the store's {held}")
    return Scenarios(manifest.sampling, manifest.seed, scenarios or held)


def held_scenarios(store: Store) -> int:
    """How many scenarios a sweep is of, which may have stopped when enough was known. Raises `InputError` for
    a part that is damaged."""
    held = 0
    for part in range(store.manifest.parts):
        if kept_part(store, part) is None:
            break
        held += store.manifest.part_rows(part)[1]
    return store.manifest.scenarios if store.manifest.until_width is None else held


def _joined(parts: list[JudgedRuns]) -> JudgedRuns:
    def join(leaves):
        if isinstance(leaves[0], tuple):
            return type(leaves[0])(*(join(each) for each in zip(*leaves, strict=True)))
        return np.concatenate(leaves, axis=-1)

    return join(parts)


def _plain(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
