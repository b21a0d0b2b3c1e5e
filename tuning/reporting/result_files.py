"""Reading of commands' results for a report: recognition, check of digests, and check of consistency."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import open_regular
from jaxhil.rig import digest
from jaxhil.simulation.gain_file import LoadedGains, check_document
from tuning.bundle import selftest
from tuning.reporting.documents import (
    ComparisonDocument,
    IdentificationDocument,
    MapDocument,
    MonitoringDocument,
    SweepVerdict,
    Theory,
)
from tuning.sweeps.manifest import load_gains
from tuning.sweeps.store import VERDICT_FILE, SweepStore, read_store

MAX_DOCUMENT_BYTES = 200_000_000  # size of the largest file that is read [bytes]
DOCUMENT_NAMES = ("manifest.json", "gains.json", "identification.json", "compare.json", "map.json")
ALLOWED_RESULTS = (
    "a result of jaxhil identify, tune, sweep, compare, map or export (the folder, or the JSON file in it), "
    "or the output of jaxhil monitor --json"
)
GAINS_SCHEMA, SWEEP_SCHEMA, BUNDLE_SCHEMA = "jaxhil/gains/", "jaxhil/sweep/", "jaxhil/bundle/"
IDENTIFICATION_SCHEMA, MONITOR_SCHEMA, MAP_SCHEMA = "jaxhil/identification/", "jaxhil/monitor/", "jaxhil/map/"
Kind = TypeVar("Kind")


class ResultSource(NamedTuple):
    """Origin of a result in a report."""

    command: str  # command that wrote the result
    path: Path
    sha256: str  # SHA-256 digest of the content


@dataclass
class Results:
    """All results for a report, at most one of each kind; None for kinds that are not given."""

    gains: LoadedGains | None = None  # a gain file
    store: SweepStore | None = None  # rows of a sweep
    sweep: SweepVerdict | None = None  # verdict of the same sweep
    bundle: LoadedGains | None = None  # gain file of a bundle, with its limits
    identification: IdentificationDocument | None = None
    identified: dict[str, Any] = field(default_factory=dict)  # content of the identified mechanism file
    monitoring: MonitoringDocument | None = None
    comparison: ComparisonDocument | None = None
    map: MapDocument | None = None
    sources: list[ResultSource] = field(default_factory=list)

    @property
    def subject(self) -> LoadedGains | None:
        """Return the gains that the report evaluates, or None if no result contains gains."""
        if self.bundle is not None or self.gains is not None:
            return self.bundle or self.gains
        return None if self.store is None else load_gains(self.store.manifest)

    @property
    def axes(self) -> int:
        """Return the number of axes of the evaluated mechanism, 1 or 6."""
        return 6 if self.subject is not None and self.subject.document.get("axes") == 6 else 1

    @property
    def error(self) -> str:
        """Return the symbol of the error for texts: |e - e*| for one axis, |error| for six axes."""
        return "|error|" if self.axes == 6 else "|e - e*|"


def read_results(paths: list[Path]) -> Results:
    """Read and check the results at the given paths.

    Raise `InputError` if a path contains no result, if a result was changed after it was written, if two
    results have the same kind, or if results belong to different mechanisms or gains.
    """
    results = Results()
    for path in paths:
        _add_result(results, path)
    _check_consistency(results)
    return results


def _add_result(results: Results, source: Path) -> None:
    """Read and check the result at a path, and store it in `results`; raise `InputError` if it is invalid."""
    where, path = to_one_line(str(source)), _document_path(source)
    document = _read_json(path, where)
    schema = document.get("schema")
    schema = schema if isinstance(schema, str) else ""
    if schema.startswith(SWEEP_SCHEMA) or path.name == VERDICT_FILE:
        store = read_store(path.parent)
        verdict = _read_json(path.parent / VERDICT_FILE, where)
        _check_digest(verdict, where)
        _store_result(results, "store", store, where)
        _store_result(results, "sweep", _convert_document(verdict, SweepVerdict, where), where)
        _check_sweep(store, verdict, where)
        results.sources.append(ResultSource("sweep", path.parent, verdict["sha256"]))
    elif schema.startswith(BUNDLE_SCHEMA):
        _store_result(results, "bundle", _read_bundle_gains(path.parent, where), where)
        manifest = hashlib.sha256(path.read_bytes()).hexdigest()
        results.sources.append(ResultSource("export", path.parent, manifest))
    elif schema.startswith(GAINS_SCHEMA):
        _store_result(results, "gains", check_document(document, where, any_axes=True), where)
        results.sources.append(ResultSource("tune", path, document["sha256"]))
    elif schema.startswith(IDENTIFICATION_SCHEMA):
        _check_digest(document, where)
        _store_result(
            results, "identification", _convert_document(document, IdentificationDocument, where), where
        )
        results.identified = dict(document.get("mechanism") or {})
        results.sources.append(ResultSource("identify", path, document["sha256"]))
    elif schema.startswith(MONITOR_SCHEMA):
        _check_digest(document, where)
        _store_result(results, "monitoring", _convert_document(document, MonitoringDocument, where), where)
        results.sources.append(ResultSource("monitor", path, document["sha256"]))
    elif schema.startswith(MAP_SCHEMA):
        _check_digest(document, where)
        _store_result(results, "map", _convert_document(document, MapDocument, where), where)
        _check_map(_convert_document(document, MapDocument, where), where)
        results.sources.append(ResultSource("map", path, document["sha256"]))
    elif path.name == "compare.json" or {"judged", "mechanisms"} <= document.keys():
        _check_digest(document, where)
        _store_result(results, "comparison", _convert_document(document, ComparisonDocument, where), where)
        results.sources.append(ResultSource("compare", path, document["sha256"]))
    else:
        problem = f"the schema {format_value(schema)}" if schema else "no schema of jaxhil"
        raise InputError(f"{where}: found {problem}, expected {ALLOWED_RESULTS}")


def _document_path(source: Path) -> Path:
    """Return the path of the JSON document: `source` itself or, if it is a folder, the document in it."""
    try:
        if not source.is_dir():
            return source
        names = set(os.listdir(source))
    except (OSError, ValueError) as error:
        reason = to_one_line(getattr(error, "strerror", None) or str(error), 100)
        raise InputError(f"{to_one_line(str(source))}: cannot be read: {reason}") from None
    for name in DOCUMENT_NAMES:
        if name in names:
            return source / name
    raise InputError(f"{to_one_line(str(source))}: found no result, expected {ALLOWED_RESULTS}")


def _read_json(path: Path, where: str) -> dict[str, Any]:
    """Read a JSON object from a file; raise `InputError` if the file is unreadable or has no JSON object."""
    try:
        with open_regular(path) as file:
            content = file.read(MAX_DOCUMENT_BYTES + 1)
    except (OSError, ValueError) as error:
        reason = to_one_line(getattr(error, "strerror", None) or str(error), 100)
        unfinished = " (the sweep is not finished)" if path.name == VERDICT_FILE else ""
        raise InputError(f"{to_one_line(str(path))}: cannot be read: {reason}{unfinished}") from None
    if len(content) > MAX_DOCUMENT_BYTES:
        raise InputError(f"{where}: found more than {MAX_DOCUMENT_BYTES} bytes, expected {ALLOWED_RESULTS}")
    try:
        document = json.loads(content, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        raise InputError(f"{where}: found no JSON, expected {ALLOWED_RESULTS}") from None
    if not isinstance(document, dict):
        raise InputError(f"{where}: found no JSON object, expected {ALLOWED_RESULTS}")
    return document


def _reject_constant(name: str) -> None:
    """Raise ValueError for NaN or infinity in a file, because standard JSON does not allow them."""
    raise ValueError(name)


def _check_digest(document: dict[str, Any], where: str) -> None:
    """Raise `InputError` unless a document contains the SHA-256 digest of its own content."""
    stated = document.get("sha256")
    if not isinstance(stated, str):
        raise InputError(f"{where}: sha256: found nothing, expected the digest that its command writes")
    if stated != digest(document):
        raise InputError(
            f"{where}: sha256: found {format_value(stated)}, expected the digest of the content: the file "
            "was changed"
        )


def _convert_document(document: dict[str, Any], kind: type[Kind], where: str) -> Kind:
    """Convert a JSON document to a struct; raise `InputError` if a field is missing or has another type."""
    try:
        return msgspec.convert(document, kind)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(
            f"{where}: found {to_one_line(str(error), 150)}, expected {ALLOWED_RESULTS}"
        ) from None


def _check_sweep(store: SweepStore, verdict: dict[str, Any], where: str) -> None:
    """Raise `InputError` if a verdict belongs to another sweep, or names a scenario that does not exist."""
    if verdict["sweep_sha256"] != store.manifest.sha256:
        raise InputError(
            f"{where}: {VERDICT_FILE}: found the verdict of another sweep, expected the verdict of this sweep"
        )
    for scenario in verdict["worst"]:
        if not 0 <= scenario["index"] < store.manifest.scenarios:
            allowed = f"0 to {store.manifest.scenarios - 1}"
            raise InputError(
                f"{where}: {VERDICT_FILE}: worst: found index {scenario['index']}, expected {allowed}"
            )


def _check_map(document: MapDocument, where: str) -> None:
    """Raise `InputError` unless a map's axes increase and each of its tables has the shape of its axes."""
    radius = document.spectral_radius
    grids: list[tuple[list[float], list[float], Sequence[Sequence[Any]]]]
    grids = [
        (document.x.values, document.y.values, table) for table in (document.error, document.restitution)
    ]
    grids += [(document.x.values, document.y.values, table) for table in _theory_tables(document.theory)]
    if radius.values is not None:
        grids.append((radius.x or [], radius.y or [], radius.values))
    for x, y, table in grids:
        rising = all(a < b for axis in (x, y) for a, b in pairwise(axis))
        if min(len(x), len(y)) < 2 or not rising or [len(row) for row in table] != [len(x)] * len(y):
            raise InputError(
                f"{where}: found a table that does not match its axes, expected {ALLOWED_RESULTS}"
            )


