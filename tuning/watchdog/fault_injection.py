"""Rate of missed alarms in runs with injected faults, whose restitution errors are slightly above the limit.

With good gains, errors beyond the limit are so rare that random draws cannot bound the rate of missed alarms.
Therefore a fault is injected that neither controller nor watchdog knows. In every scenario, its size is
increased until the restitution error is between 1 and `MAX_FAULT_ERROR` times the limit. This is the hardest
case: a larger error differs more from the expected restitution. The rate is conditional on such a fault, and
not the probability that the fault occurs. All scenarios are independent of each other and of the calibration,
so that the exact binomial interval is valid.

A scenario is not used if its error exceeds the limit without the fault, or if no size of the fault up to
`MAX_FAULT_MULTIPLE` causes such an error. If fewer than half of the scenarios are used, the gains are
insensitive to the fault: its rate is reported, but does not count for the verdict.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.simulation.evaluation import count_lanes
from jaxhil.simulation.gain_file import LoadedGains
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.plausibility import summarise_mechanism
from jaxhil.simulation.scenario import Scenario
from tuning.statistics.intervals import binomial_interval, estimate_deciding_scenarios
from tuning.sweeps.draws import draw_scenarios
from tuning.watchdog.alarms import BAD_ERROR_FACTOR, evaluate_runs, find_alarms
from tuning.watchdog.audit import AuditRules, find_first_true
from tuning.watchdog.expectation import ExpectationFit
from tuning.watchdog.recording import record_runs

MAX_FAULT_ERROR = 1.25  # largest restitution error of a used scenario, divided by the limit [1]
MIN_BAD_SHARE = 0.5  # smallest fraction of used scenarios for a fault that counts for the verdict [1]
FIRST_SCENARIO_INDEX = 2**31  # index of the first scenario; sweeps and calibration use lower indices
MIN_FAULT_SCENARIOS, MAX_FAULT_SCENARIOS = 64, 4096  # bounds on the number of scenarios for a fault
# Largest size of a delay fault, divided by the delay that causes an error equal to the limit.
MAX_FAULT_MULTIPLE = 32.0
# Multiples that are tried in this order, before bisection.
FAULT_MULTIPLES = tuple(MAX_FAULT_MULTIPLE / 2.0**step for step in range(6, -1, -1))
BISECTION_STEPS = 4  # number of bisections between two successive entries of `FAULT_MULTIPLES`
MAX_DELAY_SHARE = 0.5  # longest injected delay, divided by the duration of the ideal contact [1]

FaultSizes = Float[np.ndarray, "lanes"]


class InjectedFault(NamedTuple):
    """Fault that is injected into the simulation and is unknown to the controller."""

    name: str  # name of the fault in files
    meaning: str  # description of the fault for messages
    unit: str  # unit of the fault's size


FORCE_DELAY_FAULT = InjectedFault("force_delay", "an unmodelled delay of the force sensor", "s")
POSITION_DELAY_FAULT = InjectedFault("position_delay", "an unmodelled delay of the position sensor", "s")
SIMULATOR_DELAY_FAULT = InjectedFault("simulator_delay", "an unmodelled delay of the motion simulator", "s")
GAIN_FAULT = InjectedFault("gains", "gains shifted towards no compensation", "1")
INJECTED_FAULTS = (FORCE_DELAY_FAULT, POSITION_DELAY_FAULT, SIMULATOR_DELAY_FAULT, GAIN_FAULT)


class _FaultCase(NamedTuple):
    """Injected fault, the scenarios for it, and its range of sizes."""

    fault: InjectedFault
    scenarios: Scenario  # scenarios without the fault
    unit: float  # size of the fault at the multiple 1 of `FAULT_MULTIPLES` [`fault.unit`]
    most: float  # largest size [`fault.unit`]


def compute_fault_rates(
    loaded: LoadedGains,
    rules: AuditRules,
    free_distance: float,
    expectation: ExpectationFit,
    limits: Mapping[str, float | None],
    limit: float,
    number: int,
    seed: int,
    progress: Callable[[int], None] = lambda runs: None,
) -> list[dict[str, Any]]:
    """Estimate the rate of missed alarms for each fault, with an exact 95 % interval, as JSON data.

    Args:
        loaded: gain file.
        rules: parameters of the watchdog's audit.
        free_distance: distance from the surfaces beyond which the mechanism counts as in free flight [m].
        expectation: expected restitution of the watchdog.
        limits: limits of the gain file by name.
        limit: restitution error [1] above which a run must be stopped.
        number: number of scenarios for each fault.
        seed: seed of the scenarios.
        progress: callback, called with the number of runs that have been completed since its last call.
    """
    cases = _build_cases(loaded, limit, number, seed)
    loop = _build_widest_loop(loaded, cases)
    rates = []
    for case in cases:
        sizes, usable = _find_critical_sizes(loop, loaded, case, limit)
        rates.append(
            _compute_missed_rate(
                loop, loaded, case, sizes, usable, rules, free_distance, expectation, limits, limit
            )
        )
        progress(number)
    return rates


def count_fault_scenarios(allowed: float) -> int:
    """Return a number of scenarios that decides whether the rate of missed alarms is at most `allowed`.

    The result, within fixed bounds, is twice the number that suffices if no alarm is missed. The factor 2
    leaves room for a few missed alarms and for scenarios that cannot be used.
    """
    if not 0 < allowed < 1:
        return MIN_FAULT_SCENARIOS if allowed >= 1 else MAX_FAULT_SCENARIOS
    needed = estimate_deciding_scenarios(0, 0, allowed)
    return (
        MAX_FAULT_SCENARIOS
        if needed is None
        else int(np.clip(2 * needed, MIN_FAULT_SCENARIOS, MAX_FAULT_SCENARIOS))
    )


def _build_cases(loaded: LoadedGains, limit: float, number: int, seed: int) -> list[_FaultCase]:
    """Return the faults that can affect the compensator, each with scenarios of its own."""
    cases, duration = [], _compute_ideal_duration(loaded)
    # A net delay tau causes the error exp(pi omega tau/2) - 1, and a contact lasts pi/omega.
    delay = 2 * duration / math.pi**2 * math.log1p(limit)
    for index, fault in enumerate(INJECTED_FAULTS):
        if fault == GAIN_FAULT and not _find_neutral_gains(loaded):
            continue
        _, scenarios = draw_scenarios(
            loaded.mechanism, "random", seed, FIRST_SCENARIO_INDEX + index * number, number
        )
        unit, most = (
            (1 / MAX_FAULT_MULTIPLE, 1.0) if fault == GAIN_FAULT else (delay, MAX_DELAY_SHARE * duration)
        )
        cases.append(_FaultCase(fault, scenarios, unit, most))
    return cases


def _find_neutral_gains(loaded: LoadedGains) -> dict[str, float]:
    """Return the neutral value (without effect) of each gain that does not already have it, by name."""
    return {
        gain.name: float(gain.neutral)
        for gain in COMPENSATORS[loaded.compensator].gains
        if gain.neutral is not None and loaded.gains[gain.name] != gain.neutral
    }


def _compute_ideal_duration(loaded: LoadedGains) -> float:
    """Return the duration [s] of the nominal first ideal contact; half an oscillation if it does not end."""
    first = summarise_mechanism(loaded.mechanism).contacts[0]
    return first.duration if math.isfinite(first.duration) else 0.5 / first.frequency


def _inject_fault(
    loaded: LoadedGains, case: _FaultCase, sizes: FaultSizes
) -> tuple[Mapping[str, Any], Scenario]:
    """Return gains and scenarios with the injected fault; `sizes` is the fault's size in each scenario."""
    scenarios, fault = case.scenarios, case.fault
    gains = {name: np.full(len(sizes), value) for name, value in loaded.gains.items()}
    if fault == GAIN_FAULT:
        moved = {
            name: gains[name] + sizes * (to - gains[name]) for name, to in _find_neutral_gains(loaded).items()
        }
        return {**gains, **moved}, scenarios
    part = {
        FORCE_DELAY_FAULT: "force_sensor",
        POSITION_DELAY_FAULT: "position_sensor",
        SIMULATOR_DELAY_FAULT: "simulator",
    }[fault]
    device: Any = getattr(scenarios, part)
    return gains, scenarios._replace(**{part: device._replace(delay=np.asarray(device.delay) + sizes)})


