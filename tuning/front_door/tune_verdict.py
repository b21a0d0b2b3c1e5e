"""Verdict on tuned gains: what it looks at, and the warnings beside it."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhil.mechanism.structs import Mechanism

if TYPE_CHECKING:
    from tuning.gains.tune import ErrorFigures, TuneResult

UNLIKE = 0.01  # share of the fresh contacts that may be unlike the ideal contact in peak force or duration


class CommandFigures(NamedTuple):
    """What the tuned gains do to the force command."""

    peak_p99: float  # 99th percentile of the peak command over the ideal contact's peak force [1]
    noise_amplification: float | None  # of the force sensor's noise [1]; None in six axes


def command_figures(result: "TuneResult") -> CommandFigures:
    """Return the figures of the command on the fresh scenarios; NaN where no contact ended."""
    from tuning.gains.noise import amplification

    outcome = result.outcomes["tuned"]
    peaks = outcome.peak_ratio[outcome.good]
    amplified = None
    if isinstance(result.mechanism, Mechanism):
        amplified = amplification(result.mechanism, result.compensator, result.gains)
    return CommandFigures(float(np.percentile(peaks, 99)) if len(peaks) else math.nan, amplified)


def is_good(result: "TuneResult", limit: float) -> bool:
    """Return whether all contacts ended, like the ideal ones and within the limit, without noise too."""
    return all(one.failed == 0 and one.rms <= limit and one.unlike <= UNLIKE for one in _judged(result))


def _judged(result: "TuneResult") -> list["ErrorFigures"]:
    """Return the figures with the sensors' noise, and without."""
    return [result.figures["tuned"], *([result.without_noise] if result.without_noise else [])]


def command_warnings(result: "TuneResult", command: CommandFigures) -> tuple[str, ...]:
    """Return a sentence for each figure of the command beyond its bound; noise counts if there is any."""
    from tuning.gains.quiet import MAX_NOISE_AMPLIFICATION, MAX_PEAK_RATIO

    found = []
    if command.peak_p99 > MAX_PEAK_RATIO:
        found.append(
            f"the force command peaks at {command.peak_p99:.3g} times the ideal contact's peak force "
            f"(99th percentile), expected at most {MAX_PEAK_RATIO:g}; --command-weight 1 lowers it"
        )
    amplified = command.noise_amplification or 0.0
    if result.without_noise is not None and amplified > MAX_NOISE_AMPLIFICATION:
        found.append(
            f"the force command amplifies the sensor's noise {amplified:.3g} times, "
            f"expected at most {MAX_NOISE_AMPLIFICATION:g}; --pareto shows what less of it costs"
        )
    return tuple(found)


def verdict_line(result: "TuneResult", limit: float) -> str:
    """Return the verdict: errors, limit, figures of the command and of the real contacts."""
    tuned, silent, command = result.figures["tuned"], result.without_noise, command_figures(result)
    low, high = result.intervals.rms if result.intervals else (math.nan, math.nan)
    sure = f" (95 %: {low:.2g} to {high:.2g})" if math.isfinite(low + high) else ""
    beside = f"peak ratio {command.peak_p99:.3g} (99th percentile)"
    if command.noise_amplification is not None:
        beside += f", sensor noise x {command.noise_amplification:.3g}"
    failed, where = tuned.failed, ""
    if not failed and silent is not None and silent.failed:
        failed, where = silent.failed, ", without noise"
    if failed:
        from jaxhil.simulation.scenario import LONGEST_CONTACT

        ended = f"did not end well, at the latest after {LONGEST_CONTACT:g} s,"
        return f"Bad: {failed} contacts {ended} with the tuned gains{where}; {beside}."
    error = f"the tuned rms error {tuned.rms:.2g}{sure}"
    if silent is not None:
        error += f", {silent.rms:.2g} without noise,"
    real = _real_contacts(max(_judged(result), key=lambda one: one.unlike))
    if is_good(result, limit):
        return f"Good: {error} is within {limit:g}; {beside}.\n{real}"
    if all(one.rms <= limit for one in _judged(result)):
        return f"Bad: too many real contacts are unlike the ideal one; {error} is within {limit:g}.\n{real}"
    return f"Bad: {error} exceeds {limit:g}; {beside}.\n{real}"


def _real_contacts(figures: "ErrorFigures") -> str:
    """Return the line on peak force and duration of the real contacts beside the ideal ones."""
    from jaxhil.simulation.contact_bounds import LONGEST, MOST_FORCE, SHORTEST

    shortest, longest = figures.duration_ratio
    return (
        f"Real contacts, 98 in 100: peak force up to {figures.peak_force_ratio:.3g} times, duration "
        f"{shortest:.3g} to {longest:.3g} times the ideal contact's; {100 * figures.unlike:.2g} % of all are "
        f"beyond {MOST_FORCE:g} times or {SHORTEST:g} to {LONGEST:g} times, allowed {100 * UNLIKE:g} %."
    )
