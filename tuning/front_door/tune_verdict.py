"""Verdict on tuned gains: what it looks at, and the warnings beside it."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhil.mechanism.structs import Mechanism

if TYPE_CHECKING:
    from tuning.gains.tune import TuneResult


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
    """Return whether every contact ended and the rms error is within the limit, without noise too."""
    judged = [result.figures["tuned"], *([result.without_noise] if result.without_noise else [])]
    return all(one.failed == 0 and one.rms <= limit for one in judged)


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
    """Return the verdict in one line: errors, limit, and the figures of the command."""
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
    if is_good(result, limit):
        return f"Good: {error} is within {limit:g}; {beside}."
    return f"Bad: {error} exceeds {limit:g}; {beside}."