def _build_widest_loop(loaded: LoadedGains, cases: list[_FaultCase]) -> Any:
    """Return a loop whose delay lines are long enough for the largest size of every fault."""
    largest = [
        _inject_fault(
            loaded, case, _limit_sizes(case, np.full(count_lanes(case.scenarios), MAX_FAULT_MULTIPLE))
        )[1]
        for case in cases
    ]
    joined: Any = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *largest)
    return build_loop(loaded.mechanism, loaded.compensator, joined)


def _limit_sizes(case: _FaultCase, multiples: FaultSizes) -> FaultSizes:
    """Convert multiples of `case.unit` to sizes of the fault, each at most the largest size `case.most`."""
    return np.minimum(multiples * case.unit, case.most)


def _find_critical_sizes(
    loop: Any, loaded: LoadedGains, case: _FaultCase, limit: float
) -> tuple[FaultSizes, np.ndarray]:
    """Find for each scenario the fault's size that causes a restitution error slightly above the limit.

    Return the sizes, and whether each scenario can be used, both (lanes,). A scenario can be used if such a
    size exists, and if its error without the fault is within the limit.
    """
    number = count_lanes(case.scenarios)

    def errors(multiples: Any) -> FaultSizes:
        gains, scenarios = _inject_fault(loaded, case, _limit_sizes(case, multiples))
        outcome = evaluate(loop, gains, scenarios)
        size = np.where(outcome.good, np.abs(outcome.error), np.where(outcome.is_scheduled, np.inf, 0.0))
        return np.max(size, axis=0)

    # The searched size lies between the multiples `below` (error within the limit) and `above` (beyond it).
    below, above = np.zeros(number), np.full(number, np.nan)
    beyond = np.full(number, np.inf)
    usable = errors(np.zeros(number)) <= limit
    for multiple in FAULT_MULTIPLES:
        error = errors(np.full(number, multiple))
        first = np.isnan(above) & (error > BAD_ERROR_FACTOR * limit)
        above, beyond = np.where(first, multiple, above), np.where(first, error, beyond)
        below = np.where(np.isnan(above), multiple, below)
    usable &= ~np.isnan(above)
    above = np.where(usable, above, MAX_FAULT_MULTIPLE)
    for _ in range(BISECTION_STEPS):
        middle = np.where(below > 0, np.sqrt(below * above), above / 2)
        error = errors(middle)
        bad = error > BAD_ERROR_FACTOR * limit
        above, beyond = np.where(bad, middle, above), np.where(bad, error, beyond)
        below = np.where(bad, below, middle)
    return _limit_sizes(case, above), usable & (beyond <= MAX_FAULT_ERROR * limit)


