"""Statistics over two inputs for the plots of a sweep, accumulated part by part in constant memory.

They are counts of errors per cell of a grid, the first scenarios as points, and numbers of failures up to
some numbers of scenarios. Parts may come in any order and size; the grid does not depend on the draws.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism, value_at
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
# Factor and display unit by SI unit.
DISPLAY_UNITS = {"s": (1e3, "ms"), "m": (1e3, "mm"), "m/s": (1e3, "mm/s"), "N/m": (1e-3, "kN/m")}
END_PROBABILITIES = 0.001, 0.999  # probabilities of the grid's ends; values outside count in the outer cells
CONTACTS_PER_CELL = 150  # average number of contacts per cell
MAX_CELLS = 28  # largest number of cells along an axis
MAX_POINTS, MAX_FAILED_POINTS = (
    4000,
    2000,
)  # number of first scenarios and of first failed ones that are points
LOOK_COUNT = 200  # approximate number of looks, i.e. numbers of scenarios up to which failures are counted


class PlotInput(NamedTuple):
    """Input as an axis of a plot."""

    name: str  # displayed name
    unit: str  # displayed unit
    columns: tuple[str, ...]  # column per contact, or one per scenario
    factor: float  # displayed value over the column's value
    low: float  # low end of the axis in the displayed unit
    high: float  # high end of the axis in the displayed unit
    logarithmic: bool

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit or '1'}]"

    def edges(self, cells: int) -> np.ndarray:
        """Return the edges of equal cells, (cells + 1,)."""
        spaced = np.geomspace if self.logarithmic else np.linspace
        return spaced(self.low, self.high, cells + 1)

    def values(self, rows: Rows, contact: int = 0) -> np.ndarray:
        """Return the value of each row in the displayed unit."""
        return self.factor * rows[self.columns[contact]]


class PlotPlan(NamedTuple):
    """Inputs, grid and looks for which statistics are accumulated."""

    per_contact: tuple[PlotInput, ...]  # up to two inputs with a column per contact; none if nothing varies
    per_scenario: tuple[PlotInput, ...]  # the same inputs with one column per scenario
    cells: int  # number of cells along an axis
    looks: np.ndarray  # numbers of scenarios up to which failures are counted
    contacts: tuple[ContactColumns, ...]
    replicates: int


class PlotPoints(NamedTuple):
    """Scenarios as points of a plot, in order of their index."""

    index: np.ndarray  # (points,)
    inputs: np.ndarray  # (inputs, points)
    size: np.ndarray  # worst |error|, infinite if a contact did not end (points,)
    failed: np.ndarray  # whether the scenario failed (points,)


class PlotStatistics(NamedTuple):
    """Accumulated statistics."""

    sizes: np.ndarray  # contacts per cell and bin of |error| (cells, ..., bins); infinity is in the last bin
    points: PlotPoints
    seen: np.ndarray  # scenarios between looks, per replicate (looks + 1, replicates)
    failures: np.ndarray  # failed scenarios among `seen`

    @property
    def scenarios(self) -> int:
        return int(np.sum(self.seen))

    @property
    def failed(self) -> int:
        return int(np.sum(self.failures))


def read_regions(store: SweepStore, mechanism: AnyMechanism) -> tuple[PlotPlan | None, PlotStatistics | None]:
    """Return the statistics of the parts before the first missing one; None if that is the first.

    One part is read at a time.
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
    """Plan the statistics over stiffness and force delay, if drawn.

    Otherwise the inputs are those with the strongest rank correlation with |error| among `rows`, the first
    part.
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
    """Return the statistics of no scenarios."""
    inputs = len(plan.per_contact)
    empty = np.empty(0)
    points = PlotPoints(empty.astype(np.int64), np.empty((inputs, 0)), empty, empty.astype(bool))
    counts = np.zeros((len(plan.looks) + 1, plan.replicates), np.int64)
    sizes = np.zeros((*(plan.cells,) * inputs, BIN_COUNT), np.int64)
    return PlotStatistics(sizes, points, counts, counts)


def add_to_statistics(plan: PlotPlan, regions: PlotStatistics, rows: Rows) -> PlotStatistics:
    """Return the statistics with more rows.

    The rows need the inputs, `index`, `error_*`, `status_*`, `worst_error`, `outcome` and `failed`.
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
    """Return the quantile of |error| from bin counts along the last axis of `sizes`, within 0.5 %.

    It is at least the first edge of the bins, so that its logarithm is finite, and NaN if fewer than `least`
    errors were counted.
    """
    values = np.maximum(binned_estimate(sizes, order), BIN_EDGES[0])
    return np.where(np.sum(sizes, axis=-1) >= least, values, np.nan)


def _count_errors(plan: PlotPlan, rows: Rows, shape: tuple[int, ...]) -> np.ndarray:
    """Return the counts of contacts per cell and bin of |error|."""
    counts = np.zeros(int(np.prod(shape)), np.int64)
    good = np.ones(len(rows["index"]), bool)
    for contact, slot in enumerate(plan.contacts):
        # A contact that did not end counts as an infinite error, and later contacts do not count.
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
    """Return the first `MAX_POINTS` points and the first `MAX_FAILED_POINTS` failed ones."""
    order = np.argsort(points.index, kind="stable")
    failed = points.failed[order]
    selected = order[
        (np.arange(len(order)) < MAX_POINTS) | (failed & (np.cumsum(failed) <= MAX_FAILED_POINTS))
    ]
    return PlotPoints(*(values[..., selected] for values in points))


def _compute_rank_correlations(
    mechanism: AnyMechanism, path: str, rows: Rows, size: np.ndarray
) -> np.ndarray:
    """Return |rank correlation| (Spearman 1904) of each entry with `size`; NaN if the entry does not vary."""
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
    """Return nominal value, low end and high end of each entry of an input."""
    points = np.repeat(
        np.array(END_PROBABILITIES)[:, None], sum(count_dimensions(mechanism).values()), axis=1
    )
    low, high = compute_quantiles(mechanism, points)[path].reshape(2, -1)
    nominal = value_at(mechanism, path) if path != PHASE_KEY else np.zeros(len(low))
    return np.broadcast_to(np.ravel(nominal), low.shape).astype(float), low, high


def _build_contact_input(mechanism: AnyMechanism, path: str) -> PlotInput:
    """Return the input with a column per contact; a list of values has one entry per contact."""
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
    """Return the input with one column per scenario, that of an entry.

    If all entries are drawn together, the value is shown relative to nominal, which applies to all.
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
