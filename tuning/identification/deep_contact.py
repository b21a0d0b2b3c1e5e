"""Replacement of the rows of long press runs by a few pseudo-rows, for faster fits of the same accuracy.

A slow press run has tens of thousands of readings, but its motion has few degrees of freedom. Arrays have one
lane (column) per run or segment of a run. A lane is deep if it always stays well below the surface. Its
predicted readings are then smooth functions of force delay and surface position. The regressors of the
contact law are therefore computed at a few delays and surface positions (Chebyshev nodes), and interpolated
by polynomials. A matrix factorisation of these regressors and of the readings gives pseudo-rows: a few rows
that lead to the same sum of squared residuals as all rows (Golub and Van Loan, "Matrix Computations", section
5.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import BarycentricInterpolator

from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import estimate_surface_from_onset
from tuning.identification.contact_regression import CoefficientFit, PseudoRows, compute_force
from tuning.identification.motion import MotionResponse
from tuning.identification.surface_search import find_best_surface

MIN_DEEP_LANES = 6  # minimum number of deep lanes for which pseudo-rows save time
LANES_FOR_LAW_CHOICE = 8  # number of deep lanes that suffice to fit the shape of a contact law
MIN_DEPTH_SHARE = 0.1  # minimum ratio of the smallest depth of a deep lane to its median depth
DELAY_RANGE = 0.002  # range of delays that one table covers, if the delay is not yet known well [s]
DELAY_TOLERANCE = 1e-9  # a table also covers delays that exceed its range by a rounding error [s]
DELAY_NODES = 8  # number of delays at which the interpolation is exact
SHORT_DELAY_RANGE, FEW_DELAY_NODES = 3e-4, 4  # the same for searches near a known delay
# numbers of surface positions at which the interpolation is exact: first for a linear force, then for others
SURFACE_NODES = 2, 4
# width of the range of surface positions that one table covers, divided by the smallest depth; the range of a
# linear force has no lower end
SURFACE_RANGE_SHARE = 0.1
# maximum norm of the interpolation errors of all readings, in standard deviations of the noise
MAX_INTERPOLATION_ERROR = 0.01
LANES_PER_BLOCK = 50  # maximum number of lanes that are computed together, to limit the memory
MAX_TABLES = 60  # maximum number of tables; a search that needs more is faster without tables
MIN_SINGULAR_VALUE = 1e-8  # minimum relative singular value of a pseudo-row; smaller ones are rounding errors


def find_deep_lanes(motion: MotionResponse, plane: float) -> np.ndarray:
    """Return flags of the lanes that stay well below the surface at `plane` [m] for every force delay."""
    depths = [motion.at(delay)[0] - plane for delay in (0.0, MAX_FORCE_DELAY / 2.0, MAX_FORCE_DELAY)]
    least = np.min([depth.min(axis=0) for depth in depths], axis=0)
    return least > MIN_DEPTH_SHARE * np.maximum(np.median(depths[1], axis=0), 0.0)


def summarise_deep_lanes(
    problem: ContactProblem, near: tuple[float, float] | None, has_known_delay: bool = False
) -> ContactProblem:
    """Replace the lanes well below the surface (deep lanes) by a few pseudo-rows, if there are enough.

    Args:
        problem: Problem with all rows.
        near: Approximate force delay [s] and surface position [m] of the later fits, or None if unknown.
        has_known_delay: Whether all later fits have delays near the one in `near`.
    """
    delay, plane = near or (MAX_FORCE_DELAY / 4.0, _approximate_surface(problem))
    deep = find_deep_lanes(problem.motion, plane) & problem.readings.counts.any(axis=0)
    # At least one lane must remain in the problem of the other lanes.
    deep[-1] = False
    if deep.sum() < MIN_DEEP_LANES:
        return problem
    nodes = (SHORT_DELAY_RANGE, FEW_DELAY_NODES) if has_known_delay else (DELAY_RANGE, DELAY_NODES)
    return SummarisedProblem(problem, deep, delay, nodes)


def select_representative_lanes(problem: ContactProblem) -> np.ndarray:
    """Return the indices of all lanes but most deep ones: at most `LANES_FOR_LAW_CHOICE` of these remain."""
    deep = np.flatnonzero(find_deep_lanes(problem.motion, _approximate_surface(problem)))
    dropped = np.delete(
        deep, np.linspace(0, len(deep) - 1, min(LANES_FOR_LAW_CHOICE, len(deep))).round().astype(int)
    )
    return np.delete(np.arange(problem.readings.force.shape[1]), dropped)


def _approximate_surface(problem: ContactProblem) -> float:
    """Return the surface position [m]: the specified one, or a fit for a typical force delay."""
    if problem.plane is not None:
        return problem.plane
    return find_best_surface(
        problem, MAX_FORCE_DELAY / 4.0, estimate_surface_from_onset(problem, MAX_FORCE_DELAY / 4.0)
    )[0]


class SummarisedProblem(ContactProblem):
    """Contact problem with few pseudo-rows in place of the runs well below the surface, where accurate."""

    def __init__(self, problem: ContactProblem, deep: np.ndarray, delay: float, nodes: tuple[float, int]):
        """Split the lanes of a problem: few pseudo-rows replace the deep lanes, others keep their rows.

        `deep` marks the lanes (one per run) that always stay well below the surface. `delay` [s] is the
        approximate force delay. `nodes` states range [s] and number of the delays of a table.
        """
        motion, readings, law = problem.motion, problem.readings, problem.law
        super().__init__(motion, readings, law, problem.plane, problem.time_constant)
        self.deep, self.delay, self.nodes = deep, delay, nodes
        lanes = np.flatnonzero(~deep)
        self.others = ContactProblem(
            motion.of(lanes, 0, 0.0), readings.select_lanes(lanes), law, problem.plane, problem.time_constant
        )
        self.blocks = _split_into_blocks(problem, np.flatnonzero(deep))
        self.tables: list[_DesignTable] = []
        self.planes = SURFACE_NODES

    def changed(self, law: Law, time_constant: float, delay: float | None = None) -> ContactProblem:
        """Return a copy of the problem with this contact law and this time constant of the sensor [s].

        The copy is fastest for fits with force delays near `delay` [s]. None keeps the present sum of force
        delay and filter delay.
        """
        if delay is None:
            delay = self.delay + (self.time_constant - time_constant) * self.readings.modes.delay
        return SummarisedProblem(super().changed(law, time_constant), self.deep, delay, self.nodes)

    def at(self, delay: float, plane: float, pseudo: PseudoRows | None = None) -> CoefficientFit:
        """Fit the coefficients at a delay [s] and surface position [m]; use pseudo-rows if accurate."""
        table = self._find_table(delay, np.array([plane]))
        if table is not None and pseudo is None:
            inner = self.others.at(delay, plane, table.rows(delay, np.array([plane])))
            if self._is_pushing(table, [inner]):
                return inner
        return super().at(delay, plane, pseudo)

    def fit_surfaces(
        self, delay: float, planes: np.ndarray, pseudo: PseudoRows | None = None
    ) -> list[CoefficientFit]:
        """Fit the coefficients for each surface position `planes` [m]; compute no derivatives of the fits."""
        table = self._find_table(delay, planes)
        if table is not None and pseudo is None:
            fits = self.others.fit_surfaces(delay, planes, table.rows(delay, planes))
            if self._is_pushing(table, fits):
                return fits
        return super().fit_surfaces(delay, planes, pseudo)

    def _is_pushing(self, table: _DesignTable, fits: list[CoefficientFit]) -> bool:
        """Return whether all fits give a positive force in all readings that the table summarises."""
        if self.law.pulls or not self.damping_indices:
            return True
        return all(np.all(compute_force(fit.coefficients[None], table.extreme) > 0.0) for fit in fits)

    def _find_table(self, delay: float, planes: np.ndarray) -> _DesignTable | None:
        """Find or build a table of pseudo-rows for a delay and surface positions; else return None."""
        for table in self.tables:
            if table.covers(delay, planes):
                return table
        while self.planes and len(self.tables) < MAX_TABLES:
            table = self._build_table(delay, float(planes.mean()), self.planes[0])
            if table.is_accurate():
                self.tables.append(table)
                return table if table.covers(delay, planes) else None
            self.planes = self.planes[1:]
        return None

    def _build_table(self, delay: float, plane: float, count: int) -> _DesignTable:
        """Build a table around a delay [s] and surface position [m], with `count` surface positions."""
        reach, number = self.nodes
        low = self.delay + reach * np.floor((delay - self.delay) / reach + 0.5) - reach / 2.0
        low = float(np.clip(low, self.min_delay, MAX_FORCE_DELAY - reach))
        delays = _chebyshev_nodes(low, low + reach, number)
        moved = [block.motion.at(node) for node in delays for block in self.blocks]
        lowest = min(float(x.min()) for x, _ in moved)
        # At delays between two nodes, the smallest depth may be smaller than at the nodes.
        lowest -= reach / number * max(float(np.abs(v).max()) for _, v in moved)
        half = 0.5 * SURFACE_RANGE_SHARE * max(lowest - plane, 1e-9)
        planes = _chebyshev_nodes(plane - half, plane + half, count)
        # The force first becomes negative in the row with the fastest retraction relative to the depth.
        rate, depth = min(
            ((v.ravel()[row], x.ravel()[row] - plane) for x, v in moved
             for row in [int(np.argmin(v / np.maximum(x - plane, 1e-9)))]),
            key=lambda point: point[0] / max(point[1], 1e-9),
        )  # fmt: skip
        extreme = self._tabulate(np.full((1, 1), depth), np.full(1, rate), np.zeros(1, int))
        limit = (-np.inf, lowest) if count == SURFACE_NODES[0] else (plane - half, min(plane + half, lowest))
        return _DesignTable(delays, planes, (low, low + reach), limit, extreme,
                      *_factorise_columns(self.blocks, delays, planes))  # fmt: skip


@dataclass(frozen=True)
class _DesignTable:
    """Table that gives the pseudo-rows (few regression rows) for delays and surface positions in range."""

    delays: np.ndarray  # delays of the nodes [s]
    planes: np.ndarray  # surface positions of the nodes [m]
    ends: tuple[float, float]  # smallest and largest delay that the table covers [s]
    limit: tuple[float, float]  # smallest and largest surface position that the table covers [m]
    extreme: np.ndarray  # regressors of the law in the row whose force first becomes negative
    # (rows, delays x planes x regressors + 2), regressors of the law at all nodes, then bias and readings
    factor: np.ndarray
    check: np.ndarray  # (rows, regressors), regressors of the law between the nodes, to test the accuracy

    @cached_property
    def by_delay(self) -> BarycentricInterpolator:
        return _interpolator(self.delays)

    @cached_property
    def by_surface(self) -> BarycentricInterpolator:
        return _interpolator(self.planes)

    def covers(self, delay: float, planes: np.ndarray) -> bool:
        """Return whether a delay [s] and all surface positions [m] lie within the range of the table."""
        low, high = self.limit
        distance = max(self.ends[0] - delay, delay - self.ends[1])
        return distance <= DELAY_TOLERANCE and low <= planes.min() and planes.max() < high

    def rows(self, delay: float, planes: np.ndarray) -> PseudoRows:
        """Interpolate the pseudo-rows (few regression rows that replace all readings in deep contact).

        Args:
            delay: Force delay [s].
            planes: Positions of the surface [m].
        """
        by_delay = self.by_delay(delay)
        nodes = self.factor[:, :-2].reshape(len(self.factor), len(self.delays), len(self.planes), -1)
        columns = np.einsum("rdpc,d->rpc", nodes, by_delay)
        design = np.einsum("rnc,pn->pcr", columns, self.by_surface(planes))
        by_plane = np.einsum("rnc,pn->pcr", columns, self.by_surface.derivative(planes))
        bias = np.broadcast_to(self.factor[:, -2], (len(planes), 1, len(self.factor)))
        return PseudoRows(
            np.concatenate([design, bias], axis=1),
            self.factor[:, -1],
            np.concatenate([by_plane, np.zeros_like(bias)], axis=1),
        )

    def is_accurate(self) -> bool:
        """Return whether interpolation between nodes gives the force of the best fit accurately enough."""
        delay, plane = _point_between_nodes(self.delays, self.planes)
        rows = self.rows(delay, np.array([plane]))
        best = np.linalg.lstsq(rows.design[0].T, rows.target, rcond=None)[0]
        off = best[:-1] @ (rows.design[0, :-1] - self.check.T)
        return float(off @ off) < MAX_INTERPOLATION_ERROR**2


def _split_into_blocks(problem: ContactProblem, lanes: np.ndarray) -> list[ContactProblem]:
    """Split deep lanes into problems of at most `LANES_PER_BLOCK` lanes; drop unused rows at the start."""
    counts = problem.readings.counts[:, lanes]
    begin = max(int(np.argmax(counts.any(axis=1))) - problem.memory, 0)
    parts = np.array_split(lanes, -(-len(lanes) // LANES_PER_BLOCK))
    return [
        ContactProblem(
            problem.motion.of(part, begin, 0.0),
            problem.readings.select_lanes(part, begin),
            problem.law,
            problem.plane,
            problem.time_constant,
        )
        for part in parts
    ]


def _factorise_columns(
    blocks: list[ContactProblem], delays: np.ndarray, planes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce the regressors and readings of all rows to few pseudo-rows with the same normal equations.

    Return two arrays with one row per pseudo-row. The first contains the regressors at the interpolation
    nodes (delays and surface positions), the bias and the readings. The second contains the regressors at a
    delay and a surface position between the nodes.
    """
    total, count = 0.0, 0
    delay, plane = _point_between_nodes(delays, planes)
    for block in blocks:
        designs = [block.inside(node, planes)[0] for node in delays]
        check, target = block.inside(delay, np.array([plane]))
        columns = [design[:, :-1].reshape(-1, len(target)) for design in designs]
        table = np.concatenate([*columns, check[0, -1:], target[None], check[0, :-1]])
        total, count = total + table @ table.T, check.shape[1] - 1
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    real = values > MIN_SINGULAR_VALUE**2 * values[-1]
    factor = np.sqrt(values[real])[:, None] * vectors[:, real].T * size
    return factor[:, :-count], factor[:, -count:]


def _point_between_nodes(delays: np.ndarray, planes: np.ndarray) -> tuple[float, float]:
    """Return a delay and a surface position, each halfway between the first two interpolation nodes."""
    return 0.5 * float(delays[0] + delays[1]), 0.5 * float(planes[0] + planes[1])


def _chebyshev_nodes(low: float, high: float, count: int) -> np.ndarray:
    angles = np.pi * (np.arange(count) + 0.5) / count
    return 0.5 * (low + high) - 0.5 * (high - low) * np.cos(angles)


def _interpolator(nodes: np.ndarray) -> BarycentricInterpolator:
    """Return a function that computes the weights of the nodes for polynomial interpolation at a point."""
    # Without a seed, SciPy sums in random order, so that the last digits of results would change.
    return BarycentricInterpolator(nodes, np.eye(len(nodes)), rng=0)
