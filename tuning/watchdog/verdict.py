"""Whether the watchdog's rates of alarm are within what is allowed.

A rate is good where its interval of 95 % ends at what is allowed or below, bad where it begins above. In
between it is not known, and it is said which sweep would tell.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from tuning.statistics.intervals import binomial_interval, number_to_decide


class Allowed(NamedTuple):
    """The largest acceptable rates of wrong alarms."""

    false_alarms: float = 0.01  # share of the good runs that are stopped
    missed_alarms: float = 0.02  # share of the runs to be stopped that go on


ALLOWED = Allowed()


def judged(rates: Mapping[str, Any], allowed: Allowed, scenarios: int) -> dict[str, Any]:
    """Return the rates, each with what is `allowed`, and the verdict on them.

    Missed alarms are judged by the runs with injected faults, where there are enough of those; by the drawn
    runs besides where these say that too many are missed.

    Args:
        rates: what `tuning.watchdog.alarms.watchdog_rates` found, and `fault_runs` if faults were injected
            (`tuning.watchdog.fault_runs`).
        allowed: the largest acceptable rates.
        scenarios: of the drawn runs.

    Returns:
        The rates with `verdict`: "good", "bad" with `reasons`, or "unknown" with what is not known.
    """
    reasons, unknown = [], []
    kinds = {kind: {**rates[kind], "allowed": most} for kind, most in allowed._asdict().items()}
    faulty = [{**one, "allowed": allowed.missed_alarms} for one in rates.get("fault_runs", ())]
    counted = [one for one in faulty if one["counted"]]
    for kind, one in kinds.items():
        stated = f"{kind.replace('_', ' ')}: {_interval(one)}"
        if one["low"] > one["allowed"]:
            reasons.append(stated)
        elif one["high"] > one["allowed"] and not (counted and kind == "missed_alarms"):
            told = _what_tells(kind, one, scenarios, rates["held_out_runs"])
            unknown.append(f"{stated}; {told}")
    for one in counted:
        stated = f"missed alarms with {one['meaning']}: {_interval(one)}"
        if one["low"] > one["allowed"]:
            reasons.append(stated)
        elif one["high"] > one["allowed"]:
            unknown.append(f"{stated}; {_what_faults_tell(one)}")
    verdict = "bad" if reasons else "unknown" if unknown else "good"
    found = {**rates, **kinds, "verdict": verdict, "reasons": reasons, "unknown": unknown}
    return {**found, "fault_runs": faulty} if faulty else found


def _interval(one: Mapping[str, Any]) -> str:
    return f"95 % interval {one['low']:.2g} to {one['high']:.2g}, allowed {one['allowed']:g}"


def _what_faults_tell(one: Mapping[str, Any]) -> str:
    """Return in words what would decide on a rate among runs with injected faults."""
    runs = number_to_decide(one["alarms"], one["runs"], one["allowed"])
    if runs is None:
        return "at this rate no number of runs would tell"
    return f"at this rate about {_rounded_up(runs)} such runs tell, there are {one['runs']}"


def _what_tells(kind: str, one: Mapping[str, Any], scenarios: int, held_out: int) -> str:
    """Return in words how large a sweep brings enough runs of the kind."""
    runs = number_to_decide(one["alarms"], one["runs"], one["allowed"])
    if runs is None:
        return "at this rate no sweep would tell"
    if one["runs"]:
        return f"at this rate a sweep of about {_rounded_up(runs / one['runs'] * scenarios)} scenarios tells"
    share = float(binomial_interval(0, held_out).high)
    if kind == "false_alarms" and held_out:
        return f"none of {held_out} runs is good: gains with smaller errors are needed"
    return f"no such run among {held_out}: a sweep of at least {_rounded_up(runs / share)} scenarios tells"


def _rounded_up(number: float) -> int:
    """To two digits."""
    unit = 10 ** max(0, math.floor(math.log10(number)) - 1)
    return math.ceil(number / unit) * unit
