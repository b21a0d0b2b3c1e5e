"""Check for a filter of the force sensor that the mechanism file does not state.

A filter of order 2 or 4 resembles a lag with a longer delay. The fit of a lag can therefore absorb it. The
damping is then wrong, because only the onset of contact distinguishes damping from delay.

The check fits Butterworth filters of both orders in place of the lag. The error of e - e* then has a mixture
of normal distributions: around 0 if the file is right, or around the difference between the fits of a filter
and of the lag. The weights are the likelihoods of the fits, times the prior probabilities of the filters. The
effect of the check is the increase of the error's bound by the mixture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, special

from jaxhil.mechanism.structs import Mechanism, SensorFilter
from tuning.identification.contact_fit import ContactFit
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.deep_contact import summarise_deep_lanes
from tuning.identification.sensor_lag import MAX_TIME_CONSTANT
from tuning.identification.stated_filter import MIN_TIME_CONSTANT_PERIODS
from tuning.identification.surface_search import find_best_surface
from tuning.identification.uncertainty_effect import (
    EFFECT_PROBABILITY,
    UncertaintyEffect,
    compute_change_effect,
)
from tuning.identification.validation import CheckResult

HIDDEN_ORDERS = 2, 4  # orders of the Butterworth filters that the check fits
ASSUMED_CUTOFF = 100.0  # Hz; only kind and order matter until the cutoff is fitted
START_TIME_CONSTANT_PERIODS = 0.25  # first time constant without a lag in the file, in control periods
TRIAL_RATIO = 2.0  # ratio of successive time constants in the search
AGE_STEP, MAX_AGE_SHIFT, MAX_PARABOLAS = 5e-5, 5e-4, 3  # steps of the search for the age of the force [s]
MAX_LIKELIHOOD_DROP = 6.0  # largest increase of chi-squared with a filter that explains the logs as well
PRIOR_FILTER_PROBABILITY = 0.1  # prior probability of each order; data sheets usually state such a filter
MIN_EFFECT = 1e-3  # smallest effect on e or e - e* that the check reports


class _AgeFit(NamedTuple):
    """Best fit at one cutoff."""

    age: float  # sum of the force delay and the filter's delay at low frequencies [s]
    plane: float  # surface position [m]
    misfit: float  # chi-squared, plus a penalty of negative damping
    coefficients: np.ndarray  # coefficients of the contact law of all entries, without the bias


class _FilterFit(NamedTuple):
    """Best fit of a filter with a free cutoff."""

    order: int
    cutoff: float  # Hz
    age: float  # sum of the force delay and the filter's delay at low frequencies [s]
    coefficients: np.ndarray  # coefficients of the contact law, shape (entries, coefficients)
    misfit: float  # chi-squared


def check_hidden_filter(
    contact: ContactFit, mechanism: Mechanism, effect: UncertaintyEffect
) -> list[CheckResult]:
    """Check that filters of order 2 and 4 that fit as closely as the file give the same e and e - e*.

    Args:
        contact: Contact model of the file.
        mechanism: The file.
        effect: Effect of the parameters' uncertainty on e and on e - e*.

    Returns:
        A list with one check; empty if no parameter was identified, if the file states a filter, or if a dead
        zone hides the onset of contact.
    """
    if not effect.parts or contact.readings.low_pass is not None or contact.dead_zone:
        return []
    lag, *filters = (_fit_filter(contact, mechanism, order) for order in (1, *HIDDEN_ORDERS))
    file = min(lag.misfit, _compute_misfit(contact))
    # Unmodelled disturbances enlarge all misfits.
    scale = max(1.0, min(file, *(fit.misfit for fit in filters)) / contact.degrees_of_freedom)
    gains = [(file - fit.misfit) / scale for fit in filters]
    log_weights, changes = [np.log(1.0 - PRIOR_FILTER_PROBABILITY * len(filters))], [(0.0, 0.0)]
    for fit, gain in zip(filters, gains, strict=True):
        if gain > -MAX_LIKELIHOOD_DROP:
            # Both fits have nearly the same error due to the noise, which the file's uncertainty includes.
            change = zip(contact.readings.entries, fit.coefficients - lag.coefficients, strict=True)
            changes.append(compute_change_effect(mechanism, dict(change), fit.age - lag.age))
            log_weights.append(np.log(PRIOR_FILTER_PROBABILITY) + 0.5 * gain)
    weights = special.softmax(log_weights)
    increases = [
        _find_bound(weights, np.array(change), bound) - bound
        for change, bound in zip(zip(*changes, strict=True), effect[:2], strict=True)
    ]
    return [_describe(filters, gains, *increases)]


def _describe(
    filters: list[_FilterFit], gains: list[float], on_restitution: float, on_error: float
) -> CheckResult:
    """Return the check with the filter that explains the logs best.

    `gains` states the decrease of chi-squared by each filter.
    """
    best = int(np.argmax(gains))
    comparison = f"{abs(gains[best]):.3g} {'smaller' if gains[best] > 0.0 else 'larger'}"
    cutoff = f"order {filters[best].order} and {filters[best].cutoff:.3g} Hz"
    finding = f"chi-squared is {comparison} with a filter of {cutoff}"
    is_present = max(on_restitution, on_error) > MIN_EFFECT
    if is_present:
        quality = "better" if gains[best] > MAX_LIKELIHOOD_DROP else "as well"
        finding += f", which explains the logs {quality}; state rig.force_sensor.filter as in its data sheet"
    return CheckResult(
        "filter of the force sensor",
        finding,
        is_present,
        on_restitution,
        on_error=on_error,
        gain=max(gains[best], 0.0),
    )


def _fit_filter(contact: ContactFit, mechanism: Mechanism, order: int) -> _FilterFit:
    """Fit a Butterworth filter with a free cutoff, with all contact parameters, near the file's values."""
    low_pass = SensorFilter(kind="butterworth", order=order, cutoff=ASSUMED_CUTOFF)
    readings, period = replace(contact.readings, low_pass=low_pass), contact.problem.motion.period
    (delay, plane, _), lag = contact.posterior.best, mechanism.rig.force_sensor.time_constant
    surface = None if "rig.contact_plane" in mechanism.uncertainty else plane
    unit_delay = readings.modes.delay
    start = max(lag, START_TIME_CONSTANT_PERIODS * period) / unit_delay
    problem = ContactProblem(contact.problem.motion, readings, contact.law, surface, start)
    problem = summarise_deep_lanes(problem, (delay + lag - start * unit_delay, plane), has_known_delay=True)
    fits: dict[float, _AgeFit] = {}

    def misfit(time_constant: float) -> float:
        if time_constant not in fits:
            nearest = min(fits, key=lambda other: abs(np.log(other / time_constant)), default=None)
            start_at = (delay + lag, plane) if nearest is None else fits[nearest][:2]
            changed = problem.changed(contact.law, time_constant, delay + lag - time_constant * unit_delay)
            fits[time_constant] = _fit_age(changed, *start_at, time_constant * unit_delay)
        return fits[time_constant].misfit

    limits = MIN_TIME_CONSTANT_PERIODS * period, MAX_TIME_CONSTANT
    if order == 1 and lag:  # the file has the best lag
        limits = start, start
    best = _find_minimum(misfit, start, limits)
    table = fits[best].coefficients.reshape(len(readings.entries), -1)
    return _FilterFit(order, 0.5 / (np.pi * best), fits[best].age, table, fits[best].misfit)


