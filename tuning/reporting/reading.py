"""Reading of the results of commands: recognition, check of digests, and consistency of all results."""

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

LARGEST = 200_000_000  # bytes; largest size of a document
NAMES = ("manifest.json", "gains.json", "identification.json", "compare.json", "map.json")
ALLOWED = (
    "what jaxhil identify, tune, sweep, compare, map or export wrote, its folder or the JSON file in it, or "
    "what monitor --json printed"
)
GAINS, SWEEP, BUNDLE = "jaxhil/gains/", "jaxhil/sweep/", "jaxhil/bundle/"
IDENTIFICATION, MONITOR, MAP = "jaxhil/identification/", "jaxhil/monitor/", "jaxhil/map/"
Kind = TypeVar("Kind")


class Source(NamedTuple):
    """Origin of a result in a report."""

    command: str  # command that wrote it
    path: Path
    sha256: str  # SHA-256 of its content


@dataclass
class Results:
    """All given results, at most one of each kind; None for the others."""

    gains: LoadedGains | None = None  # a gain file
    store: Store | None = None  # store of a sweep
    sweep: SweepVerdict | None = None
    bundle: LoadedGains | None = None  # gain file of a bundle, with its limits
    identification: Identification | None = None
    identified: dict[str, Any] = field(default_factory=dict)  # content of the identified mechanism file
    monitoring: Monitoring | None = None
    comparison: Comparison | None = None
    map: MapDocument | None = None
    sources: list[Source] = field(default_factory=list)

    @property
    def subject(self) -> LoadedGains | None:
        """Return the gains that the report is about, or None."""
        if self.bundle is not None or self.gains is not None:
            return self.bundle or self.gains
        return None if self.store is None else loaded_gains(self.store.manifest)

    @property
    def axes(self) -> int:
        """Return the number of axes of the mechanism, 1 or 6."""
        return 6 if self.subject is not None and self.subject.document.get("axes") == 6 else 1

    @property
    def error(self) -> str:
        """Return the symbol of the error: |e - e*| for one axis, |error| for six."""
        return "|error|" if self.axes == 6 else "|e - e*|"


def read_results(paths: list[Path]) -> Results:
    """Read the results at these paths.

    Raise `InputError` if one is no result, was changed after it was written, is there twice, or does not
    belong to the others.
    """
    results = Results()
    for path in paths:
        _add(results, path)
    _check_together(results)
    return results


def _add(results: Results, source: Path) -> None:
    """Read the result at a path, and store it in `results`. Raise `InputError`."""
    where, path = one_line(str(source)), _document_path(source)
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


def _document_path(source: Path) -> Path:
    """Return the path of the document that a path, possibly a folder, stands for."""
    try:
        if not source.is_dir():
            return source
        names = set(os.listdir(source))
    except (OSError, ValueError) as error:
        reason = one_line(getattr(error, "strerror", None) or str(error), 100)
        raise InputError(f"{one_line(str(source))}: cannot be read: {reason}") from None
    for name in NAMES:
        if name in names:
            return source / name
    raise InputError(f"{one_line(str(source))}: found no result, allowed {ALLOWED}")


def _read(path: Path, where: str) -> dict[str, Any]:
    """Read a JSON object from a file. Raise `InputError`."""
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
    """Raise ValueError for NaN or infinity in JSON."""
    raise ValueError(name)


def _check_digest(document: dict[str, Any], where: str) -> None:
    """Raise `InputError` if a document was changed after it was written."""
    stated = document.get("sha256")
    if not isinstance(stated, str):
        raise InputError(f"{where}: sha256: found nothing, allowed the digest that its command writes")
    if stated != digest(document):
        raise InputError(
            f"{where}: sha256: found {shown(stated)}, allowed that of the content: it was changed"
        )


def _typed(document: dict[str, Any], kind: type[Kind], where: str) -> Kind:
    """Convert a document to a struct. Raise `InputError` if it does not fit."""
    try:
        return msgspec.convert(document, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{where}: found {one_line(str(error), 150)}, allowed {ALLOWED}") from None


def _check_sweep(store: Store, verdict: dict[str, Any], where: str) -> None:
    """Raise `InputError` if the verdict does not belong to the store."""
    if verdict["sweep_sha256"] != store.manifest.sha256:
        raise InputError(f"{where}: {VERDICT}: found the verdict of another sweep, allowed its own")
    for scenario in verdict["worst"]:
        if not 0 <= scenario["index"] < store.manifest.scenarios:
            allowed = f"0 to {store.manifest.scenarios - 1}"
            raise InputError(f"{where}: {VERDICT}: worst: found index {scenario['index']}, allowed {allowed}")


def _check_map(document: MapDocument, where: str) -> None:
    """Raise `InputError` unless the axes increase and every table has the shape of its axes."""
    radius = document.spectral_radius
    grids: list[tuple[list[float], list[float], Sequence[Sequence[Any]]]]
    grids = [
        (document.x.values, document.y.values, table) for table in (document.error, document.restitution)
    ]
    grids += [(document.x.values, document.y.values, table) for table in _tables(document.theory)]
    if radius.values is not None:
        grids.append((radius.x or [], radius.y or [], radius.values))
    for x, y, table in grids:
        rising = all(a < b for axis in (x, y) for a, b in pairwise(axis))
        if min(len(x), len(y)) < 2 or not rising or [len(row) for row in table] != [len(x)] * len(y):
            raise InputError(f"{where}: found tables that do not fit their axes, allowed {ALLOWED}")


def _tables(theory: Theory) -> list[list[list[float | None]]]:
    """Return the tables of the closed forms that apply."""
    tables = theory.series, theory.characteristic_root, theory.delay_over_critical
    return [table for table in tables if table is not None]


def _bundle(folder: Path, where: str) -> LoadedGains:
    """Return the gain file of an unchanged bundle. Raise `InputError` for a changed one."""
    files, problems = selftest.differences(str(folder))
    for name, text in problems:
        raise InputError(f"{where}: {one_line(f'{name}: {text}', 200)}")
    return check_document(json.loads(files["gains.json"]), f"{where}: gains.json")


def _set(results: Results, name: str, value: Any, where: str) -> None:
    """Store a result. Raise `InputError` if there is already one of the same kind."""
    if getattr(results, name) is not None:
        raise InputError(f"{where}: found another result of the same kind, allowed one of each kind")
    setattr(results, name, value)


def _check_together(results: Results) -> None:
    """Raise `InputError` unless all results have the same gains and mechanism."""
    subject, store = results.subject, results.store
    if subject is None:
        return
    sweep_gains = None if store is None else loaded_gains(store.manifest)
    for name, gains in (
        ("the gain file", results.gains),
        ("the sweep", sweep_gains),
        ("the bundle", results.bundle),
    ):
        if gains is None:
            continue
        parts = {part: getattr(gains, part) for part in ("compensator", "gains", "mechanism")}
        for part, value in parts.items():
            if value != getattr(subject, part):
                raise InputError(f"{name}: found another {part} than that of the other results, allowed one")
    comparison, mechanism = results.comparison, subject.mechanism.name
    if comparison is not None and mechanism not in (entry.mechanism for entry in comparison.mechanisms):
        names = ", ".join(entry.mechanism for entry in comparison.mechanisms)
        allowed = one_line(mechanism, 60)
        raise InputError(f"the comparison: found {one_line(names, 100)}, allowed the mechanism {allowed}")
    if results.map is not None and results.map.mechanism != mechanism:
        raise InputError(
            f"the map: found the mechanism {one_line(results.map.mechanism, 60)}, "
            f"allowed {one_line(mechanism, 60)}"
        )
