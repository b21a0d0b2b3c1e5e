"""Which contact law a mechanism has: the simplest one that predicts touches it was not fitted to.

Every law is fitted to the odd touches and judged on the even ones, and the other way round, by the log
likelihood of whole touches. Laws within two standard errors of the best, touch by touch, are as good, and so
is the one that the Bayesian information criterion prefers over all rows; the one with the fewest numbers is
taken. With fewer than four touches the criterion alone judges.

A law without damping is taken only where it is named. To first order a contact shows damping less stiffness
times the age of the force: without damping the delay would take its place, with an interval that is far too
narrow. Kelvin and Voigt's law contains the linear one. For the same reason a law whose
damping begins with the depth is taken only where the touches rule damping at the onset out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import optimize

from jaxhil.contact.laws import LAWS
from jaxhil.contact.regression import Family
from tuning.identification.contact_laws import Law, kelvin_voigt
from tuning.identification.contact_problem import COARSE, LONGEST, Problem, Readings
from tuning.identification.contact_profile import first_plane
from tuning.identification.motion import Motion

FEWEST = 4  # touches for judging on others than those fitted
ERRORS = 2.0  # standard errors within which laws are as good
CLEAR = 4.0  # standard errors beyond which damping that acts at the onset is ruled out
ONSET = 1e-3  # s, before and after a touch's begin, by which laws are not judged


@dataclass(frozen=True)
class Judged:
    """One law, fitted and judged."""

    law: Law
    delay: float  # s
    plane: float  # m
    misfit: float  # of all touches
    likelihood: np.ndarray  # of each touch by the fit to others, natural logarithm
    short: tuple[float, float]  # by how much the best law is better in all, and the standard error of that


def judge(motion: Motion, readings: Readings, plane: float | None, names=None) -> list[Judged]:
    """All laws (or those named), the one to take first."""
    judged = []
    _, plane_there, _ = guess = _fit(motion, readings, kelvin_voigt(), plane, None)
    judging = replace(readings, counts=readings.counts & ~at_onset(motion, readings, guess))
    deepest = float(np.max(motion.at(guess[0])[0][readings.counts])) - plane_there
    for family in families(deepest, len(readings.entries), names):
        law, found = _search(family, lambda one: _fit(motion, readings, one, plane, guess))
        judged.append((law, found, _by_others(motion, readings, judging, law, plane, found)))
    totals = [likelihood.sum() for _, _, likelihood in judged]
    best = judged[int(np.argmax(totals))][2]
    results = []
    for law, (delay, at, misfit), likelihood in judged:
        behind = best - likelihood
        error = float(np.sqrt(len(behind)) * behind.std(ddof=1)) if len(behind) > 1 else 0.0
        results.append(Judged(law, delay, at, misfit, likelihood, (float(behind.sum()), error)))
    rows = np.log(max(readings.counts.sum(), 2))
    preferred = min(results, key=lambda one: one.misfit + rows * one.law.complexity)
    # The delay takes the place of a damping that a law lacks: such a law is taken only where it is named.
    damped = [one for one in results if "damping" in one.law.names] or results
    # So it would of a damping that begins with the depth, for one that acts at the onset.
    least = min(one.misfit for one in results)
    at_once = [one for one in damped if acts_at_onset(one.law)]
    if any(one.short[0] <= CLEAR * one.short[1] + 1e-9 and one.misfit <= least + CLEAR**2 for one in at_once):
        damped = at_once
    good = [one for one in damped if one is preferred or one.short[0] <= ERRORS * one.short[1] + 1e-9]
    good = good or [min(damped, key=lambda one: one.short[0])]
    # Of laws with as many numbers the first in the list: by misfit, noise would choose.
    taken = min(good, key=lambda one: one.law.complexity)
    return [taken, *(one for one in sorted(results, key=lambda one: one.short[0]) if one is not taken)]


def acts_at_onset(law: Law) -> bool:
    """Return whether the law has a force at the surface that is proportional to the rate."""
    surface, rate = np.zeros(1), np.ones(1)
    return any(np.any(value != 0.0) for value in (*law.own(surface, rate), *law.shared(surface, rate)))


Fitted = tuple[float, float, float]  # delay, plane, misfit
# Laws that fits can find; `families` has the same order.
NAMES = tuple(name for name, law in LAWS.items() if law.families(1.0, 1))


def families(deepest: float, entries: int, names: Sequence[str] | None = None) -> list[Family]:
    """Return what to try of every law, or of those named; `deepest`: of all touches [m]."""
    laws = [LAWS[name] for name in NAMES if names is None or name in names]
    return [family for law in laws for family in law.families(deepest, entries)]


def _search(family: Family, fit: Callable[[Law], Fitted]) -> tuple[Law, Fitted]:
    """Return the law of the family that fits best, and its fit."""
    if family.low == family.high:
        law = family.make(family.low)
        return law, fit(law)
    found: Any = optimize.minimize_scalar(
        lambda shape: fit(family.make(shape))[2],
        bounds=(family.low, family.high),
        method="bounded",
        options={"xatol": 0.001 * (family.high - family.low)},
    )
    # A usual value that explains as much is meant.
    as_good = (value for value in family.usual if fit(family.make(value))[2] - found.fun < 4.0)
    law = family.make(next(as_good, float(found.x)))
    return law, fit(law)


def _fit(motion, readings, law, plane, guess: Fitted | None) -> Fitted:
    """Delay, plane and misfit of the best fit, without the posterior."""
    problem = Problem(motion, readings, law, plane)
    return quick(problem, guess)


def quick(problem: Problem, guess: Fitted | None = None, reach: int = 4) -> Fitted:
    """The best delay and plane: within `reach` of the coarse steps about a guess, or anywhere."""
    if guess is None:
        start = problem.plane if problem.plane is not None else first_plane(problem, LONGEST / 4.0)
        delays = np.arange(problem.shortest, LONGEST, 2.0 * COARSE)
    else:
        steps = np.array([step for step in (-4, -2, -1, 0, 1, 2, 4) if abs(step) <= reach])
        start = guess[1]
        delays = np.clip(guess[0] + COARSE * steps, problem.shortest, LONGEST)
    best = (0.0, start, np.inf)
    for width in (0.0, COARSE, COARSE / 4.0):
        if width:
            delays = best[0] + width * np.array([-1.0, -0.5, 0.5, 1.0])
            delays = np.clip(delays, problem.shortest, LONGEST)
        for delay in delays:
            plane, inner, gain = problem.settled(float(delay), best[1])
            if inner.misfit - 2.0 * gain < best[2]:
                best = (float(delay), plane, inner.misfit - 2.0 * gain)
    return best


def at_onset(motion: Motion, readings: Readings, guess: Fitted) -> np.ndarray:
    """Rows near the first and the last of a contact: a damped one begins with a jump, and whether a row is on
    this or that side of it says nothing of the law."""
    delay, plane, _ = guess
    shortest = -max(motion.delay, 0.0)
    flags = [motion.at(max(one, shortest))[0] > plane for one in (delay - ONSET, delay, delay + ONSET)]
    return np.any(flags, axis=0) & ~np.all(flags, axis=0)


def _by_others(motion, readings, judging: Readings, law, plane, found: Fitted) -> np.ndarray:
    """Log likelihood of each touch under the fit to the touches of the other parity."""
    lanes = readings.force.shape[1]
    if lanes < FEWEST:
        size = law.complexity * np.log(max(readings.counts.sum(), 2)) / 2.0
        return np.array([-0.5 * found[2] - size])
    likelihood = np.empty(lanes)
    for parity in (0, 1):
        mine = np.arange(lanes) % 2 == parity
        taught = replace(readings, counts=readings.counts & ~mine)
        problem = Problem(motion, taught, law, plane)
        delay, at, _ = quick(problem, found, 1)
        coefficients = problem.at(delay, at).coefficients
        likelihood[mine] = -0.5 * misfits(problem, judging, delay, at, coefficients)[mine]
    return likelihood


def misfits(problem: Problem, readings: Readings, delay, plane, coefficients) -> np.ndarray:
    """Sum of squared whitened residuals of each touch."""
    left = problem.whiten(readings.force - problem.force(delay, plane, coefficients)) / readings.std
    return np.sum(np.where(readings.counts, left, 0.0) ** 2, axis=0)
