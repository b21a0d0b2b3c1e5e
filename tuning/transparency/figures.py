"""What is said of a law on one mechanism's scenarios, each figure with its 95 % interval.

    rms, p99, worst      restitution error |e - e*| over all contacts
    failures             share of scenarios with a contact that does not end, or errs beyond the limit
    early, late          transparency to a push at a quarter and three quarters of the contact; 1 is perfect
    slope                of e against e* over damped twins; 1 is perfect
    peak                 99th percentile of the command's peak over the reference's
    trajectory           rms of x_d off the reference within the contact, over the reference's depth
    noise                amplification of white noise on the force, from the gains alone: no interval

Scenarios are resampled (bootstrap), each with all its contacts; a share has its Clopper-Pearson interval.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binomtest, bootstrap

from jaxhil.simulation.outcome import Outcome
from tuning.statistics.bootstrap import ErrorIntervals, Interval, error_intervals
from tuning.statistics.intervals import Estimate

RESAMPLES = 999
LEVEL = 0.95
NOWHERE = Interval(np.nan, np.nan)
# Of these figures 1 is the best; of the others, less is better.
CLOSER_TO_1 = ("early", "late", "slope")


class Runs(NamedTuple):
    """What runs of one law with one set of gains say."""

    plain: Outcome  # of the plain runs, (slots, scenarios)
    early: Outcome  # of the first contact under an early push
    late: Outcome  # under a late one
    twins: Outcome  # of the damped twins


def judge(
    judged: Runs,
    pushed: tuple[Float[np.ndarray, "scenarios"], Float[np.ndarray, "scenarios"]],
    in_space: Float[np.ndarray, "scenarios"],
    depth: Float[np.ndarray, "slots scenarios"],
    amplification: float,
    limit: float,
    seed: int,
) -> dict[str, Estimate]:
    """All figures. `pushed`: e* under the early and the late push; `in_space`: e* without, integrated alike;
    `depth` [m]: the deepest point of each contact in space."""
    plain: Any = judged.plain
    good = plain.good
    size = np.abs(plain.error[good])
    ends = error_intervals(plain.error, good, seed=seed)
    if np.any(plain.wanted & ~good):
        # What is said of the contacts that ended is no match for a law under which all of them do.
        ends = ErrorIntervals(NOWHERE, NOWHERE)
    beyond = good & ((np.abs(plain.error) > limit) | plain.unlike)
    wrong = np.any((plain.wanted & ~good) | beyond, axis=0)
    found = {
        "rms": Estimate(_rms(size), *ends.rms),
        "p99": Estimate(_percentile(size, 99), *ends.p99),
        "worst": Estimate(float(np.max(size)) if len(size) else np.nan, np.nan, np.nan),
        "failures": share(wrong),
    }
    found |= transparency_figures(judged, pushed, in_space, seed)
    found["peak_force_ratio"] = resampled(_highest, seed, good, plain.peak_force_ratio)
    found["duration_ratio"] = resampled(_highest, seed, good, plain.duration_ratio)
    found["trajectory"] = resampled(_root_mean_square, seed, good, plain.metrics.trajectory_error / depth)
    found["noise"] = Estimate(amplification, np.nan, np.nan)
    return found


def transparency_figures(
    judged: Runs,
    pushed: tuple[Float[np.ndarray, "scenarios"], Float[np.ndarray, "scenarios"]],
    in_space: Float[np.ndarray, "scenarios"],
    seed: int,
) -> dict[str, Estimate]:
    """Whether it still is a test of the hardware: early, late, slope and peak; arguments as of `judge`."""
    plain: Any = judged.plain
    twin: Any = judged.twins
    found = {}
    for name, runs, e in zip(("early", "late"), (judged.early, judged.late), pushed, strict=True):
        both = plain.good[0] & runs.good[0]
        change = runs.metrics.restitution[0] - plain.metrics.restitution[0]
        found[name] = resampled(transmitted, seed, both[None], change[None], (e - in_space)[None])
    found["slope"] = resampled(slope, seed, twin.good, twin.metrics.restitution, twin.reference_restitution)
    found["peak"] = resampled(_highest, seed, plain.good, plain.peak_ratio)
    return found


def transmitted(
    change: Float[np.ndarray, "*resamples contacts"], true: Float[np.ndarray, "*resamples contacts"]
) -> Float[np.ndarray, "*resamples"]:
    """Least squares of the change of e on the true one, through 0: sum(change true)/sum(true^2).

    NaN stands for a contact that does not count.
    """
    return np.nansum(change * true, axis=-1) / np.nansum(true**2, axis=-1)


def slope(
    restitution: Float[np.ndarray, "*resamples contacts"],
    reference: Float[np.ndarray, "*resamples contacts"],
) -> Float[np.ndarray, "*resamples"]:
    """Least squares of e on e*, with an intercept; NaN stands for a contact that does not count."""
    centred = reference - np.nanmean(reference, axis=-1, keepdims=True)
    return np.nansum(centred * restitution, axis=-1) / np.nansum(centred**2, axis=-1)


def share(yes: Bool[np.ndarray, "scenarios"]) -> Estimate:
    """How often, with the Clopper-Pearson interval."""
    ends = binomtest(int(np.sum(yes)), len(yes)).proportion_ci(LEVEL, method="exact")
    return Estimate(float(np.mean(yes)), float(ends.low), float(ends.high))


def resampled(
    function: Callable[..., np.ndarray],
    seed: int,
    good: Bool[np.ndarray, "slots scenarios"],
    *data: Float[np.ndarray, "slots scenarios"],
) -> Estimate:
    """A function of paired data, along their last axis, with its percentile bootstrap interval.

    It gets the `good` contacts of all scenarios side by side, and NaN for the others. Scenarios are
    resampled, each with all its contacts: those of one scenario depend on each other.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), chapter 13.
    """
    slots, met = np.any(good, axis=1), np.any(good, axis=0)
    if np.sum(met) < 2:
        return Estimate(np.nan, np.nan, np.nan)
    kept = [np.where(good, values, np.nan)[slots][:, met] for values in data]

    def of_contacts(*chosen: np.ndarray, axis: int) -> np.ndarray:
        rows = (np.moveaxis(values, 0, -2) for values in chosen)
        return function(*(row.reshape(*row.shape[:-2], -1) for row in rows))

    with np.errstate(invalid="ignore", divide="ignore"):
        value = of_contacts(*kept, axis=-1)
        ends = bootstrap(
            kept,
            of_contacts,
            paired=True,
            vectorized=True,
            axis=-1,
            n_resamples=RESAMPLES,
            confidence_level=LEVEL,
            method="percentile",
            rng=np.random.default_rng(seed),
        ).confidence_interval
    return Estimate(float(value), float(ends.low), float(ends.high))


def distance(name: str, figure: Estimate) -> Estimate:
    """How far a figure is from its best: itself, or its distance from 1; NaN ends if it has no interval."""
    if name not in CLOSER_TO_1:
        return figure
    ends = sorted((abs(figure.low - 1), abs(figure.high - 1)))
    straddles = figure.low <= 1 <= figure.high
    return Estimate(abs(figure.value - 1), 0.0 if straddles else ends[0], ends[1])


def winner(name: str, figures: dict[str, Estimate]) -> str | None:
    """Of several laws the one whose interval lies below all others'; None where there is no such one."""
    apart = {law: distance(name, figure) for law, figure in figures.items()}
    known = {law: one for law, one in apart.items() if np.isfinite(one.value) and np.isfinite(one.high)}
    if len(known) < 2:
        return None
    first = min(known, key=lambda law: known[law].high)
    others = (one.low for law, one in known.items() if law != first)
    return first if all(known[first].high < low for low in others) else None


def _highest(values):
    return np.nanpercentile(values, 99, axis=-1)


def _root_mean_square(values):
    return np.sqrt(np.nanmean(values**2, axis=-1))


def _rms(values):
    return float(np.sqrt(np.mean(values**2))) if len(values) else np.nan


def _percentile(values, percent):
    return float(np.percentile(values, percent)) if len(values) else np.nan