def _theory_tables(theory: Theory) -> list[list[list[float | None]]]:
    """Return the tables of a map's closed-form solutions, without the solutions that do not apply."""
    tables = theory.series, theory.characteristic_root, theory.delay_over_critical
    return [table for table in tables if table is not None]


def _read_bundle_gains(folder: Path, where: str) -> LoadedGains:
    """Return the gain file in a bundle; raise `InputError` if a file of the bundle was changed."""
    files, problems = selftest.find_differences(str(folder))
    for name, text in problems:
        raise InputError(f"{where}: {to_one_line(f'{name}: {text}', 200)}")
    return check_document(json.loads(files["gains.json"]), f"{where}: gains.json", any_axes=True)


def _store_result(results: Results, name: str, value: Any, where: str) -> None:
    """Store a result in the field `name`; raise `InputError` if the field already contains a result."""
    if getattr(results, name) is not None:
        raise InputError(f"{where}: found a second result of the same kind, expected one of each kind")
    setattr(results, name, value)


def _check_consistency(results: Results) -> None:
    """Raise `InputError` unless all results belong to the same gains and mechanism."""
    subject, store = results.subject, results.store
    if subject is None:
        return
    sweep_gains = None if store is None else load_gains(store.manifest)
    for name, gains in (
        ("the gain file", results.gains),
        ("the sweep", sweep_gains),
        ("the bundle", results.bundle),
    ):
        if gains is None:
            continue
        for key in ("compensator", "gains", "mechanism"):
            if getattr(gains, key) != getattr(subject, key):
                raise InputError(
                    f"{name}: {key}: found a value that differs from the other results, expected the same"
                )
    comparison, mechanism = results.comparison, subject.mechanism.name
    if comparison is not None and mechanism not in (entry.mechanism for entry in comparison.mechanisms):
        names = ", ".join(entry.mechanism for entry in comparison.mechanisms)
        allowed = to_one_line(mechanism, 60)
        raise InputError(
            f"the comparison: found the mechanisms {to_one_line(names, 100)}, expected {allowed} among them"
        )
    if results.map is not None and results.map.mechanism != mechanism:
        raise InputError(
            f"the map: found the mechanism {to_one_line(results.map.mechanism, 60)}, "
            f"expected {to_one_line(mechanism, 60)}"
        )
