"""Verdict on tuned gains, the metrics behind it, and warnings."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhil.mechanism.structs import Mechanism

if TYPE_CHECKING:
    from tuning.gains.tune import ErrorMetrics, TuneResult

MAX_UNLIKE_SHARE = (
    0.01  # allowed share of fresh contacts whose peak force or duration is unlike the ideal contact's
)


class CommandMetrics(NamedTuple):
    """Metrics of the force command with the tuned gains."""

    peak_p99: float  # 99th percentile of the peak command over the ideal contact's peak force [1]
    noise_amplification: float | None  # amplification of the force sensor's noise [1]; None in six axes


def command_metrics(result: "TuneResult") -> CommandMetrics:
    """Return the metrics of the command on the fresh scenarios; NaN if no contact ended."""
    from tuning.gains.noise import compute_noise_amplification

    outcome = result.outcomes["tuned"]
    peaks = outcome.peak_ratio[outcome.good]
    amplified = None
    if isinstance(result.mechanism, Mechanism):
        amplified = compute_noise_amplification(result.mechanism, result.compensator, result.gains)
    return CommandMetrics(float(np.percentile(peaks, 99)) if len(peaks) else math.nan, amplified)


def is_good(result: "TuneResult", limit: float) -> bool:
    """Return whether all contacts ended, similar to the ideal ones and within the limit, also noise-free."""
    return all(
        errors.failed == 0 and errors.rms <= limit and errors.unlike <= MAX_UNLIKE_SHARE
        for errors in _evaluated_errors(result)
    )


def _evaluated_errors(result: "TuneResult") -> list["ErrorMetrics"]:
    """Return the errors with the sensor noise and, if the mechanism has noise, without it."""
    return [result.figures["tuned"], *([result.without_noise] if result.without_noise else [])]


def command_warnings(result: "TuneResult", command: CommandMetrics) -> tuple[str, ...]:
    """Return a sentence for each metric of the command beyond its bound; noise only if there is any."""
    from tuning.gains.quiet_gains import MAX_NOISE_AMPLIFICATION, MAX_PEAK_RATIO

    warnings = []
    if command.peak_p99 > MAX_PEAK_RATIO:
        warnings.append(
            f"the force command peaks at {command.peak_p99:.3g} times the ideal contact's peak force "
            f"(99th percentile), expected at most {MAX_PEAK_RATIO:g}; --command-weight 1 lowers it"
        )
    amplified = command.noise_amplification or 0.0
    if result.without_noise is not None and amplified > MAX_NOISE_AMPLIFICATION:
        warnings.append(
            f"the force command amplifies the sensor's noise {amplified:.3g} times, "
            f"expected at most {MAX_NOISE_AMPLIFICATION:g}; --pareto shows what less of it costs"
        )
    return tuple(warnings)


def describe_verdict(result: "TuneResult", limit: float) -> str:
    """Return the verdict in words: errors, limit, and metrics of the command and the real contacts."""
    tuned, silent, command = result.figures["tuned"], result.without_noise, command_metrics(result)
    low, high = result.intervals.rms if result.intervals else (math.nan, math.nan)
    interval = f" (95 %: {low:.2g} to {high:.2g})" if math.isfinite(low + high) else ""
    command_text = f"peak ratio {command.peak_p99:.3g} (99th percentile)"
    if command.noise_amplification is not None:
        command_text += f", sensor noise x {command.noise_amplification:.3g}"
    failed, where = tuned.failed, ""
    if not failed and silent is not None and silent.failed:
        failed, where = silent.failed, ", without noise"
    if failed:
        from jaxhil.simulation.scenario import MAX_CONTACT_DURATION

        ended = f"did not end well, at the latest after {MAX_CONTACT_DURATION:g} s,"
        return f"Bad: {failed} contacts {ended} with the tuned gains{where}; {command_text}."
    error = f"the tuned rms error {tuned.rms:.2g}{interval}"
    if silent is not None:
        error += f", {silent.rms:.2g} without noise,"
    real = _describe_real_contacts(max(_evaluated_errors(result), key=lambda errors: errors.unlike))
    if is_good(result, limit):
        return f"Good: {error} is within {limit:g}; {command_text}.\n{real}"
    if all(errors.rms <= limit for errors in _evaluated_errors(result)):
        return f"Bad: too many real contacts are unlike the ideal one; {error} is within {limit:g}.\n{real}"
    return f"Bad: {error} exceeds {limit:g}; {command_text}.\n{real}"


def _describe_real_contacts(figures: "ErrorMetrics") -> str:
    """Return a sentence that compares peak force and duration of real and ideal contacts."""
    from jaxhil.simulation.contact_bounds import MAX_DURATION_RATIO, MAX_PEAK_FORCE_RATIO, MIN_DURATION_RATIO

    shortest, longest = figures.duration_ratio
    return (
        f"Real contacts, 98 in 100: peak force up to {figures.peak_force_ratio:.3g} times, duration "
        f"{shortest:.3g} to {longest:.3g} times the ideal contact's; {100 * figures.unlike:.2g} % of all are "
        f"beyond {MAX_PEAK_FORCE_RATIO:g} times or {MIN_DURATION_RATIO:g} to {MAX_DURATION_RATIO:g} "
        f"times, limit {100 * MAX_UNLIKE_SHARE:g} %."
    )
