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
    """The rates that `tuning.watchdog.alarms.watchdog_rates` found among so many `scenarios`, each with what
    is `allowed`, and the verdict: "good", "bad" with `reasons`, or "unknown" with what is not known."""
    reasons, unknown = [], []
    kinds = {}
    for kind, most in allowed._asdict().items():
        one = rates[kind]
        kinds[kind] = {**one, "allowed": most}
        name = f"{kind.replace('_', ' ')}: 95 % interval {one['low']:.2g} to {one['high']:.2g}"
        if one["low"] > most:
            reasons.append(f"{name}, allowed {most:g}")
        elif one["high"] > most:
            told = _what_tells(one, most, scenarios, rates["held_out_runs"])
            unknown.append(f"{name}, allowed {most:g}; {told}")
    verdict = "bad" if reasons else "unknown" if unknown else "good"
    return {**rates, **kinds, "verdict": verdict, "reasons": reasons, "unknown": unknown}


def _what_tells(one: Mapping[str, Any], allowed: float, scenarios: int, held_out: int) -> str:
    """In words, how large a sweep brings enough runs of the kind."""
    runs = number_to_decide(one["alarms"], one["runs"], allowed)
    if runs is None:
        return "at this rate no sweep would tell"
    if one["runs"]:
        return f"at this rate a sweep of about {_rounded_up(runs / one['runs'] * scenarios)} scenarios tells"
    share = float(binomial_interval(0, held_out).high)
    return f"no such run among {held_out}: a sweep of at least {_rounded_up(runs / share)} scenarios tells"


def _rounded_up(number: float) -> int:
    """To two digits."""
    unit = 10 ** max(0, math.floor(math.log10(number)) - 1)
    return math.ceil(number / unit) * unit
