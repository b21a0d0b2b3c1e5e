"""How much a contact's numbers change with the contacts they are found from: fits to contacts drawn anew.

The likelihood knows the noise of every reading alone. Where contacts differ by more, its intervals are too
narrow; fits to as many contacts, drawn with replacement, scatter by all of it (Efron 1979). Contacts of one
entry of the lists are drawn for one another.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tuning.identification.contact import ROUGH, ContactFit
from tuning.identification.contact_problem import Problem
from tuning.identification.contact_profile import profile

FEWEST = 6  # contacts
WIDER = 1.5  # times the standard deviation stated, from which more than noise makes contacts differ


def bootstrap(fit: ContactFit, repeats: int, seed: int = 0) -> ContactFit:
    """The fit with draws that scatter as fits to other contacts do, if those scatter more than stated; what
    was found is in its `resampled`."""
    posterior, readings = fit.posterior, fit.readings
    lanes = readings.force.shape[1]
    if lanes < FEWEST or fit.problem.time_constant:
        why = "the sensor's lag" if fit.problem.time_constant else f"{lanes} contacts, {FEWEST} are needed"
        return replace(fit, resampled=f"no bootstrap: {why}")
    found = fits(fit, repeats, seed)
    groups = len({*_entries(fit)})
    spread = np.cov(found.T) * lanes / max(lanes - groups, 1)
    stated = posterior.covariance
    moving = np.flatnonzero(np.diag(stated) > 0.0)
    std = np.sqrt(np.diag(stated)[moving])
    ratio = np.sqrt(np.diag(spread)[moving]) / std
    worst = int(np.argmax(ratio))
    said = f"bootstrap over {lanes} contacts, {repeats} times: standard deviations {ratio.min():.2g} to "
    said += f"{ratio[worst]:.2g} times those of noise ({posterior.names[moving[worst]]})"
    if ratio[worst] <= WIDER:
        return replace(fit, resampled=f"{said}: intervals are those of noise")
    place = np.ix_(moving, moving)
    had, wanted = (
        np.linalg.cholesky(one[place] / np.outer(std, std) + 1e-9 * np.eye(len(moving)))
        for one in (stated, spread)
    )
    draws, mean = posterior.draws.copy(), posterior.mean[moving]
    draws[:, moving] = mean + ((draws[:, moving] - mean) / std) @ np.linalg.solve(had.T, wanted.T) * std
    positive = [2 + i for i in fit.problem.rate_like]
    draws[:, positive] = np.maximum(draws[:, positive], 0.0)
    widened = replace(posterior, draws=draws)
    return replace(fit, posterior=widened, resampled=f"{said}: intervals are the bootstrap's")


def fits(fit: ContactFit, repeats: int, seed: int) -> np.ndarray:
    """The numbers of the posterior, each time from other contacts, (repeats, names)."""
    problem, rng, entries = fit.problem, np.random.default_rng([seed, 3]), _entries(fit)
    members = [np.flatnonzero(entries == entry) for entry in np.unique(entries)]
    found = []
    for _ in range(repeats):
        lanes = np.concatenate([rng.choice(one, len(one)) for one in members])
        again = Problem(problem.motion.of(lanes), fit.readings.of_lanes(lanes), fit.law, problem.plane)
        found.append(profile(again, seed, fit.posterior.best[:2], ROUGH).mean)
    return np.array(found)


def _entries(fit: ContactFit) -> np.ndarray:
    """Entry of the lists that each contact meets."""
    return np.max(fit.readings.entry, axis=0)