def _compute_missed_rate(
    loop: Any,
    loaded: LoadedGains,
    case: _FaultCase,
    sizes: FaultSizes,
    usable: np.ndarray,
    rules: AuditRules,
    free_distance: float,
    expectation: ExpectationFit,
    limits: Mapping[str, float | None],
    limit: float,
) -> dict[str, Any]:
    """Estimate the rate of missed alarms for a fault with the given sizes, as JSON data."""
    gains, scenarios = _inject_fault(loaded, case, sizes)
    chunk = record_runs(loop, loaded._replace(gains=gains), scenarios)  # pyright: ignore[reportArgumentType]
    runs = evaluate_runs(chunk, rules, free_distance)
    bad = (runs.status != OK) | ~(np.abs(runs.error) <= BAD_ERROR_FACTOR * limit)
    usable = usable & np.any(bad, axis=0)
    alarmed = find_alarms(runs, expectation, limits, rules.mass)
    missed = (find_first_true(alarmed) > find_first_true(bad))[usable]
    number, count = int(np.sum(usable)), int(np.sum(missed))
    _, low, high = binomial_interval(count, number)
    error = np.nanmax(np.where(np.isfinite(runs.error), np.abs(runs.error), 0.0), axis=0)[usable]
    return {
        **case.fault._asdict(),
        "scenarios": len(sizes),
        "largest_size": min(MAX_FAULT_MULTIPLE * case.unit, case.most),
        "size": float(np.median(sizes[usable])) if number else None,
        "error": float(np.median(error)) if number else None,
        "runs": number,
        "alarms": count,
        "rate": count / number if number else None,
        "low": float(low),
        "high": float(high),
        "counted": number >= MIN_BAD_SHARE * len(sizes),
    }
