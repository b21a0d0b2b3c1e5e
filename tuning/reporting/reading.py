"""Results as commands wrote them, each recognised, checked against its digest, and against the others."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import open_plain
from jaxhil.rig import digest
from jaxhil.simulation.gain_file import LoadedGains, check_document
from tuning.bundle import selftest
from tuning.reporting.documents import (
    Comparison,
    Identification,
    MapDocument,
    Monitoring,
    SweepVerdict,
    Theory,
)
from tuning.sweeps.manifest import loaded_gains
from tuning.sweeps.store import VERDICT, Store, read_store

LARGEST = 200_000_000  # bytes of a document
NAMES = ("manifest.json", "gains.json", "identification.json", "compare.json", "map.json")
ALLOWED = (
    "what jaxhil identify, tune, sweep, compare, map or export wrote, its folder or the JSON file in it, or "
    "what monitor --json printed"
)
GAINS, SWEEP, BUNDLE = "jaxhil/gains/", "jaxhil/sweep/", "jaxhil/bundle/"
IDENTIFICATION, MONITOR, MAP = "jaxhil/identification/", "jaxhil/monitor/", "jaxhil/map/"
Kind = TypeVar("Kind")


class Source(NamedTuple):
    """A result that a report is made of."""

    command: str  # that wrote it
    path: Path
    sha256: str  # of its content


@dataclass
class Results:
    """All that was given, one of a kind; None for what was not."""

    gains: LoadedGains | None = None  # a gain file
    store: Store | None = None  # of a sweep
    sweep: SweepVerdict | None = None
    bundle: LoadedGains | None = None  # the gain file of a bundle, with its limits
    identification: Identification | None = None
    identified: dict[str, Any] = field(default_factory=dict)  # the mechanism that was identified
    monitoring: Monitoring | None = None
    comparison: Comparison | None = None
    map: MapDocument | None = None
    sources: list[Source] = field(default_factory=list)

    @property
    def subject(self) -> LoadedGains | None:
        """The gains that the report is about, if there are any."""
        if self.bundle is not None or self.gains is not None:
            return self.bundle or self.gains
        return None if self.store is None else loaded_gains(self.store.manifest)

    @property
    def axes(self) -> int:
        """How many axes what the report is about has, 1 or 6."""
        return 6 if self.subject is not None and self.subject.document.get("axes") == 6 else 1

    @property
    def error(self) -> str:
        """The sign of an error: that of the restitution, or either of six axes."""
        return "|error|" if self.axes == 6 else "|e - e*|"


def read_results(paths: list[Path]) -> Results:
    """The results at these paths. Raises `InputError`, one line, for what is none, was changed since it was
    written, is there twice, or belongs to something else than the others."""
    results = Results()
    for path in paths:
        _add(results, path)
    _check_together(results)
    return results


def _add(results: Results, given: Path) -> None:
    where, path = one_line(str(given)), _document_path(given)
    document = _read(path, where)
    schema = document.get("schema")
    schema = schema if isinstance(schema, str) else ""
    if schema.startswith(SWEEP) or path.name == VERDICT:
        store = read_store(path.parent)
        verdict = _read(path.parent / VERDICT, where)
        _check_digest(verdict, where)
        _set(results, "store", store, where)
        _set(results, "sweep", _typed(verdict, SweepVerdict, where), where)
        _check_sweep(store, verdict, where)
        results.sources.append(Source("sweep", path.parent, verdict["sha256"]))
    elif schema.startswith(BUNDLE):
        _set(results, "bundle", _bundle(path.parent, where), where)
        manifest = hashlib.sha256(path.read_bytes()).hexdigest()
        results.sources.append(Source("export", path.parent, manifest))
    elif schema.startswith(GAINS):
        _set(results, "gains", check_document(document, where, any_axes=True), where)
        results.sources.append(Source("tune", path, document["sha256"]))
    elif schema.startswith(IDENTIFICATION):
        _check_digest(document, where)
        _set(results, "identification", _typed(document, Identification, where), where)
        results.identified = dict(document.get("mechanism") or {})
        results.sources.append(Source("identify", path, document["sha256"]))
    elif schema.startswith(MONITOR):
        _check_digest(document, where)
        _set(results, "monitoring", _typed(document, Monitoring, where), where)
        results.sources.append(Source("monitor", path, document["sha256"]))
    elif schema.startswith(MAP):
        _check_digest(document, where)
        _set(results, "map", _typed(document, MapDocument, where), where)
        _check_map(_typed(document, MapDocument, where), where)
        results.sources.append(Source("map", path, document["sha256"]))
    elif path.name == "compare.json" or {"judged", "mechanisms"} <= document.keys():
        _check_digest(document, where)
        _set(results, "comparison", _typed(document, Comparison, where), where)
        results.sources.append(Source("compare", path, document["sha256"]))
    else:
        found = f"the schema {shown(schema)}" if schema else "no schema of jaxhil"
        raise InputError(f"{where}: found {found}, allowed {ALLOWED}")


def _document_path(given: Path) -> Path:
    """The document that a path means."""
    try:
        if not given.is_dir():
            return given
        there = set(os.listdir(given))
    except (OSError, ValueError) as error:
        reason = one_line(getattr(error, "strerror", None) or str(error), 100)
        raise InputError(f"{one_line(str(given))}: cannot be read: {reason}") from None
    for name in NAMES:
        if name in there:
            return given / name
    raise InputError(f"{one_line(str(given))}: found no result, allowed {ALLOWED}")


def _read(path: Path, where: str) -> dict[str, Any]:
    try:
        with open_plain(path) as file:
            content = file.read(LARGEST + 1)
    except (OSError, ValueError) as error:
        reason = one_line(getattr(error, "strerror", None) or str(error), 100)
        unfinished = " (the sweep is not finished)" if path.name == VERDICT else ""
        raise InputError(f"{one_line(str(path))}: cannot be read: {reason}{unfinished}") from None
    if len(content) > LARGEST:
        raise InputError(f"{where}: found more than {LARGEST} bytes, allowed {ALLOWED}")
    try:
        document = json.loads(content, parse_constant=_no_constant)
    except (ValueError, RecursionError):
        raise InputError(f"{where}: found no JSON, allowed {ALLOWED}") from None
    if not isinstance(document, dict):
        raise InputError(f"{where}: found no JSON object, allowed {ALLOWED}")
    return document


def _no_constant(name: str) -> None:
    raise ValueError(name)


def _check_digest(document: dict[str, Any], where: str) -> None:
    found = document.get("sha256")
    if not isinstance(found, str):
        raise InputError(f"{where}: sha256: found nothing, allowed the digest that its command writes")
    if found != digest(document):
        raise InputError(
            f"{where}: sha256: found {shown(found)}, allowed that of the content: it was changed"
        )


def _typed(document: dict[str, Any], kind: type[Kind], where: str) -> Kind:
    try:
        return msgspec.convert(document, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{where}: found {one_line(str(error), 150)}, allowed {ALLOWED}") from None


def _check_sweep(store: Store, verdict: dict[str, Any], where: str) -> None:
    """The verdict is that of the store."""
    if verdict["sweep_sha256"] != store.manifest.sha256:
        raise InputError(f"{where}: {VERDICT}: found the verdict of another sweep, allowed its own")
    for one in verdict["worst"]:
        if not 0 <= one["index"] < store.manifest.scenarios:
            allowed = f"0 to {store.manifest.scenarios - 1}"
            raise InputError(f"{where}: {VERDICT}: worst: found index {one['index']}, allowed {allowed}")


def _check_map(found: MapDocument, where: str) -> None:
    """Every table has the shape of its axes, and these go up."""
    radius = found.spectral_radius
    grids: list[tuple[list[float], list[float], Sequence[Sequence[Any]]]]
    grids = [(found.x.values, found.y.values, table) for table in (found.error, found.restitution)]
    grids += [(found.x.values, found.y.values, table) for table in _tables(found.theory)]
    if radius.values is not None:
        grids.append((radius.x or [], radius.y or [], radius.values))
    for x, y, table in grids:
        rising = all(a < b for axis in (x, y) for a, b in pairwise(axis))
        if min(len(x), len(y)) < 2 or not rising or [len(row) for row in table] != [len(x)] * len(y):
            raise InputError(f"{where}: found tables that do not fit their axes, allowed {ALLOWED}")


def _tables(theory: Theory) -> list[list[list[float | None]]]:
    all_of_them = theory.series, theory.characteristic_root, theory.delay_over_critical
    return [table for table in all_of_them if table is not None]


def _bundle(folder: Path, where: str) -> LoadedGains:
    """The gain file of a bundle that is as it was exported, byte for byte."""
    files, problems = selftest.differences(str(folder))
    for name, text in problems:
        raise InputError(f"{where}: {one_line(f'{name}: {text}', 200)}")
    return check_document(json.loads(files["gains.json"]), f"{where}: gains.json")


def _set(results: Results, name: str, value: Any, where: str) -> None:
    if getattr(results, name) is not None:
        raise InputError(f"{where}: found another result of the same kind, allowed one of each kind")
    setattr(results, name, value)


def _check_together(results: Results) -> None:
    """All results are of the same gains and the same mechanism. Raises `InputError`."""
    subject, store = results.subject, results.store
    if subject is None:
        return
    held = None if store is None else loaded_gains(store.manifest)
    for name, other in (
        ("the gain file", results.gains),
        ("the sweep", held),
        ("the bundle", results.bundle),
    ):
        if other is None:
            continue
        own = {one: getattr(other, one) for one in ("compensator", "gains", "mechanism")}
        for what, value in own.items():
            if value != getattr(subject, what):
                raise InputError(f"{name}: found another {what} than that of the other results, allowed one")
    found, mechanism = results.comparison, subject.mechanism.name
    if found is not None and mechanism not in (one.mechanism for one in found.mechanisms):
        names = ", ".join(one.mechanism for one in found.mechanisms)
        allowed = one_line(mechanism, 60)
        raise InputError(f"the comparison: found {one_line(names, 100)}, allowed the mechanism {allowed}")
    if results.map is not None and results.map.mechanism != mechanism:
        raise InputError(
            f"the map: found the mechanism {one_line(results.map.mechanism, 60)}, "
            f"allowed {one_line(mechanism, 60)}"
        )
