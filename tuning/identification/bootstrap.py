"""Bootstrap over contacts: repeated fits of the contact law to contacts drawn with replacement (Efron 1979).

The likelihood of a single fit accounts only for the noise of the readings. If the contacts differ by more
than this noise, the intervals of such a fit are too narrow. The scatter of the bootstrap fits includes all
differences between contacts. Contacts are drawn separately for each entry of the lists in `[contact]`.
The fits are independent, so that the workers of a cluster can compute them. Finished chunks are checkpointed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from tuning.caches.checkpoints import NO_CHECKPOINTS, Checkpoints, compute_digest
from tuning.caches.cluster import WorkUnit, run_on_workers
from tuning.caches.worker import get_process_setting
from tuning.identification.contact_fit import COARSE_GRID_SIZE, ContactFit
from tuning.identification.contact_problem import ContactProblem
from tuning.identification.contact_profile import compute_posterior
from tuning.identification.force_readings import ForceReadings

MIN_CONTACTS_FOR_BOOTSTRAP = 6  # minimum number of contacts for a bootstrap
FITS_PER_CHUNK = 5  # number of fits that one worker computes and saves as one checkpoint
# The bootstrap's intervals are used if its standard deviation divided by the posterior's exceeds this value.
MIN_STD_RATIO = 1.5


def bootstrap(
    fit: ContactFit,
    repeats: int,
    seed: int = 0,
    scheduler: str | None = None,
    checkpoints: Checkpoints = NO_CHECKPOINTS,
    say: Callable[[str], None] = lambda text: None,
) -> ContactFit:
    """Widen the posterior draws of a fit if the bootstrap fits scatter much more than these draws.

    Args:
        fit: Fit to all contacts.
        repeats: Number of bootstrap fits.
        seed: Seed of the random numbers.
        scheduler: Address of a cluster's scheduler whose workers compute the fits, or None.
        checkpoints: Checkpoints of finished chunks.
        say: Function that receives a progress message after every chunk except the last one.

    Returns:
        The fit, with wider draws if necessary; its field `resampled` describes the bootstrap in words.
    """
    posterior, readings = fit.posterior, fit.readings
    lanes = readings.force.shape[1]
    if lanes < MIN_CONTACTS_FOR_BOOTSTRAP or fit.problem.time_constant:
        why = (
            "the sensor's lag"
            if fit.problem.time_constant
            else f"{lanes} contacts, {MIN_CONTACTS_FOR_BOOTSTRAP} are needed"
        )
        return replace(fit, resampled=f"no bootstrap: {why}")
    estimates = fit_bootstrap_samples(fit, repeats, seed, scheduler, checkpoints, say)
    groups = len({*_find_contact_entries(fit)})
    spread = np.cov(estimates.T) * lanes / max(lanes - groups, 1)
    stated = posterior.covariance
    varying = np.flatnonzero(np.diag(stated) > 0.0)
    std = np.sqrt(np.diag(stated)[varying])
    ratio = np.sqrt(np.diag(spread)[varying]) / std
    worst = int(np.argmax(ratio))
    summary = f"bootstrap over {lanes} contacts, {repeats} times: standard deviations {ratio.min():.2g} to "
    summary += f"{ratio[worst]:.2g} times those of noise ({posterior.names[varying[worst]]})"
    if ratio[worst] <= MIN_STD_RATIO:
        return replace(fit, resampled=f"{summary}: intervals are those of noise")
    block = np.ix_(varying, varying)
    old, new = (_factorise_regularised(cov[block] / np.outer(std, std)) for cov in (stated, spread))
    draws, mean = posterior.draws.copy(), posterior.mean[varying]
    draws[:, varying] = mean + ((draws[:, varying] - mean) / std) @ np.linalg.solve(old.T, new.T) * std
    positive = [2 + i for i in fit.problem.damping_indices]
    draws[:, positive] = np.maximum(draws[:, positive], 0.0)
    widened = replace(posterior, draws=draws)
    return replace(fit, posterior=widened, resampled=f"{summary}: intervals are the bootstrap's")


def _factorise_regularised(covariance: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor of a covariance matrix after a small increase of its diagonal.

    The increase is needed if the matrix is singular: if there are fewer bootstrap fits than parameters.
    """
    return np.linalg.cholesky(covariance + 1e-9 * np.max(np.diag(covariance)) * np.eye(len(covariance)))


def fit_bootstrap_samples(
    fit: ContactFit,
    repeats: int,
    seed: int,
    scheduler: str | None,
    checkpoints: Checkpoints,
    say: Callable[[str], None],
) -> np.ndarray:
    """Fit the law to bootstrap samples and return the posterior means, shape (repeats, parameters)."""
    rng, entries = np.random.default_rng([seed, 3]), _find_contact_entries(fit)
    members = [np.flatnonzero(entries == entry) for entry in np.unique(entries)]
    drawn = [np.concatenate([rng.choice(group, len(group)) for group in members]) for _ in range(repeats)]
    chunks = {begin: drawn[begin : begin + FITS_PER_CHUNK] for begin in range(0, repeats, FITS_PER_CHUNK)}
    shared = fit.problem, fit.readings, seed, fit.posterior.best[:2]
    digest = compute_digest((_describe_problem(fit.problem), *shared[1:]))
    saved = {
        begin: checkpoints.read(f"fits {begin}", (digest, chunk), np.ndarray)
        for begin, chunk in chunks.items()
    }
    results: dict[int, np.ndarray] = {begin: values for begin, values in saved.items() if values is not None}
    units = [WorkUnit(begin, (chunk, *shared)) for begin, chunk in chunks.items() if begin not in results]
    if scheduler is None:
        computed = ((unit.name, fit_resampled_contacts(*unit.arguments)) for unit in units)
    else:
        task = f"bootstrap-{compute_digest((digest, drawn))[:16]}"
        setting = get_process_setting()._replace(xla_flags=None)
        computed = run_on_workers(scheduler, fit_resampled_contacts, units, setting, task)
    for begin, values in computed:
        results[begin] = values
        checkpoints.write(f"fits {begin}", (digest, chunks[begin]), values)
        if len(results) < len(chunks):
            say(f"bootstrap fits: {sum(map(len, results.values()))} of {repeats}")
    return np.concatenate([results[begin] for begin in chunks])


def fit_resampled_contacts(
    drawn: list[np.ndarray],
    problem: ContactProblem,
    readings: ForceReadings,
    seed: int,
    near: tuple[float, float],
) -> np.ndarray:
    """Fit the law to several sets of contacts and return the posterior means, shape (fits, parameters).

    Args:
        drawn: Indices of the contacts in each fit; an index may occur several times.
        problem: Problem with the motion and the law of all contacts.
        readings: Force readings of all contacts.
        seed: Seed of the random numbers.
        near: Delay [s] and surface position [m] of the fit to all contacts.
    """
    problems = [
        ContactProblem(problem.motion.of(lanes), readings.select_lanes(lanes), problem.law, problem.plane)
        for lanes in drawn
    ]
    return np.array(
        [compute_posterior(resampled, seed, near, COARSE_GRID_SIZE).mean for resampled in problems]
    )


def _find_contact_entries(fit: ContactFit) -> np.ndarray:
    """Return, for each contact, its index into the parameter lists of the mechanism file's `[contact]`."""
    return np.max(fit.readings.entry, axis=0)


def _describe_problem(problem: ContactProblem) -> Any:
    """Return the data that define a contact problem, without its readings, for a checkpoint's digest."""
    law = problem.law
    return law.name, law.names, law.pulls, law.shape, problem.plane, problem.motion.__getstate__()
