"""Where errors are large and scenarios fail, over two inputs: what pictures of a sweep show.

Accumulated part by part in constant memory: counts of errors per cell of a grid, the first scenarios as
points, failures counted up to some numbers of scenarios. Parts may come in any order and size; the grid
follows from the manifest, not from what was drawn.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism, value_at
from jaxhil.mechanism.uncertainty import PHASE, dimensions, quantiles
from jaxhil.simulation.metrics import OK, STATUS_NAMES
from tuning.statistics.quantiles import BINS, EDGES, binned_estimate
from tuning.sweeps.columns import STATUSES, Slot, input_names, slots, unit_of
from tuning.sweeps.manifest import Manifest
from tuning.sweeps.tally import error_sizes

Rows = Mapping[str, np.ndarray]

PREFERRED = ("contact.stiffness", "rig.force_sensor.delay")
NAMES = {"contact.stiffness": "contact stiffness", "rig.force_sensor.delay": "force delay"}
# Display units: factor and unit.
UNITS = {"s": (1e3, "ms"), "m": (1e3, "mm"), "m/s": (1e3, "mm/s"), "N/m": (1e-3, "kN/m")}
ENDS = 0.001, 0.999  # probabilities between which the grid lies; what is outside counts in its outer cells
PER_CELL = 150  # contacts, on average
MOST_CELLS = 28  # along an axis
POINTS, FAILED_POINTS = 4000, 2000  # the first scenarios, and the first failed ones
LOOKS = 200  # numbers of scenarios at which the failures are counted


class Input(NamedTuple):
    """An input as an axis."""

    name: str  # as displayed
    unit: str  # as displayed
    columns: tuple[str, ...]  # that of each contact
    factor: float  # displayed value over the column's
    low: float  # end of the axis, displayed
    high: float  # the other end
    logarithmic: bool

    @property
    def label(self) -> str:
        return f"{self.name} [{self.unit or '1'}]"

    def edges(self, cells: int) -> np.ndarray:
        """Edges of equal cells, (cells + 1,)."""
        spaced = np.geomspace if self.logarithmic else np.linspace
        return spaced(self.low, self.high, cells + 1)

    def values(self, rows: Rows, contact: int = 0) -> np.ndarray:
        """Of each row, as displayed."""
        return self.factor * rows[self.columns[contact]]


class Plan(NamedTuple):
    """What to accumulate."""

    per_contact: tuple[Input, ...]  # one or two inputs, as every contact has them; none where nothing varies
    per_scenario: tuple[Input, ...]  # the same as a scenario has them
    cells: int  # along an axis
    looks: np.ndarray  # numbers of scenarios to look at
    contacts: tuple[Slot, ...]
    replicates: int


class Points(NamedTuple):
    """Scenarios as points, by index."""

    index: np.ndarray  # (points,)
    inputs: np.ndarray  # (inputs, points)
    size: np.ndarray  # of the worst error, infinite where a contact did not end (points,)
    failed: np.ndarray  # whether it counts as failed (points,)


class Regions(NamedTuple):
    """What was accumulated."""

    sizes: np.ndarray  # contacts per cell and bin of |error| (cells, ..., bins), the last bin infinite too
    points: Points
    seen: np.ndarray  # scenarios between looks, per replicate (looks + 1, replicates)
    failures: np.ndarray  # failed ones among them

    @property
    def scenarios(self) -> int:
        return int(np.sum(self.seen))

    @property
    def failed(self) -> int:
        return int(np.sum(self.failures))


def make_plan(manifest: Manifest, mechanism: AnyMechanism, rows: Rows) -> Plan:
    """Stiffness and force delay where they are drawn; else the inputs with the strongest rank correlation
    with |error| among `rows`, of the first part."""
    size = error_sizes(rows)
    strengths = {path: _strengths(mechanism, path, rows, size) for path in dimensions(mechanism)}
    varying = {path: found for path, found in strengths.items() if np.any(np.isfinite(found))}
    by_strength = sorted(varying, key=lambda path: -np.nanmax(varying[path]))
    paths = [path for path in PREFERRED if path in varying]
    paths = [*paths, *(path for path in by_strength if path not in paths)][:2]
    contacts, of = tuple(slots(mechanism)), manifest.replicates
    looks = np.geomspace(min(10, manifest.scenarios), manifest.scenarios, LOOKS)
    looks = np.unique(np.round(looks / of).astype(np.int64)) * of
    ends = manifest.chunk * np.arange(1, min(manifest.parts, LOOKS))
    looks = np.unique([*looks, *ends[ends % of == 0], manifest.scenarios // of * of])
    looks = looks[(looks > 0) & (looks <= manifest.scenarios)]
    cells = round(np.sqrt(manifest.scenarios * len(contacts) / PER_CELL))
    return Plan(
        tuple(_per_contact(mechanism, path) for path in paths),
        tuple(_per_scenario(mechanism, path, int(np.nanargmax(varying[path]))) for path in paths),
        int(np.clip(cells, 2, MOST_CELLS)),
        looks,
        contacts,
        of,
    )


def empty_regions(plan: Plan) -> Regions:
    """Before any scenario."""
    inputs = len(plan.per_contact)
    none = np.empty(0)
    points = Points(none.astype(np.int64), np.empty((inputs, 0)), none, none.astype(bool))
    counts = np.zeros((len(plan.looks) + 1, plan.replicates), np.int64)
    sizes = np.zeros((*(plan.cells,) * inputs, BINS), np.int64)
    return Regions(sizes, points, counts, counts)


def add_rows(plan: Plan, regions: Regions, rows: Rows) -> Regions:
    """With some more rows: inputs, `index`, `error_*`, `status_*`, `worst_error`, `outcome`, `failed`."""
    index, failed = rows["index"], rows["failed"]
    inputs = np.array([one.values(rows) for one in plan.per_scenario])
    inputs = inputs.reshape(len(plan.per_scenario), len(index))
    found = Points(index, inputs, error_sizes(rows), failed)
    joined = Points(*(np.concatenate(pair, axis=-1) for pair in zip(regions.points, found, strict=True)))
    place = np.searchsorted(plan.looks, index, side="right") * plan.replicates + index % plan.replicates

    def counted(where: np.ndarray) -> np.ndarray:
        return np.bincount(where, minlength=regions.seen.size).reshape(regions.seen.shape)

    return Regions(
        regions.sizes + _sizes(plan, rows, regions.sizes.shape),
        _first(joined),
        regions.seen + counted(place),
        regions.failures + counted(place[failed]),
    )


def quantile(sizes: np.ndarray, order: float, least: int) -> np.ndarray:
    """The quantile of |error| along the last axis of `sizes`, within 0.5 %, at least the first edge of the
    bins, so that it has a logarithm; NaN where less than `least` are."""
    found = np.maximum(binned_estimate(sizes, order), EDGES[0])
    return np.where(np.sum(sizes, axis=-1) >= least, found, np.nan)


def _sizes(plan: Plan, rows: Rows, shape: tuple[int, ...]) -> np.ndarray:
    counts = np.zeros(int(np.prod(shape)), np.int64)
    good = np.ones(len(rows["index"]), bool)
    for contact, slot in enumerate(plan.contacts):
        # A contact that did not end is larger than any error; what would come after it does not count.
        counted = good
        good = good & (rows[slot.status] == STATUSES.index(STATUS_NAMES[OK]))
        size = np.where(good, np.abs(rows[slot.error].astype(float)), np.inf)
        place = np.zeros(len(size), np.int64)
        for one in plan.per_contact:
            edges = one.edges(plan.cells)[1:-1]
            place = place * plan.cells + np.searchsorted(edges, one.values(rows, contact), side="right")
        size = np.nan_to_num(size, nan=np.inf, posinf=np.inf)
        place = place * shape[-1] + np.searchsorted(EDGES, size, side="right")
        counts += np.bincount(place[counted], minlength=len(counts))
    return counts.reshape(shape)


def _first(points: Points) -> Points:
    order = np.argsort(points.index, kind="stable")
    failed = points.failed[order]
    kept = order[(np.arange(len(order)) < POINTS) | (failed & (np.cumsum(failed) <= FAILED_POINTS))]
    return Points(*(values[..., kept] for values in points))


def _strengths(mechanism: AnyMechanism, path: str, rows: Rows, size: np.ndarray) -> np.ndarray:
    """|rank correlation| (Spearman 1904) of each entry's column with `size`; NaN for what does not vary."""
    _, low, high = _ends(mechanism, path)

    def ranks(values: np.ndarray) -> np.ndarray:
        found = np.empty(len(values))
        found[np.argsort(values, kind="stable")] = np.arange(len(values))
        return found - np.mean(found)

    of_size = ranks(size)
    spread = max(float(np.sum(of_size**2)), 1.0)
    found = [abs(float(ranks(rows[name]) @ of_size)) / spread for name in input_names(mechanism, path)]
    return np.where(high > low, found, np.nan)


