"""Long presses as few pseudo-rows: the same misfit at a fraction of the cost.

A slow press has ten thousands of readings, but its motion has few degrees of freedom. While a lane stays
deep in contact, what the sensor reads is a smooth function of delay and surface position. The law's
functions are therefore computed at a few delays and surface positions (Chebyshev nodes) and interpolated by
polynomials. The triangular factor of these columns and of the readings has the sums of squares of all rows,
so its rows stand for them (Golub and Van Loan, "Matrix Computations", section 5.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BarycentricInterpolator

from tuning.identification.contact_laws import Law
from tuning.identification.contact_problem import MAX_FORCE_DELAY, ContactProblem
from tuning.identification.contact_profile import estimate_surface_from_onset
from tuning.identification.contact_regression import CoefficientFit, PseudoRows, compute_force
from tuning.identification.motion import MotionResponse

MIN_DEEP_LANES = 6  # deep lanes that are worth the effort
LANES_FOR_LAW_CHOICE = 8  # deep lanes that suffice to find the exponent or the depths of a contact law
MIN_DEPTH_SHARE = 0.1  # share of a lane's median depth that its least depth exceeds
DELAY_RANGE = 0.002  # s, delays that one interpolation covers
DELAY_NODES = 8  # delays at which it is exact
# surface positions at which it is exact: for a force that is linear in the depth, and others
SURFACE_NODES = 2, 4
SURFACE_RANGE_SHARE = 0.1  # surface positions that it covers, over the least depth, for nonlinear forces
# standard deviations by which the interpolation may be off, all readings together
MAX_INTERPOLATION_ERROR = 0.01
LANES_PER_BLOCK = 50  # lanes whose functions are computed at once
MAX_TABLES = 60  # interpolations beyond which searches go too far for them to pay
MIN_SINGULAR_VALUE = 1e-8  # relative singular value below which a pseudo-row is rounding


def find_deep_lanes(motion: MotionResponse, plane: float) -> np.ndarray:
    """Return whether each lane stays deep in contact with a surface at `plane` [m], for all force delays."""
    depths = [motion.at(delay)[0] - plane for delay in (0.0, MAX_FORCE_DELAY / 2.0, MAX_FORCE_DELAY)]
    least = np.min([depth.min(axis=0) for depth in depths], axis=0)
    return least > MIN_DEPTH_SHARE * np.maximum(np.median(depths[1], axis=0), 0.0)


def summarise_deep_lanes(problem: ContactProblem, near: tuple[float, float] | None) -> ContactProblem:
    """Return the problem with pseudo-rows in place of its deep lanes, if it has enough of these.

    Args:
        problem: Problem with all rows.
        near: Force delay [s] and surface position [m] about which most fits will be, if they are known.
    """
    delay, plane = near or (MAX_FORCE_DELAY / 4.0, _approximate_surface(problem))
    deep = find_deep_lanes(problem.motion, plane) & problem.readings.counts.any(axis=0)
    # A problem without any lane has no functions to fit.
    deep[-1] = False
    return SummarisedProblem(problem, deep, delay) if deep.sum() >= MIN_DEEP_LANES else problem


def select_representative_lanes(problem: ContactProblem) -> np.ndarray:
    """Return the lanes of a problem without most of its deep ones, which are alike."""
    deep = np.flatnonzero(find_deep_lanes(problem.motion, _approximate_surface(problem)))
    dropped = np.delete(
        deep, np.linspace(0, len(deep) - 1, min(LANES_FOR_LAW_CHOICE, len(deep))).round().astype(int)
    )
    return np.delete(np.arange(problem.readings.force.shape[1]), dropped)


def _approximate_surface(problem: ContactProblem) -> float:
    """Return an approximate position of the surface [m]."""
    if problem.plane is not None:
        return problem.plane
    return problem.find_best_surface(
        MAX_FORCE_DELAY / 4.0, estimate_surface_from_onset(problem, MAX_FORCE_DELAY / 4.0)
    )[0]


class SummarisedProblem(ContactProblem):
    """Problem with pseudo-rows in place of its deep lanes, wherever they are accurate."""

    def __init__(self, problem: ContactProblem, deep: np.ndarray, delay: float):
        """Split the lanes of a problem; `deep` flags those to summarize, `delay` [s] is a likely one."""
        motion, readings, law = problem.motion, problem.readings, problem.law
        super().__init__(motion, readings, law, problem.plane, problem.time_constant)
        self.deep, self.delay = deep, delay
        lanes = np.flatnonzero(~deep)
        self.others = ContactProblem(
            motion.of(lanes), readings.select_lanes(lanes), law, problem.plane, problem.time_constant
        )
        self.blocks = _split_into_blocks(problem, np.flatnonzero(deep))
        self.tables: list[_DesignTable] = []
        self.planes = SURFACE_NODES

    def changed(self, law: Law, time_constant: float) -> ContactProblem:
        """Return the same problem with another law and another lag of the sensor [s]."""
        delay = self.delay + self.time_constant - time_constant
        return SummarisedProblem(super().changed(law, time_constant), self.deep, delay)

    def at(self, delay: float, plane: float, pseudo: PseudoRows | None = None) -> CoefficientFit:
        """Fit the coefficients at one delay [s] and plane [m]."""
        table = self._table(delay, np.array([plane]))
        if table is not None and pseudo is None:
            inner = self.others.at(delay, plane, table.rows(delay, np.array([plane])))
            if self._pushes(table, [inner]):
                return inner
        return super().at(delay, plane, pseudo)

    def fit_surfaces(
        self, delay: float, planes: np.ndarray, pseudo: PseudoRows | None = None
    ) -> list[CoefficientFit]:
        """Fit the coefficients at several planes at once, without derivatives by the plane."""
        table = self._table(delay, planes)
        if table is not None and pseudo is None:
            fits = self.others.fit_surfaces(delay, planes, table.rows(delay, planes))
            if self._pushes(table, fits):
                return fits
        return super().fit_surfaces(delay, planes, pseudo)

    def _pushes(self, table: _DesignTable, fits: list[CoefficientFit]) -> bool:
        """Return whether the force of all fits is positive in all deep rows."""
        if self.law.pulls or not self.damping_indices:
            return True
        return all(np.all(compute_force(fit.coefficients[None], table.extreme) > 0.0) for fit in fits)

    def _table(self, delay: float, planes: np.ndarray) -> _DesignTable | None:
        """Return the interpolation there, or None if none is accurate."""
        for table in self.tables:
            if table.covers(delay, planes):
                return table
        while self.planes and len(self.tables) < MAX_TABLES:
            table = self._new_table(delay, float(planes.mean()), self.planes[0])
            if table.is_accurate():
                self.tables.append(table)
                return table if table.covers(delay, planes) else None
            self.planes = self.planes[1:]
        return None

    def _new_table(self, delay: float, plane: float, count: int) -> _DesignTable:
        """Return an interpolation that covers a delay and a plane, with `count` planes."""
        low = (
            self.delay + DELAY_RANGE * np.floor((delay - self.delay) / DELAY_RANGE + 0.5) - DELAY_RANGE / 2.0
        )
        low = float(np.clip(low, self.min_delay, MAX_FORCE_DELAY - DELAY_RANGE))
        delays = _chebyshev_nodes(low, low + DELAY_RANGE, DELAY_NODES)
        moved = [block.motion.at(node) for node in delays for block in self.blocks]
        lowest = min(float(x.min()) for x, _ in moved)
        # Between two nodes the motion may reach lower.
        lowest -= DELAY_RANGE / DELAY_NODES * max(float(np.abs(v).max()) for _, v in moved)
        half = 0.5 * SURFACE_RANGE_SHARE * max(lowest - plane, 1e-9)
        planes = _chebyshev_nodes(plane - half, plane + half, count)
        # A law pulls, if anywhere, where the mechanism recedes fastest for its depth.
        rate, depth = min(
            ((v.ravel()[row], x.ravel()[row] - plane) for x, v in moved
             for row in [int(np.argmin(v / np.maximum(x - plane, 1e-9)))]),
            key=lambda point: point[0] / max(point[1], 1e-9),
        )  # fmt: skip
        extreme = self._columns(np.full((1, 1), depth), np.full(1, rate), np.zeros(1, int))
        limit = (-np.inf, lowest) if count == SURFACE_NODES[0] else (plane - half, min(plane + half, lowest))
        return _DesignTable(delays, planes, (low, low + DELAY_RANGE), limit, extreme,
                      *_factorise_columns(self.blocks, delays, planes))  # fmt: skip


@dataclass(frozen=True)
class _DesignTable:
    """Factor of the law's functions in deep rows at nodes of delay and plane."""

    delays: np.ndarray  # s, nodes
    planes: np.ndarray  # m, nodes
    ends: tuple[float, float]  # s, delays that it covers
    limit: tuple[float, float]  # m, planes that it covers
    extreme: np.ndarray  # the law's functions at the row that pulls first
    factor: np.ndarray  # (rows, delays x planes x functions + 2); last the bias and the readings
    check: np.ndarray  # (rows, functions), the functions between the nodes

    def covers(self, delay: float, planes: np.ndarray) -> bool:
        """Return whether a delay and all planes lie within the range of the table."""
        low, high = self.limit
        return self.ends[0] <= delay <= self.ends[1] and low <= planes.min() and planes.max() < high

    def rows(self, delay: float, planes: np.ndarray) -> PseudoRows:
        """Return the pseudo-rows at a delay [s] and at planes [m]."""
        by_delay = _interpolator(self.delays)(delay)
        nodes = self.factor[:, :-2].reshape(len(self.factor), len(self.delays), len(self.planes), -1)
        columns = np.einsum("rdpc,d->rpc", nodes, by_delay)
        by_surface = _interpolator(self.planes)
        design = np.einsum("rnc,pn->pcr", columns, by_surface(planes))
        by_plane = np.einsum("rnc,pn->pcr", columns, by_surface.derivative(planes))
        bias = np.broadcast_to(self.factor[:, -2], (len(planes), 1, len(self.factor)))
        return PseudoRows(
            np.concatenate([design, bias], axis=1),
            self.factor[:, -1],
            np.concatenate([by_plane, np.zeros_like(bias)], axis=1),
        )

    def is_accurate(self) -> bool:
        """Return whether the interpolated force of the best fit is exact between the nodes."""
        delay, plane = _point_between_nodes(self.delays, self.planes)
        rows = self.rows(delay, np.array([plane]))
        best = np.linalg.lstsq(rows.design[0].T, rows.target, rcond=None)[0]
        off = best[:-1] @ (rows.design[0, :-1] - self.check.T)
        return float(off @ off) < MAX_INTERPOLATION_ERROR**2


