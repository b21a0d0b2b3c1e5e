"""Posterior of force delay, surface position and coefficients of a contact law, computed on a grid.

At each delay and surface position of the grid, linear least squares determine the coefficients. The
likelihood is not approximated by its derivatives with respect to the delay: during contact, a change of the
delay acts like a change of the damping, and the likelihood has kinks where a row comes into contact. The
prior is flat in delay and surface position, and excludes negative damping. All results, such as means,
intervals and correlations, come from draws of the posterior.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import special
from scipy.ndimage import uniform_filter1d

from tuning.identification import press_bias
from tuning.identification.contact_problem import COARSE_DELAY_STEP, MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_regression import CoefficientFit
from tuning.identification.normal_draws import factorise_covariance
from tuning.identification.surface_search import find_best_surface, has_steps

FINE_DELAY_STEP = 2e-5  # step between the delays of the second grid [s]
SMOOTHING_DELAYS = 7  # number of adjacent delays of the second grid whose surface positions are averaged
FINAL_GRID_DROP = 30.0  # twice the maximum drop of the log posterior from its peak in the final grid
# Twice the maximum drop in the second grid; larger, because the coarse grid's log posterior is inaccurate.
COARSE_GRID_DROP = 400.0
# A search from delay to delay ends after several successive delays with a larger drop (twice that of the log
# posterior).
SEARCH_DROP, MAX_IMPROBABLE_DELAYS = 100.0, 3
SECOND_GRID_SURFACES = 15  # number of surface positions at each delay of the second grid
MAX_CELL_WIDTH_RATIO = 3.0  # maximum width of a cell, divided by the mean width
MAX_CELL_EDGES = 1000  # maximum number of cell edges; an uncertain surface position would need more
COARSE_STD_FACTOR = 2.0  # the coarse grid's standard deviation of the surface is multiplied by this factor
FINAL_GRID_DELAYS, FINAL_GRID_SURFACES = 61, 13  # numbers of delays and surface positions of the final grid
MAX_SURFACE_STD = 0.01  # upper limit of the surface position's standard deviation [m]
DELAY_SEARCH_HALF_WIDTH = 0.003  # half width of the search around an approximate delay [s]
SURFACE_HALF_WIDTH_SIGMAS = 3.2  # half width of the grid of surface positions [standard deviations]
POSTERIOR_DRAWS = 4000  # number of posterior draws


@dataclass(frozen=True)
class Posterior:
    """Posterior draws of the contact parameters, and the marginal posterior of the force delay."""

    names: list[str]  # "delay", "plane", then the coefficients
    draws: np.ndarray  # (draws, names)
    delays: np.ndarray  # force delays of the final grid [s]
    log_posterior: np.ndarray  # log posterior at each of `delays`, minus its maximum
    best: tuple[float, float, CoefficientFit]  # delay, plane and fit with the greatest posterior density
    evidence: float = 0.0  # log evidence, up to a constant that is the same for all models of these readings

    @property
    def mean(self) -> np.ndarray:
        return self.draws.mean(axis=0)

    @property
    def covariance(self) -> np.ndarray:
        return np.cov(self.draws.T)


class _Profile(NamedTuple):
    """Best or mean surface position at each force delay, with the log posterior."""

    delays: np.ndarray  # s, in ascending order
    planes: np.ndarray  # surface position [m]
    stds: np.ndarray  # standard deviation of the surface position [m]; 1 if the position is specified
    heights: np.ndarray  # log posterior, up to a constant

    @property
    def best_delay(self) -> float:
        return float(self.delays[np.argmax(self.heights)])


def compute_posterior(
    problem: ContactProblem,
    seed: int = 0,
    near: tuple[float, float] | None = None,
    size: tuple[int, int] = (FINAL_GRID_DELAYS, FINAL_GRID_SURFACES),
) -> Posterior:
    """Compute the posterior of the force delay, the surface position and the coefficients.

    Args:
        problem: Readings, motion and contact law.
        seed: Seed of the random numbers.
        near: Approximate delay [s] and surface position [m]. All delays are searched if `near` is None, or if
            the best delay may be far from the approximate one.
        size: Numbers of delays and surface positions of the final grid.
    """
    profile = _refine(problem, _scan_coarsely(problem, near))
    low, high = _find_likely_delays(problem, profile.delays, profile.heights, FINAL_GRID_DROP)
    delays = np.linspace(low, high, size[0])
    planes, stds = (np.interp(delays, profile.delays, values) for values in (profile.planes, profile.stds))
    if has_steps(problem):
        planes, _ = _follow_surface(problem, delays, planes, profile.best_delay)
    places, cells = _fit_grid(problem, delays, (planes, stds), size[1])
    return _draw_from_grid(problem, places, cells, delays, seed)


def _scan_coarsely(problem: ContactProblem, near: tuple[float, float] | None) -> _Profile:
    """Scan the delays in coarse steps: those near an approximate one or, if the best may be far, all."""
    start = problem.plane
    if start is None:
        start = estimate_surface_from_onset(problem, MAX_FORCE_DELAY / 4.0) if near is None else near[1]
    if near is not None:
        reach = DELAY_SEARCH_HALF_WIDTH
        delays = near[0] + np.arange(-reach, reach + COARSE_DELAY_STEP / 2.0, COARSE_DELAY_STEP)
        delays = np.unique(np.clip(delays, problem.min_delay, MAX_FORCE_DELAY))
        profile = _scan_delays(problem, delays, start)
        heights = profile.heights
        is_likely = 2.0 * (heights.max() - heights[[0, -1]]) <= FINAL_GRID_DROP
        if not np.any(is_likely & (delays[0] > problem.min_delay, delays[-1] < MAX_FORCE_DELAY)):
            return profile
    delays = np.arange(problem.min_delay, MAX_FORCE_DELAY + COARSE_DELAY_STEP / 2.0, COARSE_DELAY_STEP)
    return _scan_delays(problem, delays, start)


def _refine(problem: ContactProblem, coarse: _Profile) -> _Profile:
    """Return the profile at finer steps, where it is likely, from a grid of surface positions."""
    low, high = _find_likely_delays(problem, coarse.delays, coarse.heights, COARSE_GRID_DROP)
    delays = np.linspace(low, high, int(np.clip((high - low) / FINE_DELAY_STEP, 21, 151)))
    planes = np.interp(delays, coarse.delays, coarse.planes)
    if has_steps(problem):
        planes, heights = _follow_surface(problem, delays, planes, coarse.best_delay)
        low, high = _find_likely_delays(problem, delays, heights, FINAL_GRID_DROP)
        in_range = (delays >= low) & (delays <= high)
        delays, planes = delays[in_range], planes[in_range]
    stds = np.interp(delays, coarse.delays, coarse.stds)
    places, cells = _fit_grid(problem, delays, (planes, COARSE_STD_FACTOR * stds), SECOND_GRID_SURFACES)
    heights, planes, spreads = _marginalise_over_surface(places, cells, len(delays))
    if not has_steps(problem):
        # If one cell contains the whole posterior at a delay, the estimated surface position jumps from delay
        # to delay: smooth it.
        planes = uniform_filter1d(planes, SMOOTHING_DELAYS, mode="nearest")
    return _Profile(delays, planes, np.maximum(spreads, stds), heights)


def estimate_surface_from_onset(problem: ContactProblem, delay: float) -> float:
    """Return the position [m] at which the force first exceeds its noise, as the median of all runs.

    If a prior of the sensor's bias is known, the result is the position at which a line fitted to the forces
    reaches the bias (module `press_bias`).
    """
    position, _ = problem.motion.at(delay)
    readings = problem.readings
    if readings.bias is not None:
        crossing = press_bias.find_surface_of_press(position, readings.force, readings.counts, readings.bias)
        if crossing is not None:
            return crossing
    level = np.median(readings.force[readings.counts])
    loud = readings.counts & (np.abs(readings.force - level) > 5.0 * readings.std + readings.threshold)
    sustained = loud & np.roll(loud, -1, axis=0) & np.roll(loud, -2, axis=0)
    crossings = [position[np.argmax(lane), i] for i, lane in enumerate(sustained.T) if lane.any()]
    return float(np.median(crossings)) if crossings else 0.0


def _scan_delays(problem: ContactProblem, delays: np.ndarray, start: float) -> _Profile:
    """Find the best surface position at each delay, from `start` [m]."""
    optima = [find_best_surface(problem, delay, start, -np.inf) for delay in delays]
    misfits = [inner.misfit - 2.0 * gain for _, inner, gain in optima]
    # Scan the steps of the misfit only where it may come close to the best, from the best delay on.
    best = min(misfits)
    for i in np.argsort(misfits) if has_steps(problem) else ():
        optima[i] = find_best_surface(problem, float(delays[i]), optima[i][0], best + COARSE_GRID_DROP)
        best = min(best, optima[i][1].misfit - 2.0 * optima[i][2])
    planes, curvatures, heights = np.array(
        [(plane, inner.curvature, inner.evidence + gain) for plane, inner, gain in optima]
    ).T
    stds = np.ones(len(delays))
    if problem.plane is None:
        # Where rounding makes the curvature negative, its value at the neighbouring delays is used.
        valid = curvatures > 0.0
        filled = np.interp(delays, delays[valid], curvatures[valid]) if valid.any() else 0.0 * curvatures
        stds = 1.0 / np.sqrt(np.maximum(filled, MAX_SURFACE_STD**-2))
    return _Profile(delays, planes, stds, heights + np.log(stds))


def _follow_surface(
    problem: ContactProblem, delays: np.ndarray, planes: np.ndarray, first: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best surface position and the log posterior at each delay, from neighbour to neighbour.

    Between delays, the best position does not change linearly, because the misfit is a staircase. Delays far
    from the most probable one are omitted: their log posterior is minus infinity.

    Args:
        problem: Readings, motion and contact law.
        delays: Delays [s], in ascending order.
        planes: Approximate surface positions [m], one per delay; that at `first` starts the search, and those
            at omitted delays remain.
        first: Delay [s] at which the search begins; it proceeds to both sides.
    """
    planes, begin = planes.copy(), int(np.argmin(np.abs(delays - first)))
    least, heights = np.inf, np.full(len(delays), -np.inf)
    for order in (range(begin, len(delays)), range(begin - 1, -1, -1)):
        plane, improbable = planes[begin], 0
        for i in order:
            plane, inner, gain = find_best_surface(
                problem, float(delays[i]), float(plane), least + FINAL_GRID_DROP
            )
            least = min(least, inner.misfit - 2.0 * gain)
            planes[i], heights[i] = plane, inner.evidence + gain
            improbable = improbable + 1 if 2.0 * (heights.max() - heights[i]) > SEARCH_DROP else 0
            if improbable == MAX_IMPROBABLE_DELAYS:
                break
    return planes, heights


