"""Statistics for the plots of a sweep, accumulated chunk by chunk in constant memory.

They contain counts of errors in the cells of a grid whose axes are two inputs, the first scenarios as points,
and the number of failures as a function of the number of scenarios. The chunks can be added in any order and
have any size. The grid does not depend on the draws.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.number_ranges import value_at
from jaxhil.mechanism.structs import Mechanism
from jaxhil.mechanism.uncertainty import PHASE_KEY, compute_quantiles, count_dimensions
from jaxhil.simulation.metrics import CONTACT_STATUS_NAMES, OK
from tuning.statistics.quantiles import BIN_COUNT, BIN_EDGES, binned_estimate
from tuning.sweeps.columns import (
    CONTACT_STATUSES,
    ContactColumns,
    find_key_unit,
    list_contact_columns,
    list_input_columns,
)
from tuning.sweeps.manifest import Manifest
from tuning.sweeps.store import SweepStore, read_intact_chunk
from tuning.sweeps.tally import compute_error_sizes

Rows = Mapping[str, np.ndarray]

PREFERRED_INPUTS = ("contact.stiffness", "rig.force_sensor.delay")
INPUT_LABELS = {"contact.stiffness": "contact stiffness", "rig.force_sensor.delay": "force delay"}
# for each SI unit, the displayed unit and the factor that converts to it
DISPLAY_UNITS = {"s": (1e3, "ms"), "m": (1e3, "mm"), "m/s": (1e3, "mm/s"), "N/m": (1e-3, "kN/m")}
# The grid extends between these quantiles of an input; the outer cells also count all values outside.
END_PROBABILITIES = 0.001, 0.999
CONTACTS_PER_CELL = 150  # average number of contacts per cell
MAX_CELLS = 28  # largest number of cells along an axis
MAX_POINTS, MAX_FAILED_POINTS = 4000, 2000  # largest numbers of plotted scenarios, and of plotted failed ones
LOOK_COUNT = 200  # approximate number of scenario counts at which the number of failures is stored


class PlotInput(NamedTuple):
    """Uncertain input that is an axis of a plot."""

    name: str  # displayed name
    unit: str  # displayed unit
    columns: tuple[str, ...]  # names of the input's columns: one per contact, or one per scenario
    factor: float  # factor that converts a value of the column to the displayed unit
    low: float  # low end of the axis in the displayed unit
    high: float  # high end of the axis in the displayed unit
    logarithmic: bool  # whether the axis is logarithmic

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit or '1'}]"

    def edges(self, cells: int) -> np.ndarray:
        """Return the edges (cells + 1,) of cells that have equal widths on the plot."""
        spaced = np.geomspace if self.logarithmic else np.linspace
        return spaced(self.low, self.high, cells + 1)

    def values(self, rows: Rows, contact: int = 0) -> np.ndarray:
        """Return the input's value in each row, in the displayed unit."""
        return self.factor * rows[self.columns[contact]]


class PlotPlan(NamedTuple):
    """Inputs, grid and scenario counts for which the statistics of a sweep are accumulated."""

    per_contact: tuple[PlotInput, ...]  # up to two inputs, with one column per contact
    per_scenario: tuple[PlotInput, ...]  # the same inputs, with one column per scenario
    cells: int  # number of cells along an axis
    looks: np.ndarray  # ascending scenario counts at which the number of failures is stored
    contacts: tuple[ContactColumns, ...]  # columns of error and status of every contact
    replicates: int  # number of replicates of the sampling


class PlotPoints(NamedTuple):
    """Scenarios that a plot shows as points, in ascending order of their index."""

    index: np.ndarray  # index of the scenario (points,)
    inputs: np.ndarray  # inputs in displayed units (inputs, points)
    size: np.ndarray  # worst |error| [1], infinite if a contact did not end (points,)
    failed: np.ndarray  # whether the scenario failed (points,)


class PlotStatistics(NamedTuple):
    """Statistics of the accumulated rows of a sweep, for plots."""

    # number of contacts per cell and bin of |error| (cells, ..., bins); the last bin includes infinity
    sizes: np.ndarray
    points: PlotPoints
    seen: np.ndarray  # number of scenarios between two looks, per replicate (looks + 1, replicates)
    failures: np.ndarray  # number of failed scenarios between two looks, same shape as `seen`

    @property
    def scenarios(self) -> int:
        return int(np.sum(self.seen))

    @property
    def failed(self) -> int:
        return int(np.sum(self.failures))


def read_regions(store: SweepStore, mechanism: AnyMechanism) -> tuple[PlotPlan | None, PlotStatistics | None]:
    """Accumulate the plot statistics of a sweep's chunks, with one chunk at a time in memory.

    Stop before the first missing chunk. Return (None, None) if this is the first chunk of the sweep.
    """
    plan = regions = None
    for part in range(store.manifest.parts):
        rows = read_intact_chunk(store, part)
        if rows is None:
            break
        plan = plan or plan_statistics(store.manifest, mechanism, rows)
        regions = add_to_statistics(plan, regions or build_empty_statistics(plan), rows)
    return plan, regions


