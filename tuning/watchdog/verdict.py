"""Verdict on the watchdog's rates of false and missed alarms.

A rate is good if the upper end of its 95 % interval is at most the allowed rate. It is bad if the lower end
is above the allowed rate. In all other cases it is unknown, and the verdict names the size of a sweep that
would decide.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from tuning.statistics.intervals import binomial_interval, estimate_deciding_scenarios


class AllowedAlarmRates(NamedTuple):
    """Largest acceptable rates of false and missed alarms."""

    false_alarms: float = 0.01  # largest fraction of good runs that are stopped [1]
    missed_alarms: float = 0.02  # largest fraction of bad runs that are not stopped [1]


DEFAULT_ALLOWED_RATES = AllowedAlarmRates()


def add_verdict(rates: Mapping[str, Any], allowed: AllowedAlarmRates, scenarios: int) -> dict[str, Any]:
    """Add the allowed rates and the verdict to the estimated alarm rates.

    If an injected fault has enough runs (`counted`), an uncertain rate of missed alarms in drawn runs does
    not make the verdict unknown. A rate that is certainly too high always makes the verdict bad.

    Args:
        rates: result of `tuning.watchdog.alarms.compute_alarm_rates`. If faults were injected, `fault_runs`
            is the result of `tuning.watchdog.fault_injection.compute_fault_rates`.
        allowed: largest acceptable rates.
        scenarios: number of drawn scenarios.

    Returns:
        The rates with `verdict`, which is "good", "bad" or "unknown". The lists `reasons` and `unknown`
        describe the bad and the unknown rates.
    """
    reasons, unknown = [], []
    kinds = {kind: {**rates[kind], "allowed": most} for kind, most in allowed._asdict().items()}
    faulty = [{**rate, "allowed": allowed.missed_alarms} for rate in rates.get("fault_runs", ())]
    counted = [rate for rate in faulty if rate["counted"]]
    for kind, rate in kinds.items():
        text = f"{kind.replace('_', ' ')}: {_describe_interval(rate)}"
        if rate["low"] > rate["allowed"]:
            reasons.append(text)
        elif rate["high"] > rate["allowed"] and not (counted and kind == "missed_alarms"):
            unknown.append(
                f"{text}; {_describe_deciding_sweep(kind, rate, scenarios, rates['held_out_runs'])}"
            )
    for rate in counted:
        text = f"missed alarms with {rate['meaning']}: {_describe_interval(rate)}"
        if rate["low"] > rate["allowed"]:
            reasons.append(text)
        elif rate["high"] > rate["allowed"]:
            unknown.append(f"{text}; {_describe_deciding_runs(rate)}")
    verdict = "bad" if reasons else "unknown" if unknown else "good"
    result = {**rates, **kinds, "verdict": verdict, "reasons": reasons, "unknown": unknown}
    return {**result, "fault_runs": faulty} if faulty else result


def _describe_interval(rate: Mapping[str, Any]) -> str:
    return f"95 % interval {rate['low']:.2g} to {rate['high']:.2g}, limit {rate['allowed']:g}"


def _describe_deciding_runs(rate: Mapping[str, Any]) -> str:
    """Describe how many runs with an injected fault are needed to decide whether a rate is acceptable."""
    runs = estimate_deciding_scenarios(rate["alarms"], rate["runs"], rate["allowed"])
    if runs is None:
        return "at this rate, no number of runs would decide"
    return f"at this rate, about {_round_up(runs)} such runs would decide; there are {rate['runs']}"


def _describe_deciding_sweep(kind: str, rate: Mapping[str, Any], scenarios: int, held_out: int) -> str:
    """Describe how large a sweep must be to decide whether an alarm rate is acceptable."""
    runs = estimate_deciding_scenarios(rate["alarms"], rate["runs"], rate["allowed"])
    if runs is None:
        return "at this rate, no sweep would decide"
    if rate["runs"]:
        needed = _round_up(runs / rate["runs"] * scenarios)
        return f"at this rate, a sweep of about {needed} scenarios would decide"
    share = float(binomial_interval(0, held_out).high)
    if kind == "false_alarms" and held_out:
        return f"none of {held_out} runs is good: gains with smaller errors are needed"
    return f"{held_out} runs contain no such run: a sweep of {_round_up(runs / share)} scenarios may decide"


def _round_up(number: float) -> int:
    """Round a number up to two significant digits."""
    unit = 10 ** max(0, math.floor(math.log10(number)) - 1)
    return math.ceil(number / unit) * unit
