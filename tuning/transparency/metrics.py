"""Metrics of a compensator in the scenarios of one mechanism, with 95 % intervals.

    rms, p99, worst      rms, 99th percentile and maximum of the restitution error |e - e*| of all contacts
    failures             fraction of scenarios with a contact that does not end, has an error above the limit,
                         or violates the bounds on real peak force and duration
    early, late          transparency to a push at 25 % and at 75 % of the contact; the best value is 1
    slope                slope of e against e* in scenarios with damping perturbations; the best value is 1
    peak                 99th percentile of (peak of the force command) / (peak force of the ideal contact)
    peak_force_ratio     99th percentile of (real peak force) / (peak force of the ideal contact)
    duration_ratio       99th percentile of (duration of the contact) / (duration of the ideal contact)
    trajectory           rms of (model position - ideal position) / (depth of the ideal contact)
    noise                amplification of white force noise, computed from the gains, without an interval

Most intervals are bootstrap intervals. They resample whole scenarios, because the contacts of a scenario are
not independent. The interval of `failures` is a Clopper-Pearson interval.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binomtest, bootstrap

from jaxhil.simulation.outcome import Outcome
from tuning.statistics.bootstrap import ErrorIntervals, Interval, compute_error_intervals
from tuning.statistics.intervals import IntervalEstimate

METRIC_RESAMPLES = 999  # number of bootstrap resamples
CONFIDENCE_LEVEL = 0.95
UNDEFINED_INTERVAL = Interval(np.nan, np.nan)
# The best value of these metrics is 1. All other metrics are better if they are smaller.
BEST_AT_ONE = ("early", "late", "slope")


class PerturbedOutcomes(NamedTuple):
    """Outcomes of one compensator without and with perturbations, each (contacts, scenarios)."""

    plain: Outcome  # scenarios without a perturbation
    early: Outcome  # the same scenarios with an early push on the first contact
    late: Outcome  # the same scenarios with a late push on the first contact
    damped: Outcome  # the same scenarios with additional damping


def compute_metrics(
    outcomes: PerturbedOutcomes,
    pushed: tuple[Float[np.ndarray, "scenarios"], Float[np.ndarray, "scenarios"]],
    unpushed: Float[np.ndarray, "scenarios"],
    depth: Float[np.ndarray, "slots scenarios"],
    amplification: float,
    limit: float,
    seed: int,
) -> dict[str, IntervalEstimate]:
    """Compute all metrics of a compensator, by name (listed in the module's docstring).

    Args:
        outcomes: outcomes of the scenarios, with and without perturbations.
        pushed: restitution e* of the first ideal contacts with the early push, and with the late push.
        unpushed: restitution e* of the first ideal contacts without a push, from the same numerical
            integration as `pushed`.
        depth: largest penetration of each ideal contact [m].
        amplification: amplification of white force noise by the compensator [1].
        limit: limit of the restitution error [1].
        seed: seed of the bootstrap.
    """
    plain: Any = outcomes.plain
    metrics = compute_error_metrics(plain, limit, seed)
    metrics |= compute_transparency_metrics(outcomes, pushed, unpushed, seed)
    metrics |= compute_ratio_metrics(plain, ("peak_force_ratio", "duration_ratio"), seed)
    metrics["trajectory"] = bootstrap_metric(
        _compute_resampled_rms, seed, plain.good, plain.metrics.trajectory_error / depth
    )
    metrics["noise"] = IntervalEstimate(amplification, np.nan, np.nan)
    return metrics


def compute_error_metrics(outcome: Any, limit: float, seed: int) -> dict[str, IntervalEstimate]:
    """Compute the metrics `rms`, `p99`, `worst` and `failures` of an outcome (slots, scenarios).

    `limit` [1] is the limit of the restitution error, `seed` the seed of the bootstrap.
    """
    good = outcome.good
    magnitudes = np.abs(outcome.error[good])
    ends = compute_error_intervals(outcome.error, good, seed=seed)
    if np.any(outcome.is_scheduled & ~good):
        # Some contacts did not end. The errors of the others cannot be compared with the errors of a
        # compensator with which all contacts end.
        ends = ErrorIntervals(UNDEFINED_INTERVAL, UNDEFINED_INTERVAL)
    beyond = good & ((np.abs(outcome.error) > limit) | outcome.is_unlike_ideal)
    has_failed = np.any((outcome.is_scheduled & ~good) | beyond, axis=0)
    return {
        "rms": IntervalEstimate(_compute_rms(magnitudes), *ends.rms),
        "p99": IntervalEstimate(_compute_percentile(magnitudes, 99), *ends.p99),
        "worst": IntervalEstimate(float(np.max(magnitudes)) if len(magnitudes) else np.nan, np.nan, np.nan),
        "failures": estimate_share(has_failed),
    }


def compute_ratio_metrics(outcome: Any, names: Sequence[str], seed: int) -> dict[str, IntervalEstimate]:
    """Compute the 99th percentile of each ratio in `names`, with its bootstrap interval.

    Each name is an attribute of `outcome`: a value divided by a value of the ideal contact. `seed` is the
    seed of the bootstrap.
    """
    return {
        name: bootstrap_metric(_compute_99th_percentile, seed, outcome.good, getattr(outcome, name))
        for name in names
    }


def compute_transparency_metrics(
    outcomes: PerturbedOutcomes,
    pushed: tuple[Float[np.ndarray, "scenarios"], Float[np.ndarray, "scenarios"]],
    unpushed: Float[np.ndarray, "scenarios"],
    seed: int,
) -> dict[str, IntervalEstimate]:
    """Compute the metrics `early`, `late`, `slope` and `peak`; for the arguments, see `compute_metrics`."""
    plain: Any = outcomes.plain
    damped: Any = outcomes.damped
    metrics = {}
    for name, runs, e in zip(("early", "late"), (outcomes.early, outcomes.late), pushed, strict=True):
        ended = plain.good[0] & runs.good[0]
        change = runs.metrics.restitution[0] - plain.metrics.restitution[0]
        metrics[name] = bootstrap_metric(
            fit_transmission, seed, ended[None], change[None], (e - unpushed)[None]
        )
    metrics["slope"] = bootstrap_metric(
        fit_slope, seed, damped.good, damped.metrics.restitution, damped.reference_restitution
    )
    metrics["peak"] = compute_ratio_metrics(plain, ["peak_ratio"], seed)["peak_ratio"]
    return metrics


def fit_transmission(
    change: Float[np.ndarray, "*resamples contacts"], true: Float[np.ndarray, "*resamples contacts"]
) -> Float[np.ndarray, "*resamples"]:
    """Return the slope of the least-squares line through the origin, of `change` against `true`.

    A push (short additional force on the hardware) changes the restitution e on the rig by `change`. In the
    ideal contact, the same push changes e* by `true`. NaN values are ignored.
    """
    return np.nansum(change * true, axis=-1) / np.nansum(true**2, axis=-1)


def fit_slope(
    restitution: Float[np.ndarray, "*resamples contacts"],
    reference: Float[np.ndarray, "*resamples contacts"],
) -> Float[np.ndarray, "*resamples"]:
    """Return the slope of a least-squares line with intercept, of e against e*; NaN values are ignored."""
    centred = reference - np.nanmean(reference, axis=-1, keepdims=True)
    return np.nansum(centred * restitution, axis=-1) / np.nansum(centred**2, axis=-1)


def estimate_share(yes: Bool[np.ndarray, "scenarios"]) -> IntervalEstimate:
    """Return the fraction of true values, with its Clopper-Pearson interval."""
    ends = binomtest(int(np.sum(yes)), len(yes)).proportion_ci(CONFIDENCE_LEVEL, method="exact")
    return IntervalEstimate(float(np.mean(yes)), float(ends.low), float(ends.high))


def bootstrap_metric(
    function: Callable[..., np.ndarray],
    seed: int,
    good: Bool[np.ndarray, "slots scenarios"],
    *data: Float[np.ndarray, "slots scenarios"],
) -> IntervalEstimate:
    """Compute a metric of contacts with its percentile bootstrap interval.

    The bootstrap resamples whole scenarios, because the contacts of a scenario are not independent.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), chapter 13.

    Args:
        function: computes the metric from one array (..., contacts) for each array in `data`; ignores NaN.
        seed: seed of the bootstrap.
        good: whether each contact has ended; the values of all other contacts become NaN.
        *data: values of each contact.
    """
    slots, scenarios = np.any(good, axis=1), np.any(good, axis=0)
    if np.sum(scenarios) < 2:
        return IntervalEstimate(np.nan, np.nan, np.nan)
    samples = [np.where(good, values, np.nan)[slots][:, scenarios] for values in data]

    def evaluate_contacts(*resamples: np.ndarray, axis: int) -> np.ndarray:
        rows = (np.moveaxis(values, 0, -2) for values in resamples)
        return function(*(row.reshape(*row.shape[:-2], -1) for row in rows))

    with np.errstate(invalid="ignore", divide="ignore"):
        value = evaluate_contacts(*samples, axis=-1)
        ends = bootstrap(
            samples,
            evaluate_contacts,
            paired=True,
            vectorized=True,
            axis=-1,
            n_resamples=METRIC_RESAMPLES,
            confidence_level=CONFIDENCE_LEVEL,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).confidence_interval
    return IntervalEstimate(float(value), float(ends.low), float(ends.high))


def compute_distance_from_best(name: str, metric: IntervalEstimate) -> IntervalEstimate:
    """Return the distance of a metric from its best value: 1 for the names in `BEST_AT_ONE`, otherwise 0.

    The bounds of the distance are NaN if the metric has no interval.
    """
    if name not in BEST_AT_ONE:
        return metric
    ends = sorted((abs(metric.low - 1), abs(metric.high - 1)))
    straddles = metric.low <= 1 <= metric.high
    return IntervalEstimate(abs(metric.value - 1), 0.0 if straddles else ends[0], ends[1])


def find_winner(name: str, figures: dict[str, IntervalEstimate]) -> str | None:
    """Return the compensator whose metric is significantly the best, or None.

    `figures` contains the metric `name` of each compensator. The interval of the best one's distance from
    the best value must not overlap with the interval of any other compensator's distance.
    """
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
