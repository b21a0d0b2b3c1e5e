"""Fits of the contact with a filter of the force sensor in place of a lag, on a grid of cutoffs and delays.

A filter smooths the onset of contact, so that many pairs of damping and delay can explain the logs. The grid
therefore contains all likely cutoffs and, at each cutoff, all likely ages of the force (sum of the force
delay and the filter's delay at low frequencies). As in `damping_average`, the damping may be zero; otherwise,
the ratio of damping to stiffness has a uniform prior.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import special

from jaxhil.mechanism.structs import Mechanism, SensorFilter
from tuning.identification.contact_fit import ContactFit
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.damping_average import MAX_DAMPING_OVER_STIFFNESS
from tuning.identification.deep_contact import summarise_deep_lanes
from tuning.identification.sensor_lag import MAX_TIME_CONSTANT
from tuning.identification.stated_filter import MIN_TIME_CONSTANT_PERIODS
from tuning.identification.surface_search import find_best_surface
from tuning.identification.uncertainty_effect import FORCE_DELAY_KEY

ASSUMED_CUTOFF = 100.0  # Hz; only kind and order matter until the cutoff is fitted
START_TIME_CONSTANT_PERIODS = 0.25  # first time constant without a lag in the file, in control periods
TRIAL_RATIO = 2.0  # ratio of successive time constants in the search
FIRST_TRIALS = 4  # number of time constants that begin the search
AGE_STEP = 5e-5  # step of the search for the age of the force [s]
MAX_AGE_SHIFT = 5e-4  # maximum shift of the age by a parabola [s]
MAX_PARABOLAS = 3  # maximum number of parabolas
GRID_AGE_STEP = 1e-4  # step of the ages on the grid [s]
GRID_RATIO = 2.0**0.5  # ratio of successive time constants on the grid
MAX_AGE_REACH = 4e-3  # maximum distance between an age on the grid and the best one [s]
# Prior probability of zero damping. It is smaller than in `damping_average`, because every mechanism has some
# damping, and a filter hides a small one.
UNDAMPED_PROBABILITY = 0.1
MAX_GRID_INCREASE = 9.0  # maximum increase of chi-squared on the grid, above the best fit
# Unmodelled disturbances multiply chi-squared, at most by this factor: beyond it, other checks fail.
MAX_REDUCED_CHI_SQUARE = 2.0


class GridFit(NamedTuple):
    """Fit of the contact at one cutoff and one age of the force."""

    age: float  # sum of the force delay and the filter's delay at low frequencies [s]
    plane: float  # surface position [m]
    coefficients: np.ndarray  # coefficients of the contact law of all entries, without the bias
    misfit: float  # chi-squared, plus the penalty
    penalty: float  # penalty of negative damping
    log_prior: float = 0.0  # log prior probability, up to a constant


class FilterFit(NamedTuple):
    """Best fit of a filter with a free cutoff, and fits on a grid near it."""

    order: int
    cutoff: float  # Hz
    best: GridFit
    grid: list[GridFit]  # empty for order 1

    @property
    def misfit(self) -> float:
        """Return chi-squared of the best fit, without the penalty of negative damping."""
        return self.best.misfit - self.best.penalty


def fit_filter(contact: ContactFit, mechanism: Mechanism, order: int) -> FilterFit:
    """Fit a Butterworth filter with a free cutoff, with all contact parameters, near the file's values.

    Args:
        contact: Contact model of the file.
        mechanism: The file.
        order: Order of the filter. If the file has a lag, order 1 keeps its time constant.
    """
    fits = _FilterFits(contact, mechanism, order)
    best = fits.find_best_time_constant()
    grid = [
        point
        for time_constant in (fits.list_likely_time_constants(best) if order > 1 else [])
        for point in fits.list_hypotheses(time_constant)
    ]
    best = min(fits.best_fits, key=lambda time_constant: fits.at(time_constant).misfit)
    return FilterFit(order, 0.5 / (np.pi * best), fits.at(best), grid)


def has_free_delay(mechanism: Mechanism) -> bool:
    """Return whether the file's force delay is uncertain, so that the grid covers all likely ages."""
    return FORCE_DELAY_KEY in mechanism.uncertainty


