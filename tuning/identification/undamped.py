"""Contact without damping as an alternative to contact with some.

Damping and a force delay that is shorter by damping over stiffness explain touches alike, but for their
onsets. A flat prior of damping says that there is some. Where there is none, noise at a few onsets can then
look like damping with a small standard deviation. The draws therefore are of both alternatives, by their
posterior probabilities (spike-and-slab prior, Mitchell and Beauchamp, "Bayesian variable selection in linear
regression", 1988): half of the prior on no damping, half flat up to `SLAB`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import special

from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import Problem
from tuning.identification.contact_profile import Posterior
from tuning.identification.law_choice import quick

DAMPING, LAG = "damping", "time_constant"
SLAB = 0.01  # s; damping over stiffness is at most that a priori
LEAST = 1e-4  # probability of no damping below which it is left out
SIMPLER = 7.0  # of the log probability, the most that no damping gains by having a number less

# Fits a law; returns its posterior, and the logarithm of that posterior's integral.
Fit = Callable[[Law], tuple[Posterior, float]]


def without_damping(law: Law) -> Law:
    """Return a law with the damping proportional to the rate left out."""
    names = tuple(name for name in law.names if name != DAMPING)
    return replace(law, names=names, shared=lambda depth, rate: [], pulls=False)


def averaged(problem: Problem, posterior: Posterior, evidence: float, fit: Fit) -> Posterior:
    """Return the posterior with draws of contact without damping in it, as many as that is probable.

    `evidence`: the logarithm of the posterior's integral, flat over damping.
    """
    law = problem.law
    own = len(law.own(np.zeros(1), np.zeros(1)))
    if DAMPING not in law.names[own:]:
        return posterior
    delay, plane, best = posterior.best
    slab = 0.5 * np.log(2.0 * np.pi) - np.log(SLAB * max(float(best.coefficients[0]), 1e-300))
    simpler = without_damping(law)
    alone = Problem(problem.motion, problem.readings, simpler, problem.plane, problem.time_constant)
    closest = quick(alone, (delay, plane, best.misfit))
    if 0.5 * (best.misfit - closest[2]) + SIMPLER < np.log(LEAST):
        return posterior
    other, other_evidence = fit(simpler)
    share = float(special.expit(other_evidence - (evidence + slab)))
    if share < LEAST:
        return posterior
    count, names = round(share * len(posterior.draws)), posterior.names
    columns = dict(zip(other.names, other.draws[:count].T, strict=True))
    lag = columns.get(LAG, np.zeros(count))
    if LAG not in names:
        columns["delay"] = columns["delay"] + lag
    rows = np.column_stack([columns.get(name, np.zeros(count)) for name in names])
    mixed = np.concatenate([rows, posterior.draws[count:]])
    return replace(posterior, draws=np.random.default_rng(count).permutation(mixed))