def _fit_age(problem: ContactProblem, age: float, plane: float, lag: float) -> _AgeFit:
    """Fit the age of the force by parabolas, with surface position and coefficients.

    Args:
        problem: Contact problem.
        age: Approximate sum of the force delay and the filter's delay [s].
        plane: Approximate surface position [m].
        lag: Filter's delay [s].
    """

    def fit(age: float, plane: float) -> _AgeFit:
        delay = float(np.clip(age - lag, problem.min_delay, MAX_FORCE_DELAY))
        plane, inner, gain = find_best_surface(problem, delay, plane)
        dampings = problem.damping_indices
        positive = special.log_ndtr((inner.coefficients / np.sqrt(np.diag(inner.covariance)))[dampings]).sum()
        coefficients = inner.coefficients
        if inner.by_plane is not None:
            coefficients = coefficients + inner.by_plane * (plane - inner.plane)
        return _AgeFit(delay + lag, plane, inner.misfit - 2.0 * (gain + float(positive)), coefficients[:-1])

    best = fit(age, plane)
    for _ in range(MAX_PARABOLAS):
        low, high = (fit(best.age + side * AGE_STEP, best.plane) for side in (-1.0, 1.0))
        curvature = low.misfit - 2.0 * best.misfit + high.misfit
        shift = 0.5 * AGE_STEP * (low.misfit - high.misfit) / max(curvature, 1e-300)
        limited = float(np.clip(shift, -MAX_AGE_SHIFT, MAX_AGE_SHIFT))
        best = min(low, best, high, fit(best.age + limited, best.plane), key=lambda result: result.misfit)
        if abs(shift) < 2.0 * AGE_STEP:
            break
    return best


def _find_minimum(misfit: Callable[[float], float], start: float, limits: tuple[float, float]) -> float:
    """Return the time constant [s] with the smallest misfit within limits, near a starting value."""
    best = start
    while True:
        low, high = max(best / TRIAL_RATIO, limits[0]), min(best * TRIAL_RATIO, limits[1])
        better = min(low, high, key=misfit)
        if not misfit(better) < misfit(best):
            break
        best = better
    is_inside = low < best < high
    if not is_inside or not misfit(low) + misfit(high) > 2.0 * misfit(best):  # no parabola has a minimum
        return best
    x, y = np.log([low, best, high]), [misfit(value) for value in (low, best, high)]
    a, b, _ = np.polyfit(x - x[1], y, 2)
    vertex = best * float(np.exp(np.clip(-0.5 * b / a, x[0] - x[1], x[2] - x[1])))
    return min(best, vertex, key=misfit)


def _compute_misfit(contact: ContactFit) -> float:
    """Return chi-squared of the file."""
    delay, plane, fit = contact.posterior.best
    residual = contact.readings.force - contact.problem.force(delay, plane, fit.coefficients)
    whitened = contact.problem.whiten(residual) / contact.readings.std
    return float(np.sum(whitened[contact.readings.counts] ** 2))


def _find_bound(weights: np.ndarray, changes: np.ndarray, bound: float) -> float:
    """Return the bound that the magnitude of an error exceeds with a probability of 1 %.

    Args:
        weights: Probability of each model.
        changes: Mean error of the file if this model is true.
        bound: Bound if the file is right, which states the standard deviation of the error.
    """
    std = max(bound, 1e-12) / special.ndtri(0.5 + 0.5 * EFFECT_PROBABILITY)

    def excess(limit: float) -> float:
        outside = special.ndtr((changes - limit) / std) + special.ndtr((-changes - limit) / std)
        return float(weights @ outside) - (1.0 - EFFECT_PROBABILITY)

    root: Any = optimize.brentq(excess, 0.0, np.max(changes) + bound + 10.0 * std)
    return root
