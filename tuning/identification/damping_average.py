"""Bayesian average over contact models with and without damping.

A damping b has nearly the same effect on a contact as a force delay that is shorter by b / k (k: stiffness).
Only readings at the onset of contact distinguish the two. Under a flat prior, the probability that the
damping is exactly zero vanishes, and noise at a few onsets can look like a small damping with a small
standard deviation. The draws therefore come from both models, in proportion to their posterior probabilities
(spike-and-slab prior, Mitchell and Beauchamp, "Bayesian variable selection in linear regression", 1988). The
prior probability of zero damping is one half. The other half is uniform in the ratio of damping to stiffness,
from 0 to `MAX_DAMPING_OVER_STIFFNESS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import special

from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_profile import Posterior
from tuning.identification.law_choice import search_coarsely

DAMPING_NAME, TIME_CONSTANT_NAME = "damping", "time_constant"
MAX_DAMPING_OVER_STIFFNESS = 0.01  # upper bound of the ratio of damping to stiffness in the prior [s]
MIN_UNDAMPED_PROBABILITY = 1e-4  # minimum posterior probability of an undamped model that is not ignored
# Upper bound of the gain in log evidence of the undamped model, which has one parameter less.
MAX_OCCAM_GAIN = 7.0

# Function that fits a law and returns the posterior and the log evidence.
FitLaw = Callable[[Law], tuple[Posterior, float]]


def drop_damping_term(law: Law) -> Law:
    """Return the law without its damping term.

    The damping term is the same for all entries of the lists in `[contact]`.
    """
    names = tuple(name for name in law.names if name != DAMPING_NAME)
    return replace(law, names=names, shared=lambda depth, rate: [], pulls=False)


def average_over_damping(
    problem: ContactProblem, posterior: Posterior, evidence: float, fit: FitLaw
) -> Posterior:
    """Replace a share of the posterior draws by draws of the law without damping.

    The share is the posterior probability of zero damping.

    Args:
        problem: Contact problem with the damped law.
        posterior: Posterior of this problem.
        evidence: Log evidence of the damped law under a flat prior of the damping.
        fit: Function that fits a law and returns its posterior and log evidence.

    Returns:
        The posterior with draws of both models. If zero damping is improbable, or the law has no damping
        term, the posterior is unchanged.
    """
    law = problem.law
    own_count = len(law.entry_functions(np.zeros(1), np.zeros(1)))
    if DAMPING_NAME not in law.names[own_count:]:
        return posterior
    delay, plane, best = posterior.best
    slab = 0.5 * np.log(2.0 * np.pi) - np.log(
        MAX_DAMPING_OVER_STIFFNESS * max(float(best.coefficients[0]), 1e-300)
    )
    simpler = drop_damping_term(law)
    alone = problem.changed(simpler, problem.time_constant)
    closest = search_coarsely(alone, (delay, plane, best.misfit))
    if 0.5 * (best.misfit - closest[2]) + MAX_OCCAM_GAIN < np.log(MIN_UNDAMPED_PROBABILITY):
        return posterior
    alternative, other_evidence = fit(simpler)
    share = float(special.expit(other_evidence - (evidence + slab)))
    if share < MIN_UNDAMPED_PROBABILITY:
        return posterior
    count, names = round(share * len(posterior.draws)), posterior.names
    columns = dict(zip(alternative.names, alternative.draws[:count].T, strict=True))
    lag = columns.get(TIME_CONSTANT_NAME, np.zeros(count))
    if TIME_CONSTANT_NAME not in names:
        columns["delay"] = columns["delay"] + lag
    rows = np.column_stack([columns.get(name, np.zeros(count)) for name in names])
    mixed = np.concatenate([rows, posterior.draws[count:]])
    return replace(posterior, draws=np.random.default_rng(count).permutation(mixed))
