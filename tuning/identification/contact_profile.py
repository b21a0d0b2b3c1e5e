"""The force delay and the plane on a grid, all else of a contact by linear least squares.

The delay is not differentiated: while damped contact lasts, first-order information on it is the damping's,
and what remains is at the onset, where the likelihood has kinks. So the grid carries the posterior itself
(flat prior on delay and plane, no negative damping), and draws from it are what everything after reckons
with: means, standard deviations, intervals, correlations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special
from scipy.ndimage import uniform_filter1d

from tuning.identification import press
from tuning.identification.contact_problem import COARSE, LONGEST, Inner, Problem
from tuning.identification.normal_draws import factor

FINE = 2e-5  # s, between the next
SMOOTHED = 7  # of these delays, over which the plane is averaged
REGION = 30.0  # of twice the log posterior below its best: what the final grid covers
ROUGH_REGION = 400.0  # the same of the coarse grid, whose heights are full of rows on the wrong side
FEW_PLANES = 15  # of the grid that finds the region
ROUGHLY = 2.0  # times the plane's standard deviation that the first look tells
DELAYS, PLANES = 61, 13  # of the final grid
REACH = 0.003  # s, on each side of a delay that is known roughly
PLANE_REACH = 3.2  # standard deviations of the plane at a given delay, on each side
DRAWS = 4000


@dataclass(frozen=True)
class Posterior:
    """Draws of delay, plane and coefficients, and the profile they come from."""

    names: list[str]  # "delay", "plane", then the coefficients
    draws: np.ndarray  # (draws, names)
    delays: np.ndarray  # s, the final grid
    log_posterior: np.ndarray  # of the delay there, less its largest
    best: tuple[float, float, Inner]  # delay, plane and fit of greatest posterior density
    evidence: float = 0.0  # logarithm of the posterior's integral, up to a constant of the readings

    @property
    def mean(self) -> np.ndarray:
        return self.draws.mean(axis=0)

    @property
    def covariance(self) -> np.ndarray:
        return np.cov(self.draws.T)


def profile(
    problem: Problem,
    seed: int = 0,
    near: tuple[float, float] | None = None,
    size: tuple[int, int] = (DELAYS, PLANES),
) -> Posterior:
    """The posterior of the force delay, the plane and the coefficients.

    `near`: a delay [s] and the plane there [m] within some milliseconds of the best, where they are known;
    else, and where delays further away are as likely, all delays are looked at. `size`: of the final grid,
    delays and planes."""
    delays, start = np.arange(problem.shortest, LONGEST + COARSE / 2.0, COARSE), 0.0
    scanned = None
    if near is not None:
        close, start = near[0] + np.arange(-REACH, REACH + COARSE / 2.0, COARSE), near[1]
        close = np.unique(np.clip(close, problem.shortest, LONGEST))
        scanned = _scan(problem, close, start)
        likely = 2.0 * (scanned[2].max() - scanned[2][[0, -1]]) <= REGION
        inner = close[0] > problem.shortest, close[-1] < LONGEST
        if np.any(likely & inner):
            scanned = None
        else:
            delays = close
    elif problem.plane is None:
        start = first_plane(problem, LONGEST / 4.0)
    start = start if problem.plane is None else problem.plane
    planes, stds, heights = scanned or _scan(problem, delays, start)
    low, high = _region(problem, delays, heights, ROUGH_REGION)
    finer = np.linspace(low, high, int(np.clip((high - low) / FINE, 21, 151)))
    known = np.interp(finer, delays, planes), np.interp(finer, delays, stds)
    places, cells = _grid(problem, finer, (known[0], ROUGHLY * known[1]), FEW_PLANES)
    heights, planes, spreads = _by_delay(places, cells, len(finer))
    low, high = _region(problem, finer, heights, REGION)
    delays = np.linspace(low, high, size[0])
    # Where one cell has all the posterior of a delay, that of the next delay may be in another.
    planes = uniform_filter1d(planes, SMOOTHED, mode="nearest")
    known = np.interp(delays, finer, planes), np.interp(delays, finer, np.maximum(spreads, known[1]))
    places, cells = _grid(problem, delays, known, size[1])
    return _sample(problem, places, cells, delays, seed)


def first_plane(problem: Problem, delay: float) -> float:
    """Where the mechanism was when the force first rose above its noise, the median of the runs [m]."""
    position, _ = problem.motion.at(delay)
    readings = problem.readings
    if readings.bias is not None:
        found = press.first_plane(position, readings.force, readings.counts, readings.bias)
        if found is not None:
            return found
    level = np.median(readings.force[readings.counts])
    loud = readings.counts & (np.abs(readings.force - level) > 5.0 * readings.std + readings.threshold)
    sustained = loud & np.roll(loud, -1, axis=0) & np.roll(loud, -2, axis=0)
    found = [position[np.argmax(lane), i] for i, lane in enumerate(sustained.T) if lane.any()]
    return float(np.median(found)) if found else 0.0


def _scan(problem: Problem, delays: np.ndarray, start: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """At each delay the best plane, its standard deviation, and the log posterior with it integrated out."""
    planes, stds, heights = [], [], []
    for delay in delays:
        plane, inner, gain = problem.settled(delay, start)
        stds.append(1.0 if problem.plane is not None else 1.0 / np.sqrt(max(inner.curvature, 1e-300)))
        planes.append(plane)
        heights.append(inner.evidence + gain + np.log(stds[-1]))
    return np.array(planes), np.array(stds), np.array(heights)


def _region(problem: Problem, delays: np.ndarray, heights: np.ndarray, reach: float) -> tuple[float, float]:
    """The delays around the best whose posterior is worth a grid, one step wider on each side."""
    inside = np.flatnonzero(2.0 * (heights.max() - heights) <= reach)
    step = delays[1] - delays[0]
    return max(problem.shortest, delays[inside[0]] - step), min(LONGEST, delays[inside[-1]] + step)


def _grid(
    problem: Problem, delays: np.ndarray, known: tuple[np.ndarray, np.ndarray], across: int
) -> tuple[np.ndarray, list[Inner]]:
    """Fits at each delay and at planes across the plane's uncertainty there: `known`, its mean and standard
    deviation at each.

    Damped touches begin with a jump, and a row on its other side costs much: the likelihood is smooth but for
    the planes at which a row comes into contact, and those are cells' edges. Places are rows of (delay,
    plane, width in the plane)."""
    places, cells = [], []
    for delay, centre, std in zip(delays, *known, strict=True):
        if problem.plane is not None:
            cells.append(problem.at(delay, problem.plane))
            places.append((delay, problem.plane, 1.0))
            continue
        low, high = centre - PLANE_REACH * std, centre + PLANE_REACH * std
        edges = cut(low, high, problem.onsets_between(delay, low, high), across)
        planes = (edges[1:] + edges[:-1]) / 2.0
        cells += problem.across(delay, planes)
        places += [(delay, *one) for one in zip(planes, np.diff(edges), strict=True)]
    return np.array(places), cells


def cut(low: float, high: float, at: np.ndarray, number: int) -> np.ndarray:
    """The edges of so many cells from low to high, cut at these places first, then in the widest cells; of
    places too many, those go that leave the smallest cells."""
    edges = [low, *at, high]
    while len(edges) <= number:
        widest = int(np.argmax(np.diff(edges)))
        edges.insert(widest + 1, (edges[widest] + edges[widest + 1]) / 2.0)
    while len(edges) > number + 1:
        del edges[1 + int(np.argmin(np.array(edges[2:]) - edges[:-2]))]
    return np.array(edges)


def _by_delay(
    places: np.ndarray, cells: list[Inner], count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log posterior of each delay, all planes together; mean and standard deviation of the plane there."""
    heights, planes = _heights(places, cells).reshape(count, -1), places[:, 1].reshape(count, -1)
    total: Any = special.logsumexp(heights, axis=1)
    share = np.exp(heights - total[:, None])
    mean = np.sum(share * planes, axis=1)
    spread = np.sqrt(np.sum(share * (planes - mean[:, None]) ** 2, axis=1))
    # A grid so wide that one plane has it all says no more than the distance to the next.
    best = np.argmax(heights, axis=1)
    width = places[:, 2].reshape(count, -1)[np.arange(count), best]
    return total, mean, np.maximum(spread, width / 2.0)


