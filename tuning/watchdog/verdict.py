"""Verdict on the watchdog's rates of alarm.

A rate is good if its 95 % interval ends at or below the allowed rate, and bad if the interval begins above.
Otherwise it is unknown, and the verdict states the size of a sweep that would decide.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from tuning.statistics.intervals import binomial_interval, estimate_deciding_scenarios


class AllowedAlarmRates(NamedTuple):
    """Largest acceptable rates of false and missed alarms."""

    false_alarms: float = 0.01  # share of the good runs that are stopped
    missed_alarms: float = 0.02  # share of the bad runs that are not stopped


DEFAULT_ALLOWED_RATES = AllowedAlarmRates()


def add_verdict(rates: Mapping[str, Any], allowed: AllowedAlarmRates, scenarios: int) -> dict[str, Any]:
    """Return the rates with their allowed values and the verdict on them.

    If faults were injected and count, they decide on missed alarms; the drawn runs can only add that too many
    are missed.

    Args:
        rates: result of `tuning.watchdog.alarms.watchdog_rates`, and `fault_runs` if faults were injected
            (`tuning.watchdog.fault_injection`).
        allowed: largest acceptable rates.
        scenarios: number of drawn scenarios.

    Returns:
        The rates with `verdict`: "good", "bad" with `reasons`, or "unknown" with texts of what is `unknown`.
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
    """Return a text with the number of runs with injected faults that would decide on a rate."""
    runs = estimate_deciding_scenarios(rate["alarms"], rate["runs"], rate["allowed"])
    if runs is None:
        return "at this rate no number of runs would tell"
    return f"at this rate about {_round_up(runs)} such runs tell, there are {rate['runs']}"


def _describe_deciding_sweep(kind: str, rate: Mapping[str, Any], scenarios: int, held_out: int) -> str:
    """Return a text with the size of a sweep that would decide on a rate."""
    runs = estimate_deciding_scenarios(rate["alarms"], rate["runs"], rate["allowed"])
    if runs is None:
        return "at this rate no sweep would tell"
    if rate["runs"]:
        return f"at this rate a sweep of about {_round_up(runs / rate['runs'] * scenarios)} scenarios tells"
    share = float(binomial_interval(0, held_out).high)
    if kind == "false_alarms" and held_out:
        return f"none of {held_out} runs is good: gains with smaller errors are needed"
    return f"no such run among {held_out}: a sweep of at least {_round_up(runs / share)} scenarios tells"


def _round_up(number: float) -> int:
    """Round up to two digits."""
    unit = 10 ** max(0, math.floor(math.log10(number)) - 1)
    return math.ceil(number / unit) * unit
