"""Bootstrap over contacts: fits to contacts that are drawn again with replacement.

The likelihood knows only the noise of the readings. If contacts differ by more than noise, its intervals are
too narrow; the scatter of the bootstrap fits includes all differences (Efron 1979). Contacts are drawn only
among those of the same entry of the contact lists. The fits are independent, so a cluster's workers can
compute them, and finished chunks are checkpointed.
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

MIN_CONTACTS_FOR_BOOTSTRAP = 6  # contacts that a bootstrap needs
FITS_PER_CHUNK = 5  # fits in a chunk, which one worker computes and which is checkpointed
MIN_STD_RATIO = (
    1.5  # ratio to the stated standard deviation, above which the bootstrap replaces the intervals
)


def bootstrap(
    fit: ContactFit,
    repeats: int,
    seed: int = 0,
    scheduler: str | None = None,
    kept: Checkpoints = NO_CHECKPOINTS,
    say: Callable[[str], None] = lambda text: None,
) -> ContactFit:
    """Return the fit with wider draws if fits to resampled contacts scatter more than stated.

    The field `resampled` of the result summarizes the outcome.

    Args:
        fit: Fit to all contacts.
        repeats: Number of bootstrap fits.
        seed: Seed of the random numbers.
        scheduler: Address of a cluster's scheduler whose workers compute the fits, or None.
        kept: Checkpoints of finished chunks.
        say: Function that receives a progress message after every chunk but the last.
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
    estimates = fit_bootstrap_samples(fit, repeats, seed, scheduler, kept, say)
    groups = len({*_find_contact_entries(fit)})
    spread = np.cov(estimates.T) * lanes / max(lanes - groups, 1)
    stated = posterior.covariance
    moving = np.flatnonzero(np.diag(stated) > 0.0)
    std = np.sqrt(np.diag(stated)[moving])
    ratio = np.sqrt(np.diag(spread)[moving]) / std
    worst = int(np.argmax(ratio))
    summary = f"bootstrap over {lanes} contacts, {repeats} times: standard deviations {ratio.min():.2g} to "
    summary += f"{ratio[worst]:.2g} times those of noise ({posterior.names[moving[worst]]})"
    if ratio[worst] <= MIN_STD_RATIO:
        return replace(fit, resampled=f"{summary}: intervals are those of noise")
    block = np.ix_(moving, moving)
    old, new = (_factorise_regularised(cov[block] / np.outer(std, std)) for cov in (stated, spread))
    draws, mean = posterior.draws.copy(), posterior.mean[moving]
    draws[:, moving] = mean + ((draws[:, moving] - mean) / std) @ np.linalg.solve(old.T, new.T) * std
    positive = [2 + i for i in fit.problem.damping_indices]
    draws[:, positive] = np.maximum(draws[:, positive], 0.0)
    widened = replace(posterior, draws=draws)
    return replace(fit, posterior=widened, resampled=f"{summary}: intervals are the bootstrap's")


def _factorise_regularised(covariance: np.ndarray) -> np.ndarray:
    """Return a Cholesky factor of a covariance that may be singular because there are few fits."""
    return np.linalg.cholesky(covariance + 1e-9 * np.max(np.diag(covariance)) * np.eye(len(covariance)))


def fit_bootstrap_samples(
    fit: ContactFit,
    repeats: int,
    seed: int,
    scheduler: str | None,
    kept: Checkpoints,
    say: Callable[[str], None],
) -> np.ndarray:
    """Return the posterior mean of every bootstrap fit, (repeats, names)."""
    rng, entries = np.random.default_rng([seed, 3]), _find_contact_entries(fit)
    members = [np.flatnonzero(entries == entry) for entry in np.unique(entries)]
    drawn = [np.concatenate([rng.choice(group, len(group)) for group in members]) for _ in range(repeats)]
    lanes = {begin: drawn[begin : begin + FITS_PER_CHUNK] for begin in range(0, repeats, FITS_PER_CHUNK)}
    shared = fit.problem, fit.readings, seed, fit.posterior.best[:2]
    same = compute_digest((_describe_problem(fit.problem), *shared[1:]))
    read = {begin: kept.read(f"fits {begin}", (same, chunk), np.ndarray) for begin, chunk in lanes.items()}
    results: dict[int, np.ndarray] = {begin: values for begin, values in read.items() if values is not None}
    pieces = [WorkUnit(begin, (chunk, *shared)) for begin, chunk in lanes.items() if begin not in results]
    if scheduler is None:
        computed = ((piece.name, fit_resampled_contacts(*piece.arguments)) for piece in pieces)
    else:
        task, alike = (
            f"bootstrap-{compute_digest((same, drawn))[:16]}",
            get_process_setting()._replace(xla_flags=None),
        )
        computed = run_on_workers(scheduler, fit_resampled_contacts, pieces, alike, task)
    for begin, values in computed:
        results[begin] = values
        kept.write(f"fits {begin}", (same, lanes[begin]), values)
        if len(results) < len(lanes):
            say(f"fits to contacts drawn again: {sum(map(len, results.values()))} of {repeats}")
    return np.concatenate([results[begin] for begin in lanes])


def fit_resampled_contacts(
    drawn: list[np.ndarray],
    problem: ContactProblem,
    readings: ForceReadings,
    seed: int,
    near: tuple[float, float],
) -> np.ndarray:
    """Return the posterior means of fits to each set of drawn lanes, (fits, names)."""
    again = [
        ContactProblem(problem.motion.of(lanes), readings.select_lanes(lanes), problem.law, problem.plane)
        for lanes in drawn
    ]
    return np.array(
        [compute_posterior(problem_again, seed, near, COARSE_GRID_SIZE).mean for problem_again in again]
    )


def _find_contact_entries(fit: ContactFit) -> np.ndarray:
    """Return the entry of the contact lists for each contact."""
    return np.max(fit.readings.entry, axis=0)


def _describe_problem(problem: ContactProblem) -> Any:
    """Return everything that defines the problem except its readings."""
    law = problem.law
    return law.name, law.names, law.pulls, law.shape, problem.plane, vars(problem.motion)