def plan_statistics(manifest: Manifest, mechanism: AnyMechanism, rows: Rows) -> PlotPlan:
    """Choose inputs, grid and scenario counts for the plots of a sweep; `rows` are those of the first chunk.

    The inputs are contact stiffness and force delay. If one of them is not drawn, the input whose rank
    correlation with |error| is strongest in `rows` replaces it.
    """
    size = compute_error_sizes(rows)
    strengths = {
        path: _compute_rank_correlations(mechanism, path, rows, size) for path in count_dimensions(mechanism)
    }
    varying = {path: strength for path, strength in strengths.items() if np.any(np.isfinite(strength))}
    by_strength = sorted(varying, key=lambda path: -np.nanmax(varying[path]))
    paths = [path for path in PREFERRED_INPUTS if path in varying]
    paths = [*paths, *(path for path in by_strength if path not in paths)][:2]
    contacts, replicates = tuple(list_contact_columns(mechanism)), manifest.replicates
    looks = np.geomspace(min(10, manifest.scenarios), manifest.scenarios, LOOK_COUNT)
    looks = np.unique(np.round(looks / replicates).astype(np.int64)) * replicates
    ends = manifest.chunk * np.arange(1, min(manifest.parts, LOOK_COUNT))
    last = manifest.scenarios // replicates * replicates
    looks = np.unique([*looks, *ends[ends % replicates == 0], last])
    looks = looks[(looks > 0) & (looks <= manifest.scenarios)]
    cells = round(np.sqrt(manifest.scenarios * len(contacts) / CONTACTS_PER_CELL))
    return PlotPlan(
        tuple(_build_contact_input(mechanism, path) for path in paths),
        tuple(_build_scenario_input(mechanism, path, int(np.nanargmax(varying[path]))) for path in paths),
        int(np.clip(cells, 2, MAX_CELLS)),
        looks,
        contacts,
        replicates,
    )


def build_empty_statistics(plan: PlotPlan) -> PlotStatistics:
    """Return statistics that contain no scenarios yet."""
    inputs = len(plan.per_contact)
    empty = np.empty(0)
    points = PlotPoints(empty.astype(np.int64), np.empty((inputs, 0)), empty, empty.astype(bool))
    counts = np.zeros((len(plan.looks) + 1, plan.replicates), np.int64)
    sizes = np.zeros((*(plan.cells,) * inputs, BIN_COUNT), np.int64)
    return PlotStatistics(sizes, points, counts, counts)


def add_to_statistics(plan: PlotPlan, regions: PlotStatistics, rows: Rows) -> PlotStatistics:
    """Return the statistics with the scenarios of `rows` added.

    `rows` must contain the inputs, `index`, `error_*`, `status_*`, `worst_error`, `outcome` and `failed`.
    """
    index, failed = rows["index"], rows["failed"]
    inputs = np.array([quantity.values(rows) for quantity in plan.per_scenario])
    inputs = inputs.reshape(len(plan.per_scenario), len(index))
    new = PlotPoints(index, inputs, compute_error_sizes(rows), failed)
    joined = PlotPoints(*(np.concatenate(pair, axis=-1) for pair in zip(regions.points, new, strict=True)))
    position = np.searchsorted(plan.looks, index, side="right") * plan.replicates + index % plan.replicates

    def counted(positions: np.ndarray) -> np.ndarray:
        return np.bincount(positions, minlength=regions.seen.size).reshape(regions.seen.shape)

    return PlotStatistics(
        regions.sizes + _count_errors(plan, rows, regions.sizes.shape),
        _select_first_points(joined),
        regions.seen + counted(position),
        regions.failures + counted(position[failed]),
    )


def compute_error_quantile(sizes: np.ndarray, order: float, least: int) -> np.ndarray:
    """Estimate the quantile of order `order` of |error|, with a relative accuracy of 0.5 %.

    The last axis of `sizes` holds the counts per bin. The result is at least the lowest edge of the bins, so
    that its logarithm is finite. It is NaN if the sum of the counts is below `least`.
    """
    values = np.maximum(binned_estimate(sizes, order), BIN_EDGES[0])
    return np.where(np.sum(sizes, axis=-1) >= least, values, np.nan)


def _count_errors(plan: PlotPlan, rows: Rows, shape: tuple[int, ...]) -> np.ndarray:
    """Count the contacts of the rows in each cell of the grid and each bin of |error|."""
    counts = np.zeros(int(np.prod(shape)), np.int64)
    good = np.ones(len(rows["index"]), bool)
    for contact, slot in enumerate(plan.contacts):
        # A contact that did not end counts as an infinite error. Later contacts of the scenario do not count.
        counted = good
        good = good & (rows[slot.status] == CONTACT_STATUSES.index(CONTACT_STATUS_NAMES[OK]))
        size = np.where(good, np.abs(rows[slot.error].astype(float)), np.inf)
        cell = np.zeros(len(size), np.int64)
        for quantity in plan.per_contact:
            edges = quantity.edges(plan.cells)[1:-1]
            cell = cell * plan.cells + np.searchsorted(edges, quantity.values(rows, contact), side="right")
        size = np.nan_to_num(size, nan=np.inf, posinf=np.inf)
        cell = cell * shape[-1] + np.searchsorted(BIN_EDGES, size, side="right")
        counts += np.bincount(cell[counted], minlength=len(counts))
    return counts.reshape(shape)