def _find_likely_delays(
    problem: ContactProblem, delays: np.ndarray, heights: np.ndarray, reach: float
) -> tuple[float, float]:
    """Return the range of delays [s] in which the log posterior `heights` is close to its maximum.

    Twice the drop from the maximum is at most `reach` there. One step is added on each side; the first and
    the last step of a clipped grid may be shorter than the others.
    """
    inside = np.flatnonzero(2.0 * (heights.max() - heights) <= reach)
    ends = 2.0 * delays[0] - delays[1], 2.0 * delays[-1] - delays[-2]
    wider = np.concatenate([ends[:1], delays, ends[1:]])
    low, high = float(wider[inside[0]]), float(wider[inside[-1] + 2])
    return max(problem.min_delay, low), min(MAX_FORCE_DELAY, high)


def _fit_grid(
    problem: ContactProblem, delays: np.ndarray, surface: tuple[np.ndarray, np.ndarray], across: int
) -> tuple[np.ndarray, list[CoefficientFit]]:
    """Fit the coefficients on a grid of force delays with plausible surface positions at each delay.

    The force of damped contact jumps at the onset. The likelihood therefore jumps at surface positions where
    one more row comes into contact. The edges of the grid cells lie at such positions where possible.

    Args:
        problem: Readings, motion and contact law.
        delays: Delays [s].
        surface: Means and standard deviations of the surface position [m], one per delay.
        across: Number of surface positions (cells) at each delay.

    Returns:
        Delay [s], centre [m] and width [m] of each cell; and the fit at the centre of each cell.
    """
    places, cells = [], []
    for delay, centre, std in zip(delays, *surface, strict=True):
        if problem.plane is not None:
            cells.append(problem.at(delay, problem.plane))
            places.append((delay, problem.plane, 1.0))
            continue
        low, high = centre - SURFACE_HALF_WIDTH_SIGMAS * std, centre + SURFACE_HALF_WIDTH_SIGMAS * std
        edges = divide_into_cells(low, high, problem.onsets_between(delay, low, high), across)
        planes = (edges[1:] + edges[:-1]) / 2.0
        cells += problem.fit_surfaces(delay, planes)
        places += [(delay, *cell) for cell in zip(planes, np.diff(edges), strict=True)]
    return np.array(places), cells


