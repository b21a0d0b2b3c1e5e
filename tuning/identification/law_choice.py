"""Choice of the contact law: the simplest law that predicts contacts which its fit did not use.

Each law is fitted to the odd contacts and evaluated on the even contacts, and vice versa (cross-validation).
The measure is the log likelihood of each contact. A law is acceptable if its total log likelihood is at most
two standard errors below the best total. The law with the best Bayesian information criterion is acceptable,
too. Of the acceptable laws, the one with the fewest parameters is chosen. If there are fewer than four
contacts, the information criterion replaces cross-validation.

A law without damping is chosen only if the user names it. To first order, a contact determines only the
difference damping - stiffness * force delay. A law without damping attributes the whole difference to the
delay, whose interval is then much too narrow. A law whose damping is zero at zero depth has this fault at the
onset. It is therefore chosen only if the contacts exclude damping at the onset. The linear law is not needed,
because the Kelvin-Voigt law includes it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.contact.regression import RegressionFamily
from tuning.identification.contact_laws import Law, kelvin_voigt
from tuning.identification.contact_problem import COARSE_DELAY_STEP, MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import estimate_surface_from_onset
from tuning.identification.deep_contact import select_representative_lanes
from tuning.identification.force_readings import ForceReadings
from tuning.identification.motion import MotionResponse
from tuning.identification.surface_search import (
    MIN_LIKELIHOOD_GAIN,
    find_best_surface,
    has_onset_damping,
)

MIN_CONTACTS_FOR_CROSS_VALIDATION = 4  # minimum number of contacts for cross-validation
# Maximum deficit of an acceptable law in log likelihood, in standard errors of the deficit.
MAX_LIKELIHOOD_DEFICIT_ERRORS = 2.0
ONSET_DAMPING_EXCLUSION_ERRORS = 4.0  # minimum deficit that excludes onset damping, in standard errors
MAX_PARABOLAS = 4  # maximum number of parabolas in a precise search of the delay
MIN_PARABOLA_DECREASE = 0.2  # decrease of chi-squared below which the precise search ends
ONSET_MARGIN = 1e-3  # the evaluation omits rows within this time of an onset or a release [s]


@dataclass(frozen=True)
class EvaluatedLaw:
    """Contact law with its best fit, and its log likelihood in the cross-validation."""

    law: Law
    delay: float  # force delay of the best fit [s]
    plane: float  # surface position of the best fit [m]
    misfit: float  # chi-squared of all contacts
    likelihood: np.ndarray  # log likelihood of each contact under a fit that does not use it
    # Total log likelihood of the best law minus that of this law, and the standard error of this difference.
    likelihood_deficit: tuple[float, float]


def choose_contact_law(
    motion: MotionResponse, readings: ForceReadings, plane: float | None, names=None
) -> list[EvaluatedLaw]:
    """Fit and evaluate the laws `names`, or all contact laws; return them, the chosen law first.

    A long press run (pressed against the surface) has many similar segments. Shape parameters are therefore
    first fitted to a few of these segments.
    """
    evaluated = []
    lanes = select_representative_lanes(ContactProblem(motion, readings, kelvin_voigt(), plane))
    few_lanes, few_readings = motion.of(lanes), readings.select_lanes(lanes)
    is_same, fitted_families = len(lanes) == readings.force.shape[1], {}
    _, plane_there, _ = guess = _fit_coarsely(few_lanes, few_readings, kelvin_voigt(), plane, None)
    test_readings = replace(readings, counts=readings.counts & ~flag_rows_near_edges(motion, readings, guess))
    deepest = float(np.max(motion.at(guess[0])[0][readings.counts])) - plane_there
    for family in list_law_families(deepest, len(readings.entries), names):
        law, result = _fit_shape(
            family, lambda candidate: _fit_coarsely(few_lanes, few_readings, candidate, plane, guess)
        )
        result = result if is_same else _fit_coarsely(motion, readings, law, plane, guess)
        fitted_families[id(law)] = family
        evaluated.append((law, result, _cross_validate(motion, readings, test_readings, law, plane, result)))
    totals = [likelihood.sum() for _, _, likelihood in evaluated]
    best = evaluated[int(np.argmax(totals))][2]
    results = []
    for law, (delay, at, misfit), likelihood in evaluated:
        behind = best - likelihood
        error = float(np.sqrt(len(behind)) * behind.std(ddof=1)) if len(behind) > 1 else 0.0
        results.append(EvaluatedLaw(law, delay, at, misfit, likelihood, (float(behind.sum()), error)))
    rows = np.log(max(readings.counts.sum(), 2))
    preferred = min(results, key=lambda fit: fit.misfit + rows * fit.law.complexity)
    # The delay absorbs the damping that a law omits, so such a law is chosen only if the user names it.
    damped = [fit for fit in results if "damping" in fit.law.names] or results
    # If the damping of a law is zero at zero depth, the delay also absorbs the damping at the onset.
    least = min(fit.misfit for fit in results)
    damped_at_onset = [fit for fit in damped if has_onset_damping(fit.law)]
    if any(
        fit.likelihood_deficit[0] <= ONSET_DAMPING_EXCLUSION_ERRORS * fit.likelihood_deficit[1] + 1e-9
        and fit.misfit <= least + ONSET_DAMPING_EXCLUSION_ERRORS**2
        for fit in damped_at_onset
    ):
        damped = damped_at_onset
    good = [
        fit
        for fit in damped
        if fit is preferred
        or fit.likelihood_deficit[0] <= MAX_LIKELIHOOD_DEFICIT_ERRORS * fit.likelihood_deficit[1] + 1e-9
    ]
    good = good or [min(damped, key=lambda fit: fit.likelihood_deficit[0])]
    # Of laws with equal complexity, the first one is chosen, because their misfits differ only by noise.
    chosen = min(good, key=lambda fit: fit.law.complexity)
    others = [fit for fit in results if fit is not chosen]
    if not is_same and chosen.law.shape:
        law, (delay, at, misfit) = _fit_shape(
            fitted_families[id(chosen.law)],
            lambda candidate: _fit_coarsely(motion, readings, candidate, plane, guess),
        )
        chosen = replace(chosen, law=law, delay=delay, plane=at, misfit=misfit)
    return [chosen, *sorted(others, key=lambda fit: fit.likelihood_deficit[0])]


CoarseFit = tuple[float, float, float]  # delay [s], surface position [m], and chi-squared
# Names of the laws that can be fitted to logs, in the order of `list_law_families`.
FITTABLE_LAW_NAMES = tuple(name for name, law in CONTACT_LAWS.items() if law.families(1.0, 1))


def list_law_families(
    deepest: float, entries: int, names: Sequence[str] | None = None
) -> list[RegressionFamily]:
    """Return the families of the laws `names`, or of all laws; a family has at most one shape parameter.

    Args:
        deepest: Largest depth of all contacts [m].
        entries: Number of entries in the lists in `[contact]`.
        names: Names of the laws, or None for all laws that can be fitted to logs.
    """
    laws = [CONTACT_LAWS[name] for name in FITTABLE_LAW_NAMES if names is None or name in names]
    return [family for law in laws for family in law.families(deepest, entries)]


def _fit_shape(family: RegressionFamily, fit: Callable[[Law], CoarseFit]) -> tuple[Law, CoarseFit]:
    """Fit the shape parameter of a family of laws; return the best law and its fit."""
    if family.low == family.high:
        law = family.make(family.low)
        return law, fit(law)
    optimum: Any = optimize.minimize_scalar(
        lambda shape: fit(family.make(shape))[2],
        bounds=(family.low, family.high),
        method="bounded",
        options={"xatol": 0.001 * (family.high - family.low)},
    )
    # A usual value of the shape parameter is preferred if it fits nearly as well as the best value.
    as_good = (value for value in family.preferred if fit(family.make(value))[2] - optimum.fun < 4.0)
    law = family.make(next(as_good, float(optimum.x)))
    return law, fit(law)


def _fit_coarsely(motion, readings, law, plane, guess: CoarseFit | None) -> CoarseFit:
    """Fit a law near a guess; without a guess, search all delays (see `search_coarsely`)."""
    problem = ContactProblem(motion, readings, law, plane)
    return search_coarsely(problem, guess)


def search_coarsely(problem: ContactProblem, guess: CoarseFit | None = None, reach: int = 4) -> CoarseFit:
    """Search the best fit in coarse steps; return its force delay [s], surface position [m] and chi-squared.

    Args:
        problem: Contact problem.
        guess: Approximate delay and surface position, or None to search all delays.
        reach: Number of coarse delay steps that are searched on either side of the guess.
    """
    if guess is None:
        start = (
            problem.plane
            if problem.plane is not None
            else estimate_surface_from_onset(problem, MAX_FORCE_DELAY / 4.0)
        )
        delays = np.arange(problem.min_delay, MAX_FORCE_DELAY, 2.0 * COARSE_DELAY_STEP)
    else:
        start = guess[1]
        delays = guess[0] + COARSE_DELAY_STEP * np.array([-4, -2, -1, 0, 1, 2, 4])
        delays = delays[np.abs(delays - guess[0]) <= (reach + 0.5) * COARSE_DELAY_STEP]
    # Near a guess, only the last delays are worth the time to find the best surface among its local optima.
    best = _search_delays(problem, delays, (0.0, start, np.inf), guess is None)
    for width, is_last in ((COARSE_DELAY_STEP, False), (COARSE_DELAY_STEP / 4.0, True)):
        delays = best[0] + width * np.array([-1.0, -0.5, 0.5, 1.0])
        best = _search_delays(problem, delays, best, guess is None or is_last)
    return best


def search_precisely(problem: ContactProblem, guess: CoarseFit) -> CoarseFit:
    """Search the best fit near a guess so precisely that fits with different lags can be compared.

    The search goes on beyond the delays of `search_coarsely` as long as the fit clearly improves. A parabola
    then gives the delay between the coarse steps, which matters if many readings determine the delay to less
    than a step.
    """
    best = search_coarsely(problem, guess, 2)
    while best[2] < guess[2] - 2.0 * MIN_LIKELIHOOD_GAIN and abs(best[0] - guess[0]) > COARSE_DELAY_STEP:
        guess, best = best, min(best, search_coarsely(problem, best, 2), key=lambda fit: fit[2])
    step = COARSE_DELAY_STEP / 8.0
    for _ in range(MAX_PARABOLAS):
        start = (*best[:2], np.inf)
        sides = [_search_delays(problem, best[0] + np.array([side]), start, False) for side in (-step, step)]
        rise, slope = sides[0][2] + sides[1][2] - 2.0 * best[2], sides[0][2] - sides[1][2]
        shift = np.clip(0.5 * slope / rise, -1.0, 1.0) if rise > 0.0 else 0.0
        if rise * shift**2 < 2.0 * MIN_PARABOLA_DECREASE:
            break
        vertex = best[0] + np.array([shift * step])
        best = _search_delays(problem, vertex, min(*sides, best, key=lambda fit: fit[2]), True)
        step /= 2.0
    return best


def _search_delays(
    problem: ContactProblem, delays: np.ndarray, best: CoarseFit, is_thorough: bool
) -> CoarseFit:
    """Return the best fit at one of the delays [s], or `best` if it is better."""
    for delay in np.clip(delays, problem.min_delay, MAX_FORCE_DELAY):
        enough = best[2] if is_thorough else -np.inf
        plane, inner, gain = find_best_surface(problem, float(delay), best[1], enough)
        if inner.misfit - 2.0 * gain < best[2]:
            best = (float(delay), plane, inner.misfit - 2.0 * gain)
    return best


def flag_rows_near_edges(motion: MotionResponse, readings: ForceReadings, guess: CoarseFit) -> np.ndarray:
    """Flag the rows that are at most `ONSET_MARGIN` from an onset or a release, shape (rows, lanes).

    The force of a damped contact jumps there. These rows are not used to compare laws, because their
    residuals depend on the exact time of the jump.
    """
    delay, plane, _ = guess
    shortest = -max(motion.delay, 0.0)
    flags = [
        motion.at(max(d, shortest))[0] > plane for d in (delay - ONSET_MARGIN, delay, delay + ONSET_MARGIN)
    ]
    return np.any(flags, axis=0) & ~np.all(flags, axis=0)


def _cross_validate(motion, readings, tested: ForceReadings, law, plane, start: CoarseFit) -> np.ndarray:
    """Return the log likelihood of each odd contact under a fit to the even contacts, and vice versa.

    If there are too few contacts, the result is one value: minus half the Bayesian information criterion.
    """
    lanes = readings.force.shape[1]
    if lanes < MIN_CONTACTS_FOR_CROSS_VALIDATION:
        size = law.complexity * np.log(max(readings.counts.sum(), 2)) / 2.0
        return np.array([-0.5 * start[2] - size])
    likelihood = np.empty(lanes)
    for parity in (0, 1):
        is_test = np.arange(lanes) % 2 == parity
        training = replace(readings, counts=readings.counts & ~is_test)
        problem = ContactProblem(motion, training, law, plane)
        delay, at, _ = search_coarsely(problem, start, 1)
        coefficients = problem.at(delay, at).coefficients
        misfits = compute_contact_misfits(problem, tested, delay, at, coefficients)
        likelihood[is_test] = -0.5 * misfits[is_test]
    return likelihood


def compute_contact_misfits(
    problem: ContactProblem, readings: ForceReadings, delay, plane, coefficients
) -> np.ndarray:
    """Return chi-squared of each contact: squared whitened residuals divided by the noise's variance."""
    left = problem.whiten(readings.force - problem.force(delay, plane, coefficients)) / readings.std
    return np.sum(np.where(readings.counts, left, 0.0) ** 2, axis=0)
