"""JSON files of a sweep's studies in the sweep's store.

    DIR/studies/drivers-1024.json, rare-0.04-10x1000.json, ...

The sweep's manifest and a few arguments determine a study's result to the last bit. The file of a study
(`schema = "jaxhil/study/1"`) holds these arguments, the manifest's digest, the result and a digest of its own
content. A file that is damaged or from another sweep is ignored, so that the study runs again. JSON cannot
store infinity and NaN. A field can have at most one of these two values, which is stored as null.
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np

from jaxhil.files import make_folder, open_regular, report_write_errors, write_atomically
from jaxhil.rig import digest
from tuning.statistics.subset_simulation import SubsetSimulation
from tuning.sweeps.manifest import MAX_FILE_BYTES, Manifest
from tuning.sweeps.store import STUDY_FOLDER, SweepStore
from tuning.sweeps.studies import SUBSET_REPLICATES, SUBSET_SAMPLES, ErrorIndices, InputIndices

STUDY_SCHEMA = "jaxhil/study/1"
# non-finite number that null stands for: by record, or by field if a field differs from its record
NULL_VALUES: dict[Any, float | None] = {
    InputIndices: math.nan,
    ErrorIndices: None,
    SubsetSimulation: math.inf,
}
FIELD_NULL_VALUES = {"thresholds": math.nan}


class IndicesRequest(NamedTuple):
    """Arguments of the study `compute_error_indices`."""

    number: int  # number of base samples, a power of two


class RareFailureRequest(NamedTuple):
    """Arguments of the study `estimate_rare_failure`."""

    limit: float  # limit of the restitution error [1]
    samples: int = SUBSET_SAMPLES  # number of samples per level and replicate
    replicates: int = SUBSET_REPLICATES  # number of independent runs


StudyRequest = IndicesRequest | RareFailureRequest
StudyResult = ErrorIndices | SubsetSimulation


def study_path(store: SweepStore, request: StudyRequest) -> Path:
    """Return the path of the file that stores the study with the arguments `request`."""
    if isinstance(request, IndicesRequest):
        return store.folder / STUDY_FOLDER / f"drivers-{request.number}.json"
    name = f"rare-{float(request.limit)!r}-{request.replicates}x{request.samples}.json"
    return store.folder / STUDY_FOLDER / name


def write_study(store: SweepStore, request: StudyRequest, found: StudyResult) -> None:
    """Write the result of a study to the store; raise `InputError` if writing fails."""
    path = study_path(store, request)
    with report_write_errors(path):
        content = encode_study(store.manifest, request, found)
        make_folder(path.parent)
        write_atomically(path, content)


def read_study(store: SweepStore, request: StudyRequest) -> Any:
    """Read the result of a study; return None if the file is missing, damaged or from another sweep."""
    try:
        with open_regular(study_path(store, request)) as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError:
        return None
    return decode_study(store.manifest, request, content) if len(content) <= MAX_FILE_BYTES else None


def encode_study(manifest: Manifest, request: StudyRequest, found: StudyResult) -> bytes:
    """Encode the result of a study as JSON; raise ValueError if a number is not finite.

    `NULL_VALUES` and `FIELD_NULL_VALUES` list the exceptions, which become null.
    """
    document = {**_describe_study(manifest, request), "result": _convert_to_plain(found, None)}
    document["sha256"] = digest(document)
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("ascii")


def decode_study(manifest: Manifest, request: StudyRequest, content: bytes) -> Any:
    """Decode the result of a study; return None if the file is damaged or from another study."""
    kind = ErrorIndices if isinstance(request, IndicesRequest) else SubsetSimulation
    try:
        document = json.loads(content)
        valid = document.pop("sha256") == digest(document)
        content_of_result = document.pop("result")
        result = _restore_records(kind, content_of_result, None)
        valid = valid and _convert_to_plain(result, None) == content_of_result
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError, msgspec.MsgspecError):
        # A file that another program wrote can raise any of these errors.
        return None
    if not valid or document != _describe_study(manifest, request):
        return None
    return result if isinstance(request, IndicesRequest) or _has_matching_shapes(result, request) else None


def _describe_study(manifest: Manifest, request: StudyRequest) -> dict[str, Any]:
    """Return the entries that identify a study in its file: all entries except the result and the digest."""
    return {
        "schema": STUDY_SCHEMA,
        "study": "drivers" if isinstance(request, IndicesRequest) else "rare",
        "sweep_sha256": manifest.sha256,
        "seed": manifest.seed,
        "versions": manifest.versions,
        **request._asdict(),
    }


def _convert_to_plain(value: Any, null: float | None) -> Any:
    """Convert records to dictionaries, arrays to lists, and the number `null` (infinity or NaN) to None."""
    if hasattr(value, "_fields"):
        null = NULL_VALUES[type(value)]
        return {
            name: _convert_to_plain(field, FIELD_NULL_VALUES.get(name, null))
            for name, field in value._asdict().items()
        }
    if isinstance(value, (tuple, list)):
        return [_convert_to_plain(element, null) for element in value]
    if isinstance(value, np.ndarray):
        return _convert_to_plain(value.tolist(), null)
    if isinstance(value, float) and (value == null or (math.isnan(value) and null is math.nan)):
        return None
    return value


def _restore_records(kind: Any, value: Any, null: float | None) -> Any:
    """Convert plain data to type `kind`, and None to `null`; raise ValueError or TypeError on a mismatch."""
    if hasattr(kind, "_fields"):
        hints, null = get_type_hints(kind), NULL_VALUES[kind]
        if value.keys() != hints.keys():
            raise ValueError(f"found the fields {sorted(value)}, expected {sorted(hints)}")
        return kind(
            **{
                name: _restore_records(hints[name], value[name], FIELD_NULL_VALUES.get(name, null))
                for name in hints
            }
        )
    if kind is np.ndarray:
        array = np.array(value, float)
        array[np.isnan(array)] = null
        return array
    if element := get_args(kind):
        return tuple(_restore_records(element[0], item, null) for item in value)
    return msgspec.convert(null if value is None else value, kind)


def _has_matching_shapes(rare: SubsetSimulation, request: RareFailureRequest) -> bool:
    shape = (request.replicates,)
    fits = rare.estimates.shape == rare.formula_coefficients.shape == rare.thresholds.shape[1:] == shape
    return fits and rare.worst_points.ndim == 2 and rare.worst_points.shape[:1] == rare.worst_values.shape