def _heights(places: np.ndarray, cells: list[Inner]) -> np.ndarray:
    """Log posterior of each cell of a grid."""
    return np.array([cell.evidence for cell in cells]) + np.log(places[:, 2])


def _sample(
    problem: Problem, places: np.ndarray, cells: list[Inner], delays: np.ndarray, seed: int
) -> Posterior:
    """Draws from the grid: a cell by its weight, a place in it, coefficients by their normal distribution."""
    heights = _heights(places, cells)
    weights = np.exp(heights - heights.max())
    weights /= weights.sum()
    rng = np.random.default_rng(seed)
    # Spread evenly over the weights: less luck in the draws.
    picked = np.searchsorted(np.cumsum(weights), (np.arange(DRAWS) + rng.uniform(size=DRAWS)) / DRAWS)
    picked = np.minimum(picked, len(cells) - 1)
    step, rows = delays[1] - delays[0], []
    slopes = np.zeros((len(cells), len(cells[0].coefficients)))
    if problem.plane is not None:
        # Within a cell the coefficients go along with the delay, damping above all.
        slopes = np.gradient(np.array([cell.coefficients for cell in cells]), step, axis=0)
    for index in np.unique(picked):
        count = int(np.sum(picked == index))
        delay, plane, width = places[index]
        spread = rng.uniform(-0.5, 0.5, (count, 2)) * [step, width * (problem.plane is None)]
        values = _coefficients(cells[index], problem.rate_like, count, rng)
        moved = np.maximum(delay + spread[:, 0], problem.shortest)
        values = values + (moved - delay)[:, None] * slopes[index]
        values[:, problem.rate_like] = np.maximum(values[:, problem.rate_like], 0.0)
        rows.append(np.column_stack([moved, plane + spread[:, 1], values]))
    profile = _by_delay(places, cells, len(delays))[0]
    best = int(np.argmax(heights))
    return Posterior(
        ["delay", "plane", *problem.names],
        rng.permutation(np.concatenate(rows)),
        delays,
        profile - profile.max(),
        (float(places[best, 0]), float(places[best, 1]), cells[best]),
        float(heights.max() + np.log(np.sum(np.exp(heights - heights.max())) * step)),
    )


def _coefficients(cell: Inner, positive: list[int], count: int, rng) -> np.ndarray:
    """Normal draws; those with a negative damping are drawn again."""
    root = factor(cell.covariance)
    draws = cell.coefficients + rng.standard_normal((count, len(root))) @ root.T
    for _ in range(50):
        bad = np.any(draws[:, positive] < 0.0, axis=1)
        if not bad.any():
            return draws
        draws[bad] = cell.coefficients + rng.standard_normal((int(bad.sum()), len(root))) @ root.T
    draws[:, positive] = np.maximum(draws[:, positive], 0.0)
    return draws