class _FilterFits:
    """Fits of the contact with a filter, by the filter's time constant [s]."""

    def __init__(self, contact: ContactFit, mechanism: Mechanism, order: int):
        low_pass = SensorFilter(kind="butterworth", order=order, cutoff=ASSUMED_CUTOFF)
        readings, period = replace(contact.readings, low_pass=low_pass), contact.problem.motion.period
        (delay, plane, _), lag = contact.posterior.best, mechanism.rig.force_sensor.time_constant
        surface = None if "rig.contact_plane" in mechanism.uncertainty else plane
        self.unit_delay = readings.modes.delay  # delay of the filter, divided by the time constant
        self.start = max(lag, START_TIME_CONSTANT_PERIODS * period) / self.unit_delay
        least = MIN_TIME_CONSTANT_PERIODS * period
        self.limits = least, max(MAX_TIME_CONSTANT, self.start, TRIAL_RATIO * least)
        if order == 1 and lag:  # the file has the best lag
            self.limits = self.start, self.start
        self.near, self.has_free_delay = (delay + lag, plane), has_free_delay(mechanism)
        self.degrees_of_freedom = contact.degrees_of_freedom
        problem = ContactProblem(contact.problem.motion, readings, contact.law, surface, self.start)
        at_start = delay + lag - self.start * self.unit_delay, plane
        self.problem = summarise_deep_lanes(problem, at_start, has_known_delay=True)
        self.problems: dict[float, ContactProblem] = {}
        self.best_fits: dict[float, GridFit] = {}

    def at(self, time_constant: float) -> GridFit:
        """Return the fit with the best age of the force."""
        if time_constant not in self.best_fits:
            nearest = min(self.best_fits, key=lambda other: abs(np.log(other / time_constant)), default=None)
            age, plane = self.near if nearest is None else self.best_fits[nearest][:2]
            lag = time_constant * self.unit_delay
            problem = self.problem.changed(self.problem.law, time_constant, self.near[0] - lag)
            self.problems[time_constant] = problem
            self.best_fits[time_constant] = _fit_age(problem, age, plane, lag)
        return self.best_fits[time_constant]

    def find_best_time_constant(self) -> float:
        """Find the time constant with the smallest misfit."""

        def misfit(time_constant: float) -> float:
            return self.at(time_constant).misfit

        least, largest = self.limits
        trials = np.clip(self.start * TRIAL_RATIO ** np.arange(FIRST_TRIALS), least, largest)
        best = min(trials.tolist(), key=misfit)
        while True:
            low, high = max(best / TRIAL_RATIO, least), min(best * TRIAL_RATIO, largest)
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

    def list_likely_time_constants(self, best: float) -> list[float]:
        """Return the likely time constants on a logarithmic grid around the best one."""
        values, (least, largest) = [best], self.limits
        highest = self._limit_misfit(best)
        for ratio in (1.0 / GRID_RATIO, GRID_RATIO):
            value = best * ratio
            while least <= value <= largest and self.at(value).misfit < highest:
                values.append(value)
                value *= ratio
        return values

    def list_hypotheses(self, time_constant: float) -> list[GridFit]:
        """Return all likely fits at a time constant, with prior probabilities."""
        if not self.has_free_delay:
            return [self.at(time_constant)]
        profile, dampings = self._profile_age(time_constant), self.problem.damping_indices
        if len(profile) == 1 or not dampings:
            return profile
        share = (1.0 - UNDAMPED_PROBABILITY) * GRID_AGE_STEP / MAX_DAMPING_OVER_STIFFNESS
        hypotheses = [fit._replace(log_prior=float(np.log(share))) for fit in profile]
        for below, above in pairwise(profile):
            low, high = (float(fit.coefficients[dampings].mean()) for fit in (below, above))
            if low < 0.0 <= high:
                age = below.age - low / (high - low) * (above.age - below.age)
                undamped = self._fit_contact(time_constant, age, below.plane)
                hypotheses.append(
                    undamped._replace(
                        misfit=undamped.misfit - undamped.penalty,
                        log_prior=float(np.log(UNDAMPED_PROBABILITY)),
                    )
                )
        return hypotheses

    def _profile_age(self, time_constant: float) -> list[GridFit]:
        """Fit the contact at ages around the best one; return the likely fits, sorted by age."""
        best, sides = self.at(time_constant), []
        for side in (-1.0, 1.0):
            fits = [best]
            while abs(fits[-1].age - best.age) < MAX_AGE_REACH:
                fit = self._fit_contact(time_constant, fits[-1].age + side * GRID_AGE_STEP, fits[-1].plane)
                if fit.age == fits[-1].age:  # at a limit of the delay
                    break
                fits.append(fit)
                if fit.misfit > self._limit_misfit(time_constant):
                    break
            sides.append(fits[1:])
        return [*reversed(sides[0]), best, *sides[1]]

    def _fit_contact(self, time_constant: float, age: float, plane: float) -> GridFit:
        return _fit_contact(self.problems[time_constant], age, plane, time_constant * self.unit_delay)

    def _limit_misfit(self, time_constant: float) -> float:
        """Return the largest misfit of a likely fit, from the best fit at a time constant."""
        least = self.at(time_constant).misfit
        return least + MAX_GRID_INCREASE * find_scale(least, self.degrees_of_freedom)


