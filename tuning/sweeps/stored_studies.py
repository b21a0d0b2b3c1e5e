"""Files of a sweep's studies in its store, as JSON that is read back exactly to the bit.

    DIR/studies/drivers-1024.json, rare-0.04-10x1000.json, ...

The sweep's manifest and a few arguments determine a study to the bit. Its file (`schema = "jaxhil/study/1"`)
holds both and a digest of its content. A file that is damaged or of another sweep is ignored, and the study
can be run again. JSON has no non-finite numbers; null stands for the only one that a field can have.
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import msgspec
import numpy as np

from jaxhil.files import make_folder, open_plain, write_whole, writing
from jaxhil.rig import digest
from tuning.statistics.subset_simulation import SubsetSimulation
from tuning.sweeps.manifest import LARGEST, Manifest
from tuning.sweeps.store import STUDIES, Store
from tuning.sweeps.studies import REPLICATES, SAMPLES, ErrorIndices, InputIndices

SCHEMA = "jaxhil/study/1"
# Value of null in the numbers of a record, and in fields that differ from their record.
NULLS: dict[Any, float | None] = {InputIndices: math.nan, ErrorIndices: None, SubsetSimulation: math.inf}
FIELD_NULLS = {"thresholds": math.nan}


class IndicesRequest(NamedTuple):
    """Arguments of `tuning.sweeps.studies.error_indices`."""

    number: int


class RareRequest(NamedTuple):
    """Arguments of `tuning.sweeps.studies.rare_failure`."""

    limit: float  # limit of the restitution error [1]
    samples: int = SAMPLES  # samples per level and replicate
    replicates: int = REPLICATES  # number of independent runs


Request = IndicesRequest | RareRequest
Found = ErrorIndices | SubsetSimulation


def study_path(store: Store, request: Request) -> Path:
    """Return the path of the file of a study with these arguments."""
    if isinstance(request, IndicesRequest):
        return store.folder / STUDIES / f"drivers-{request.number}.json"
    name = f"rare-{float(request.limit)!r}-{request.replicates}x{request.samples}.json"
    return store.folder / STUDIES / name


def write_study(store: Store, request: Request, found: Found) -> None:
    """Write the result of a study; raise `InputError` if it cannot be written."""
    path = study_path(store, request)
    with writing(path):
        content = encode(store.manifest, request, found)
        make_folder(path.parent)
        write_whole(path, content)


def read_study(store: Store, request: Request) -> Any:
    """Read the result of a study; return None if it is missing, damaged, or of another sweep."""
    try:
        with open_plain(study_path(store, request)) as file:
            content = file.read(LARGEST + 1)
    except OSError:
        return None
    return decode(store.manifest, request, content) if len(content) <= LARGEST else None


def encode(manifest: Manifest, request: Request, found: Found) -> bytes:
    """Return the content of a study's file; raise ValueError for values that JSON lacks."""
    document = {**_label(manifest, request), "result": _plain(found, None)}
    document["sha256"] = digest(document)
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("ascii")


def decode(manifest: Manifest, request: Request, content: bytes) -> Any:
    """Return the result that `encode` encoded; None if the content is damaged or of another study."""
    kind = ErrorIndices if isinstance(request, IndicesRequest) else SubsetSimulation
    try:
        document = json.loads(content)
        valid = document.pop("sha256") == digest(document)
        content_of_result = document.pop("result")
        result = _restored(kind, content_of_result, None)
        valid = valid and _plain(result, None) == content_of_result
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError, msgspec.MsgspecError):
        # A file of another program can be wrong in any way.
        return None
    if not valid or document != _label(manifest, request):
        return None
    return result if isinstance(request, IndicesRequest) or _fits(result, request) else None


def _label(manifest: Manifest, request: Request) -> dict[str, Any]:
    """Return the entries of a study's file besides its result and the digest."""
    return {
        "schema": SCHEMA,
        "study": "drivers" if isinstance(request, IndicesRequest) else "rare",
        "sweep_sha256": manifest.sha256,
        "seed": manifest.seed,
        "versions": manifest.versions,
        **request._asdict(),
    }


def _plain(value: Any, null: float | None) -> Any:
    """Convert records to mappings, arrays to lists, and the non-finite number `null` to None."""
    if hasattr(value, "_fields"):
        null = NULLS[type(value)]
        return {name: _plain(field, FIELD_NULLS.get(name, null)) for name, field in value._asdict().items()}
    if isinstance(value, (tuple, list)):
        return [_plain(element, null) for element in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), null)
    if isinstance(value, float) and (value == null or (math.isnan(value) and null is math.nan)):
        return None
    return value


def _restored(kind: Any, value: Any, null: float | None) -> Any:
    """Convert the result of `_plain` back to a `kind`; raise ValueError or TypeError if it does not fit."""
    if hasattr(kind, "_fields"):
        hints, null = get_type_hints(kind), NULLS[kind]
        if value.keys() != hints.keys():
            raise ValueError("other fields")
        return kind(
            **{name: _restored(hints[name], value[name], FIELD_NULLS.get(name, null)) for name in hints}
        )
    if kind is np.ndarray:
        array = np.array(value, float)
        array[np.isnan(array)] = null
        return array
    if element := get_args(kind):
        return tuple(_restored(element[0], item, null) for item in value)
    return msgspec.convert(null if value is None else value, kind)


def _fits(rare: SubsetSimulation, request: RareRequest) -> bool:
    """Return whether the shapes of the result's arrays agree with the request and with each other."""
    shape = (request.replicates,)
    fits = rare.estimates.shape == rare.formula_coefficients.shape == rare.thresholds.shape[1:] == shape
    return fits and rare.worst_points.ndim == 2 and rare.worst_points.shape[:1] == rare.worst_values.shape
