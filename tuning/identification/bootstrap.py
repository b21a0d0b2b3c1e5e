"""How much a contact's numbers change with the contacts they are found from: fits to contacts drawn anew.

The likelihood knows the noise of every reading alone. Where contacts differ by more, its intervals are too
narrow; fits to as many contacts, drawn with replacement, scatter by all of it (Efron 1979). Contacts of one
entry of the lists are drawn for one another. No fit needs another: the workers of a cluster can do them, and
those that are done are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from tuning.caches.cluster import Piece, on_workers
from tuning.caches.pieces import NOTHING_KEPT, Pieces, digest_of
from tuning.caches.worker import setting
from tuning.identification.contact import ROUGH, ContactFit
from tuning.identification.contact_problem import Problem, Readings
from tuning.identification.contact_profile import profile

FEWEST = 6  # contacts
FITS = 5  # of a piece, that is kept, or for a worker
WIDER = 1.5  # times the standard deviation stated, from which more than noise makes contacts differ


def bootstrap(
    fit: ContactFit,
    repeats: int,
    seed: int = 0,
    scheduler: str | None = None,
    kept: Pieces = NOTHING_KEPT,
    say: Callable[[str], None] = lambda text: None,
) -> ContactFit:
    """The fit with draws that scatter as fits to other contacts do, if those scatter more than stated; what
    was found is in its `resampled`. With a `scheduler` the workers of a cluster fit. `say` is called with how
    many fits are done, after every piece of them but the last."""
    posterior, readings = fit.posterior, fit.readings
    lanes = readings.force.shape[1]
    if lanes < FEWEST or fit.problem.time_constant:
        why = "the sensor's lag" if fit.problem.time_constant else f"{lanes} contacts, {FEWEST} are needed"
        return replace(fit, resampled=f"no bootstrap: {why}")
    found = fits(fit, repeats, seed, scheduler, kept, say)
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
    had, wanted = (_root(one[place] / np.outer(std, std)) for one in (stated, spread))
    draws, mean = posterior.draws.copy(), posterior.mean[moving]
    draws[:, moving] = mean + ((draws[:, moving] - mean) / std) @ np.linalg.solve(had.T, wanted.T) * std
    positive = [2 + i for i in fit.problem.rate_like]
    draws[:, positive] = np.maximum(draws[:, positive], 0.0)
    widened = replace(posterior, draws=draws)
    return replace(fit, posterior=widened, resampled=f"{said}: intervals are the bootstrap's")


def _root(covariance: np.ndarray) -> np.ndarray:
    """Of a covariance that may be singular: of fewer fits than there are numbers."""
    return np.linalg.cholesky(covariance + 1e-9 * np.max(np.diag(covariance)) * np.eye(len(covariance)))


def fits(
    fit: ContactFit, repeats: int, seed: int, scheduler: str | None, kept: Pieces, say: Callable[[str], None]
) -> np.ndarray:
    """The numbers of the posterior, each time from other contacts, (repeats, names)."""
    rng, entries = np.random.default_rng([seed, 3]), _entries(fit)
    members = [np.flatnonzero(entries == entry) for entry in np.unique(entries)]
    drawn = [np.concatenate([rng.choice(one, len(one)) for one in members]) for _ in range(repeats)]
    lanes = {begin: drawn[begin : begin + FITS] for begin in range(0, repeats, FITS)}
    known = fit.problem, fit.readings, seed, fit.posterior.best[:2]
    same = digest_of((_told(fit.problem), *known[1:]))
    read = {begin: kept.read(f"fits {begin}", (same, some), np.ndarray) for begin, some in lanes.items()}
    found: dict[int, np.ndarray] = {begin: values for begin, values in read.items() if values is not None}
    pieces = [Piece(begin, (some, *known)) for begin, some in lanes.items() if begin not in found]
    if scheduler is None:
        computed = ((piece.name, means(*piece.arguments)) for piece in pieces)
    else:
        what, alike = f"bootstrap-{digest_of((same, drawn))[:16]}", setting()._replace(xla_flags=None)
        computed = on_workers(scheduler, means, pieces, alike, what)
    for begin, values in computed:
        found[begin] = values
        kept.write(f"fits {begin}", (same, lanes[begin]), values)
        if len(found) < len(lanes):
            say(f"fits to contacts drawn again: {sum(map(len, found.values()))} of {repeats}")
    return np.concatenate([found[begin] for begin in lanes])


def means(
    drawn: list[np.ndarray], problem: Problem, readings: Readings, seed: int, near: tuple[float, float]
) -> np.ndarray:
    """Posterior means of fits to the `drawn` lanes of each, (fits, names)."""
    again = [
        Problem(problem.motion.of(lanes), readings.of_lanes(lanes), problem.law, problem.plane)
        for lanes in drawn
    ]
    return np.array([profile(one, seed, near, ROUGH).mean for one in again])


def _entries(fit: ContactFit) -> np.ndarray:
    """Entry of the lists that each contact meets."""
    return np.max(fit.readings.entry, axis=0)


def _told(problem: Problem) -> Any:
    """All that makes the problem but its readings."""
    law = problem.law
    return law.name, law.names, law.pulls, law.shape, problem.plane, vars(problem.motion)