def divide_into_cells(low: float, high: float, at: np.ndarray, number: int) -> np.ndarray:
    """Divide the interval from `low` to `high` into `number` cells with edges at the positions `at`.

    If there are too few positions, wide cells are halved. If there are too many, small cells are merged.
    """
    if len(at) > MAX_CELL_EDGES:
        at = at[np.linspace(0, len(at) - 1, MAX_CELL_EDGES).astype(int)]
    edges = [low, *at, high]
    # Where a dead zone hides the onsets, no position divides the interval.
    while len(edges) <= number or np.max(np.diff(edges)) > MAX_CELL_WIDTH_RATIO * (high - low) / number:
        widest = int(np.argmax(np.diff(edges)))
        edges.insert(widest + 1, (edges[widest] + edges[widest + 1]) / 2.0)
    while len(edges) > number + 1:
        del edges[1 + int(np.argmin(np.array(edges[2:]) - edges[:-2]))]
    return np.array(edges)


def _marginalise_over_surface(
    places: np.ndarray, cells: list[CoefficientFit], count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for each delay, the log posterior, and the surface position's mean and standard deviation."""
    heights, planes = (
        _compute_cell_posteriors(places, cells).reshape(count, -1),
        places[:, 1].reshape(count, -1),
    )
    total: Any = special.logsumexp(heights, axis=1)
    share = np.exp(heights - total[:, None])
    mean = np.sum(share * planes, axis=1)
    spread = np.sqrt(np.sum(share * (planes - mean[:, None]) ** 2, axis=1))
    # If one cell contains the whole posterior, its width is the only bound on the standard deviation.
    best = np.argmax(heights, axis=1)
    width = places[:, 2].reshape(count, -1)[np.arange(count), best]
    return total, mean, np.maximum(spread, width / 2.0)


def _compute_cell_posteriors(places: np.ndarray, cells: list[CoefficientFit]) -> np.ndarray:
    return np.array([cell.evidence for cell in cells]) + np.log(places[:, 2])


def _draw_from_grid(
    problem: ContactProblem, places: np.ndarray, cells: list[CoefficientFit], delays: np.ndarray, seed: int
) -> Posterior:
    """Draw from the posterior: choose a cell by its probability, a point in it, and normal coefficients."""
    heights = _compute_cell_posteriors(places, cells)
    weights = np.exp(heights - heights.max())
    weights /= weights.sum()
    rng = np.random.default_rng(seed)
    # Systematic resampling reduces the variance of the draws.
    picked = np.searchsorted(
        np.cumsum(weights), (np.arange(POSTERIOR_DRAWS) + rng.uniform(size=POSTERIOR_DRAWS)) / POSTERIOR_DRAWS
    )
    picked = np.minimum(picked, len(cells) - 1)
    step, rows = delays[1] - delays[0], []
    slopes = np.zeros((len(cells), len(cells[0].coefficients)))
    if problem.plane is not None:
        # The coefficients, especially the damping, change with the delay within a cell.
        slopes = np.gradient(np.array([cell.coefficients for cell in cells]), step, axis=0)
    for index in np.unique(picked):
        count = int(np.sum(picked == index))
        delay, plane, width = places[index]
        spread = rng.uniform(-0.5, 0.5, (count, 2)) * [step, width * (problem.plane is None)]
        values = _draw_coefficients(cells[index], problem.damping_indices, count, rng)
        moved = np.maximum(delay + spread[:, 0], problem.min_delay)
        values = values + (moved - delay)[:, None] * slopes[index]
        values[:, problem.damping_indices] = np.maximum(values[:, problem.damping_indices], 0.0)
        rows.append(np.column_stack([moved, plane + spread[:, 1], values]))
    profile = _marginalise_over_surface(places, cells, len(delays))[0]
    best = int(np.argmax(heights))
    return Posterior(
        ["delay", "plane", *problem.names],
        rng.permutation(np.concatenate(rows)),
        delays,
        profile - profile.max(),
        (float(places[best, 0]), float(places[best, 1]), cells[best]),
        float(heights.max() + np.log(np.sum(np.exp(heights - heights.max())) * step)),
    )


def _draw_coefficients(cell: CoefficientFit, positive: list[int], count: int, rng) -> np.ndarray:
    """Draw normally distributed coefficients; repeat draws in which a damping (`positive`) is negative."""
    root = factorise_covariance(cell.covariance)
    draws = cell.coefficients + rng.standard_normal((count, len(root))) @ root.T
    for _ in range(50):
        bad = np.any(draws[:, positive] < 0.0, axis=1)
        if not bad.any():
            return draws
        draws[bad] = cell.coefficients + rng.standard_normal((int(bad.sum()), len(root))) @ root.T
    draws[:, positive] = np.maximum(draws[:, positive], 0.0)
    return draws