def _split_into_blocks(problem: ContactProblem, lanes: np.ndarray) -> list[ContactProblem]:
    """Return problems of at most `LANES_PER_BLOCK` deep lanes each, without rows that no filter needs."""
    counts = problem.readings.counts[:, lanes]
    begin = max(int(np.argmax(counts.any(axis=1))) - problem.memory, 0)
    parts = np.array_split(lanes, -(-len(lanes) // LANES_PER_BLOCK))
    return [
        ContactProblem(
            problem.motion.of(part, begin),
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
    """Return the triangular factor of functions, bias and readings, up to a rotation of its rows.

    The second array continues it by the functions between the nodes.
    """
    total, count = 0.0, 0
    delay, plane = _point_between_nodes(delays, planes)
    for block in blocks:
        designs = [block.inside(node, planes) for node in delays]
        check = block.inside(delay, np.array([plane]))[0, :-1]
        columns = [design[:, :-1].reshape(-1, design.shape[2]) for design in designs]
        table = np.concatenate([*columns, designs[0][:1, -1], block.target[None], check])
        total, count = total + table @ table.T, len(check)
    size = np.sqrt(np.maximum(np.diag(total), 1e-300))
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    real = values > MIN_SINGULAR_VALUE**2 * values[-1]
    factor = np.sqrt(values[real])[:, None] * vectors[:, real].T * size
    return factor[:, :-count], factor[:, -count:]


def _point_between_nodes(delays: np.ndarray, planes: np.ndarray) -> tuple[float, float]:
    """Return a delay and a plane between the nodes."""
    return 0.5 * float(delays[0] + delays[1]), 0.5 * float(planes[0] + planes[1])


def _chebyshev_nodes(low: float, high: float, count: int) -> np.ndarray:
    """Return the Chebyshev nodes of an interval."""
    angles = np.pi * (np.arange(count) + 0.5) / count
    return 0.5 * (low + high) - 0.5 * (high - low) * np.cos(angles)


def _interpolator(nodes: np.ndarray) -> BarycentricInterpolator:
    """Return the polynomial interpolation from the nodes, as the weight of each node at any point."""
    return BarycentricInterpolator(nodes, np.eye(len(nodes)))