def _ends(mechanism: AnyMechanism, path: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nominal value, low end and high end of each entry of an input."""
    points = np.repeat(np.array(ENDS)[:, None], sum(dimensions(mechanism).values()), axis=1)
    low, high = quantiles(mechanism, points)[path].reshape(2, -1)
    nominal = value_at(mechanism, path) if path != PHASE else np.zeros(len(low))
    return np.broadcast_to(np.ravel(nominal), low.shape).astype(float), low, high


def _per_contact(mechanism: AnyMechanism, path: str) -> Input:
    """Every contact has its own entry of a list of them."""
    names, (_, low, high) = input_names(mechanism, path), _ends(mechanism, path)
    contacts = range(len(slots(mechanism)))
    listed = path == PHASE or (path in ("contact.stiffness", "contact.damping") and _is_list(mechanism, path))
    if listed and isinstance(mechanism, Mechanism):
        used = [min(contact, len(names) - 1) for contact in contacts]
        factor, unit = UNITS.get(unit_of(mechanism, path), (1.0, unit_of(mechanism, path)))
        low, high = factor * np.min(low[used]), factor * np.max(high[used])
        columns = tuple(names[place] for place in used)
        name = NAMES.get(path, path)
        return Input(name, unit, columns, factor, low, high, _logarithmic(mechanism, path, low, high))
    one = _per_scenario(mechanism, path, 0)
    return one._replace(columns=one.columns * len(contacts))


def _per_scenario(mechanism: AnyMechanism, path: str, entry: int) -> Input:
    """An entry of a list stands for all where they are drawn as one, as a share of its nominal value."""
    names, (nominal, low, high) = input_names(mechanism, path), _ends(mechanism, path)
    name = NAMES.get(path, path)
    factor, unit = UNITS.get(unit_of(mechanism, path), (1.0, unit_of(mechanism, path)))
    if len(names) > 1:
        together = path != PHASE and not mechanism.uncertainty[path].independent
        if together and nominal[entry]:
            name, factor, unit = f"{name} over nominal", 1 / nominal[entry], "1"
        else:
            name = f"{name}, entry {entry + 1}" if path != PHASE else f"{name} of contact {entry + 1}"
    low, high = sorted((factor * low[entry], factor * high[entry]))
    return Input(name, unit, (names[entry],), factor, low, high, _logarithmic(mechanism, path, low, high))


def _logarithmic(mechanism: AnyMechanism, path: str, low: float, high: float) -> bool:
    drawn = mechanism.uncertainty.get(path)
    return low > 0 and ((drawn is not None and drawn.distribution == "loguniform") or high > 5 * low)


def _is_list(mechanism: AnyMechanism, path: str) -> bool:
    return np.ndim(value_at(mechanism, path)) == 1