def find_scale(misfit: float, degrees_of_freedom: int) -> float:
    """Return the factor by which unmodelled disturbances multiply chi-squared."""
    return float(np.clip(misfit / degrees_of_freedom, 1.0, MAX_REDUCED_CHI_SQUARE))


def _fit_age(problem: ContactProblem, age: float, plane: float, lag: float) -> GridFit:
    """Fit the age of the force by parabolas, with surface position and coefficients.

    Args:
        problem: Contact problem.
        age: Approximate sum of the force delay and the filter's delay [s].
        plane: Approximate surface position [m].
        lag: Filter's delay [s].
    """
    best = _fit_contact(problem, age, plane, lag)
    for _ in range(MAX_PARABOLAS):
        ages = best.age + AGE_STEP * np.array([-1.0, 1.0])
        low, high = (_fit_contact(problem, value, best.plane, lag) for value in ages.tolist())
        curvature = low.misfit - 2.0 * best.misfit + high.misfit
        shift = 0.5 * AGE_STEP * (low.misfit - high.misfit) / max(curvature, 1e-300)
        limited = float(np.clip(shift, -MAX_AGE_SHIFT, MAX_AGE_SHIFT))
        moved = _fit_contact(problem, best.age + limited, best.plane, lag)
        best = min(low, best, high, moved, key=lambda result: result.misfit)
        if abs(shift) < 2.0 * AGE_STEP:
            break
    return best


def _fit_contact(problem: ContactProblem, age: float, plane: float, lag: float) -> GridFit:
    """Fit surface position and coefficients at one age of the force, with the arguments of `_fit_age`."""
    delay = float(np.clip(age - lag, problem.min_delay, MAX_FORCE_DELAY))
    plane, inner, gain = find_best_surface(problem, delay, plane)
    dampings = problem.damping_indices
    positive = special.log_ndtr((inner.coefficients / np.sqrt(np.diag(inner.covariance)))[dampings]).sum()
    coefficients, penalty = inner.coefficients, -2.0 * float(positive)
    if inner.by_plane is not None:
        coefficients = coefficients + inner.by_plane * (plane - inner.plane)
    return GridFit(delay + lag, plane, coefficients[:-1], inner.misfit - 2.0 * gain + penalty, penalty)