def _select_first_points(points: PlotPoints) -> PlotPoints:
    """Select the first `MAX_POINTS` points and the first `MAX_FAILED_POINTS` failed points, by index."""
    order = np.argsort(points.index, kind="stable")
    failed = points.failed[order]
    selected = order[
        (np.arange(len(order)) < MAX_POINTS) | (failed & (np.cumsum(failed) <= MAX_FAILED_POINTS))
    ]
    return PlotPoints(*(values[..., selected] for values in points))


def _compute_rank_correlations(
    mechanism: AnyMechanism, path: str, rows: Rows, size: np.ndarray
) -> np.ndarray:
    """Return |rank correlation| (Spearman 1904) of |error| with each number of an input; NaN if constant."""
    _, low, high = _find_input_range(mechanism, path)

    def ranks(values: np.ndarray) -> np.ndarray:
        rank = np.empty(len(values))
        rank[np.argsort(values, kind="stable")] = np.arange(len(values))
        return rank - np.mean(rank)

    of_size = ranks(size)
    spread = max(float(np.sum(of_size**2)), 1.0)
    correlations = [
        abs(float(ranks(rows[name]) @ of_size)) / spread for name in list_input_columns(mechanism, path)
    ]
    return np.where(high > low, correlations, np.nan)


def _find_input_range(mechanism: AnyMechanism, path: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nominal value and quantiles `END_PROBABILITIES` of each entry (number in a list) of an input."""
    points = np.repeat(
        np.array(END_PROBABILITIES)[:, None], sum(count_dimensions(mechanism).values()), axis=1
    )
    low, high = compute_quantiles(mechanism, points)[path].reshape(2, -1)
    nominal = value_at(mechanism, path) if path != PHASE_KEY else np.zeros(len(low))
    return np.broadcast_to(np.ravel(nominal), low.shape).astype(float), low, high


def _build_contact_input(mechanism: AnyMechanism, path: str) -> PlotInput:
    """Describe an input with one column per contact, because a list can hold one entry for each contact."""
    names, (_, low, high) = list_input_columns(mechanism, path), _find_input_range(mechanism, path)
    contacts = range(len(list_contact_columns(mechanism)))
    listed = path == PHASE_KEY or (
        path in ("contact.stiffness", "contact.damping") and _is_list(mechanism, path)
    )
    if listed and isinstance(mechanism, Mechanism):
        used = [min(contact, len(names) - 1) for contact in contacts]
        factor, unit = DISPLAY_UNITS.get(
            find_key_unit(mechanism, path), (1.0, find_key_unit(mechanism, path))
        )
        low, high = factor * np.min(low[used]), factor * np.max(high[used])
        columns = tuple(names[index] for index in used)
        name = INPUT_LABELS.get(path, path)
        return PlotInput(name, unit, columns, factor, low, high, _is_logarithmic(mechanism, path, low, high))
    quantity = _build_scenario_input(mechanism, path, 0)
    return quantity._replace(columns=quantity.columns * len(contacts))


def _build_scenario_input(mechanism: AnyMechanism, path: str, entry: int) -> PlotInput:
    """Describe an input with one value per scenario: the number with index `entry`, if the input is a list.

    If all numbers of the list are drawn with a common factor, the values are this factor.
    """
    names, (nominal, low, high) = list_input_columns(mechanism, path), _find_input_range(mechanism, path)
    name = INPUT_LABELS.get(path, path)
    factor, unit = DISPLAY_UNITS.get(find_key_unit(mechanism, path), (1.0, find_key_unit(mechanism, path)))
    if len(names) > 1:
        together = path != PHASE_KEY and not mechanism.uncertainty[path].independent
        if together and nominal[entry]:
            name, factor, unit = f"{name} over nominal", 1 / nominal[entry], "1"
        else:
            name = f"{name}, entry {entry + 1}" if path != PHASE_KEY else f"{name} of contact {entry + 1}"
    low, high = sorted((factor * low[entry], factor * high[entry]))
    return PlotInput(
        name, unit, (names[entry],), factor, low, high, _is_logarithmic(mechanism, path, low, high)
    )


def _is_logarithmic(mechanism: AnyMechanism, path: str, low: float, high: float) -> bool:
    draw = mechanism.uncertainty.get(path)
    return low > 0 and ((draw is not None and draw.distribution == "loguniform") or high > 5 * low)


def _is_list(mechanism: AnyMechanism, path: str) -> bool:
    return np.ndim(value_at(mechanism, path)) == 1
