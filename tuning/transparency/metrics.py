"""Metrics of a compensator on one mechanism's scenarios, with 95 % intervals.

    rms, p99, worst      restitution error |e - e*| over all contacts
    failures             share of scenarios with a contact that does not end, exceeds the limit, or is unlike
                         the ideal contact
    early, late          transparency to a push at a quarter and three quarters of the contact; 1 is perfect
    slope                slope of e against e* over damping perturbations; 1 is perfect
    peak                 99th percentile of the command's peak over the ideal contact's peak force
    peak_force_ratio     99th percentile of the real peak force over the ideal contact's
    duration_ratio       99th percentile of the contact's duration over the ideal contact's
    trajectory           rms difference of x_d from the ideal contact, over the ideal contact's depth
    noise                amplification of white noise on the force, from the gains alone, without an interval

Intervals are bootstrap intervals over scenarios, each with all its contacts; a share has a Clopper-Pearson
interval.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binomtest, bootstrap

from jaxhil.simulation.outcome import Outcome
from tuning.statistics.bootstrap import ErrorIntervals, Interval, compute_error_intervals
from tuning.statistics.intervals import Estimate

METRIC_RESAMPLES = 999
CONFIDENCE_LEVEL = 0.95
UNDEFINED_INTERVAL = Interval(np.nan, np.nan)
# The best value of these metrics is 1; for the others, less is better.
BEST_AT_ONE = ("early", "late", "slope")


class PerturbedOutcomes(NamedTuple):
    """Outcomes of one law with one set of gains, (slots, scenarios)."""

    plain: Outcome  # scenarios without perturbation
    early: Outcome  # first contact with an early push
    late: Outcome  # first contact with a late push
    twins: Outcome  # scenarios with damping perturbations


def compute_metrics(
    judged: PerturbedOutcomes,
    pushed: tuple[Float[np.ndarray, "scenarios"], Float[np.ndarray, "scenarios"]],
    in_space: Float[np.ndarray, "scenarios"],
    depth: Float[np.ndarray, "slots scenarios"],
    amplification: float,
    limit: float,
    seed: int,
) -> dict[str, Estimate]:
    """Compute all metrics.

    `pushed` is e* with the early and the late push, `in_space` that without a push, by the same integration.
    `depth` [m] is the largest penetration of each ideal contact.
    """
    plain: Any = judged.plain
    good = plain.good
    size = np.abs(plain.error[good])
    ends = compute_error_intervals(plain.error, good, seed=seed)
    if np.any(plain.wanted & ~good):
        # Errors of some of the contacts are not comparable with a law under which all contacts end.
        ends = ErrorIntervals(UNDEFINED_INTERVAL, UNDEFINED_INTERVAL)
    beyond = good & ((np.abs(plain.error) > limit) | plain.unlike)
    wrong = np.any((plain.wanted & ~good) | beyond, axis=0)
    metrics = {
        "rms": Estimate(_compute_rms(size), *ends.rms),
        "p99": Estimate(_compute_percentile(size, 99), *ends.p99),
        "worst": Estimate(float(np.max(size)) if len(size) else np.nan, np.nan, np.nan),
        "failures": estimate_share(wrong),
    }
    metrics |= compute_transparency_metrics(judged, pushed, in_space, seed)
    metrics["peak_force_ratio"] = bootstrap_metric(
        _compute_99th_percentile, seed, good, plain.peak_force_ratio
    )
    metrics["duration_ratio"] = bootstrap_metric(_compute_99th_percentile, seed, good, plain.duration_ratio)
    metrics["trajectory"] = bootstrap_metric(
        _compute_resampled_rms, seed, good, plain.metrics.trajectory_error / depth
    )
    metrics["noise"] = Estimate(amplification, np.nan, np.nan)
    return metrics


def compute_transparency_metrics(
    judged: PerturbedOutcomes,
    pushed: tuple[Float[np.ndarray, "scenarios"], Float[np.ndarray, "scenarios"]],
    in_space: Float[np.ndarray, "scenarios"],
    seed: int,
) -> dict[str, Estimate]:
    """Compute the metrics of transparency: early, late, slope and peak."""
    plain: Any = judged.plain
    twin: Any = judged.twins
    metrics = {}
    for name, runs, e in zip(("early", "late"), (judged.early, judged.late), pushed, strict=True):
        ended = plain.good[0] & runs.good[0]
        change = runs.metrics.restitution[0] - plain.metrics.restitution[0]
        metrics[name] = bootstrap_metric(
            fit_transmission, seed, ended[None], change[None], (e - in_space)[None]
        )
    metrics["slope"] = bootstrap_metric(
        fit_slope, seed, twin.good, twin.metrics.restitution, twin.reference_restitution
    )
    metrics["peak"] = bootstrap_metric(_compute_99th_percentile, seed, plain.good, plain.peak_ratio)
    return metrics


def fit_transmission(
    change: Float[np.ndarray, "*resamples contacts"], true: Float[np.ndarray, "*resamples contacts"]
) -> Float[np.ndarray, "*resamples"]:
    """Return the least-squares slope of the change of e on its true change, through 0; NaN are ignored."""
    return np.nansum(change * true, axis=-1) / np.nansum(true**2, axis=-1)


def fit_slope(
    restitution: Float[np.ndarray, "*resamples contacts"],
    reference: Float[np.ndarray, "*resamples contacts"],
) -> Float[np.ndarray, "*resamples"]:
    """Return the least-squares slope of e on e*, with an intercept; NaN are ignored."""
    centred = reference - np.nanmean(reference, axis=-1, keepdims=True)
    return np.nansum(centred * restitution, axis=-1) / np.nansum(centred**2, axis=-1)


def estimate_share(yes: Bool[np.ndarray, "scenarios"]) -> Estimate:
    """Return the share of true values with its Clopper-Pearson interval."""
    ends = binomtest(int(np.sum(yes)), len(yes)).proportion_ci(CONFIDENCE_LEVEL, method="exact")
    return Estimate(float(np.mean(yes)), float(ends.low), float(ends.high))


def bootstrap_metric(
    function: Callable[..., np.ndarray],
    seed: int,
    good: Bool[np.ndarray, "slots scenarios"],
    *data: Float[np.ndarray, "slots scenarios"],
) -> Estimate:
    """Return a function of paired data along their last axis, with its percentile bootstrap interval.

    The function gets all contacts in a row, NaN for those that are not `good`. Scenarios are resampled with
    all their contacts, since contacts of a scenario are dependent.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), chapter 13.
    """
    slots, scenarios = np.any(good, axis=1), np.any(good, axis=0)
    if np.sum(scenarios) < 2:
        return Estimate(np.nan, np.nan, np.nan)
    samples = [np.where(good, values, np.nan)[slots][:, scenarios] for values in data]

    def of_contacts(*resamples: np.ndarray, axis: int) -> np.ndarray:
        rows = (np.moveaxis(values, 0, -2) for values in resamples)
        return function(*(row.reshape(*row.shape[:-2], -1) for row in rows))

    with np.errstate(invalid="ignore", divide="ignore"):
        value = of_contacts(*samples, axis=-1)
        ends = bootstrap(
            samples,
            of_contacts,
            paired=True,
            vectorized=True,
            axis=-1,
            n_resamples=METRIC_RESAMPLES,
            confidence_level=CONFIDENCE_LEVEL,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).confidence_interval
    return Estimate(float(value), float(ends.low), float(ends.high))


def compute_distance_from_best(name: str, figure: Estimate) -> Estimate:
    """Return a metric's distance from its best: itself, or its distance from 1; NaN if without interval."""
    if name not in BEST_AT_ONE:
        return figure
    ends = sorted((abs(figure.low - 1), abs(figure.high - 1)))
    straddles = figure.low <= 1 <= figure.high
    return Estimate(abs(figure.value - 1), 0.0 if straddles else ends[0], ends[1])


def find_winner(name: str, figures: dict[str, Estimate]) -> str | None:
    """Return the law whose interval lies below those of all other laws, None if there is none."""
    distances = {law: compute_distance_from_best(name, metric) for law, metric in figures.items()}
    finite = {law: d for law, d in distances.items() if np.isfinite(d.value) and np.isfinite(d.high)}
    if len(finite) < 2:
        return None
    first = min(finite, key=lambda law: finite[law].high)
    return first if all(finite[first].high < d.low for law, d in finite.items() if law != first) else None


def _compute_99th_percentile(values):
    return np.nanpercentile(values, 99, axis=-1)


def _compute_resampled_rms(values):
    return np.sqrt(np.nanmean(values**2, axis=-1))


def _compute_rms(values):
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def _compute_percentile(values, percent):
    return float(np.percentile(values, percent)) if len(values) else np.nan
