"""Verdict on tuned gains, metrics of their force command, and warnings."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxhil.mechanism.structs import Mechanism

if TYPE_CHECKING:
    from tuning.gains.tune import ErrorMetrics, TuneResult

# Largest allowed share of contacts whose real peak force or duration violates a bound (`contact_bounds`).
MAX_UNLIKE_SHARE = 0.01


class CommandMetrics(NamedTuple):
    """Metrics of the force command with the tuned gains.

    Attributes:
        peak_p99: 99th percentile of the peak command divided by the ideal contact's peak force [1].
        noise_amplification: amplification of the force sensor's noise [1]; None for six axes.
    """

    peak_p99: float
    noise_amplification: float | None


def command_metrics(result: "TuneResult") -> CommandMetrics:
    """Return the metrics of the force command on the fresh scenarios; the peak is NaN if no contact ended."""
    from tuning.gains.noise import compute_noise_amplification

    outcome = result.outcomes["tuned"]
    peaks = outcome.peak_ratio[outcome.good]
    amplified = None
    if isinstance(result.mechanism, Mechanism):
        amplified = compute_noise_amplification(result.mechanism, result.compensator, result.gains)
    return CommandMetrics(float(np.percentile(peaks, 99)) if len(peaks) else math.nan, amplified)


def is_good(result: "TuneResult", limit: float) -> bool:
    """Return whether the verdict on the tuned gains is good, both with and without sensor noise.

    The verdict is good if all contacts ended, and the rms error is within the limit. With six axes, this is
    the twist error. In addition, at most `MAX_UNLIKE_SHARE` of the real contacts may violate the bounds in
    `jaxhil.simulation.contact_bounds`.
    """
    return all(
        errors.failed == 0 and errors.rms <= limit and errors.unlike <= MAX_UNLIKE_SHARE
        for errors in _evaluated_errors(result)
    )


def _evaluated_errors(result: "TuneResult") -> list["ErrorMetrics"]:
    """Return the tuned gains' error metrics; if the mechanism has noise, also the metrics without noise."""
    return [result.figures["tuned"], *([result.without_noise] if result.without_noise else [])]


def command_warnings(result: "TuneResult", command: CommandMetrics) -> tuple[str, ...]:
    """Return a sentence for each metric of the force command that exceeds its bound.

    The noise amplification is considered only if the mechanism has sensor noise.
    """
    from tuning.gains.quiet_gains import MAX_NOISE_AMPLIFICATION, MAX_PEAK_RATIO

    warnings = []
    if command.peak_p99 > MAX_PEAK_RATIO:
        warnings.append(
            f"the force command peaks at {command.peak_p99:.3g} times the ideal contact's peak force "
            f"(99th percentile), expected at most {MAX_PEAK_RATIO:g}; --command-weight 1 lowers the peak"
        )
    amplified = command.noise_amplification or 0.0
    if result.without_noise is not None and amplified > MAX_NOISE_AMPLIFICATION:
        warnings.append(
            f"the force command amplifies the sensor's noise {amplified:.3g} times, "
            f"expected at most {MAX_NOISE_AMPLIFICATION:g}; --pareto computes gains with less amplification"
        )
    return tuple(warnings)


def describe_verdict(result: "TuneResult", limit: float) -> str:
    """Return the verdict as sentences: errors and limit, metrics of the command, and real contacts."""
    from jaxhil.rig_models import choose_rig_model

    tuned, noise_free, command = result.figures["tuned"], result.without_noise, command_metrics(result)
    low, high = result.intervals.rms if result.intervals else (math.nan, math.nan)
    interval = f" (95 %: {low:.2g} to {high:.2g})" if math.isfinite(low + high) else ""
    command_text = f"peak ratio {command.peak_p99:.3g} (99th percentile)"
    if command.noise_amplification is not None:
        command_text += f", sensor noise x {command.noise_amplification:.3g}"
    failed, where = tuned.failed, ""
    if not failed and noise_free is not None and noise_free.failed:
        failed, where = noise_free.failed, ", without noise"
    if failed:
        from jaxhil.simulation.scenario import MAX_CONTACT_DURATION

        ended = f"did not end well within {MAX_CONTACT_DURATION:g} s"
        return f"Bad: {failed} contacts {ended} with the tuned gains{where}; {command_text}."
    name = choose_rig_model(result.mechanism).verdict_error.replace("_", " ")
    error = f"the tuned rms {name} {tuned.rms:.2g}{interval}"
    if noise_free is not None:
        error += f", {noise_free.rms:.2g} without noise,"
    real = _describe_real_contacts(max(_evaluated_errors(result), key=lambda errors: errors.unlike))
    if is_good(result, limit):
        return f"Good: {error} is within {limit:g}; {command_text}.\n{real}"
    if all(errors.rms <= limit for errors in _evaluated_errors(result)):
        return f"Bad: too many real contacts are unlike the ideal one; {error} is within {limit:g}.\n{real}"
    return f"Bad: {error} exceeds {limit:g}; {command_text}.\n{real}"


def _describe_real_contacts(metrics: "ErrorMetrics") -> str:
    """Return a sentence that compares peak force and duration of the real and the ideal contacts."""
    from jaxhil.simulation.contact_bounds import MAX_DURATION_RATIO, MAX_PEAK_FORCE_RATIO, MIN_DURATION_RATIO

    shortest, longest = metrics.duration_ratio
    return (
        f"Real contacts, 98 in 100: peak force up to {metrics.peak_force_ratio:.3g} times, duration "
        f"{shortest:.3g} to {longest:.3g} times the ideal contact's; {100 * metrics.unlike:.2g} % of all are "
        f"outside the bounds (force at most {MAX_PEAK_FORCE_RATIO:g} times, duration "
        f"{MIN_DURATION_RATIO:g} to {MAX_DURATION_RATIO:g} times), limit {100 * MAX_UNLIKE_SHARE:g} %."
    )
