"""Studies of a sweep, kept in its store as JSON: read back to the bit, or not at all.

    DIR/studies/drivers-1024.json, rare-0.04-10x1000.json, ...

A study follows to the bit from the sweep's manifest and a few arguments. Its file (`schema =
"jaxhil/study/1"`) names both and carries a digest of its content: one that is damaged, or of another sweep,
is as good as none, and the study can be run again. JSON knows no number that is not finite; null stands for
the only such number that its place can have, and any other cannot be written.
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
# What null stands for in a record's numbers, and in fields that differ.
NULLS: dict[Any, float | None] = {InputIndices: math.nan, ErrorIndices: None, SubsetSimulation: math.inf}
FIELD_NULLS = {"thresholds": math.nan}


class IndicesRequest(NamedTuple):
    """Arguments of `tuning.sweeps.studies.error_indices`."""

    number: int


class RareRequest(NamedTuple):
    """Arguments of `tuning.sweeps.studies.rare_failure`."""

    limit: float  # of the restitution error
    samples: int = SAMPLES  # per level and replicate
    replicates: int = REPLICATES  # how often it runs


Request = IndicesRequest | RareRequest
Found = ErrorIndices | SubsetSimulation


def study_path(store: Store, request: Request) -> Path:
    """Where the study of such arguments is kept."""
    if isinstance(request, IndicesRequest):
        return store.folder / STUDIES / f"drivers-{request.number}.json"
    name = f"rare-{float(request.limit)!r}-{request.replicates}x{request.samples}.json"
    return store.folder / STUDIES / name


def write_study(store: Store, request: Request, found: Found) -> None:
    """Write what a study found. Raises `InputError` when it cannot be written."""
    path = study_path(store, request)
    with writing(path):
        content = encode(store.manifest, request, found)
        make_folder(path.parent)
        write_whole(path, content)


def read_study(store: Store, request: Request) -> Any:
    """What `write_study` wrote; None if it is missing, damaged, or not of this sweep."""
    try:
        with open_plain(study_path(store, request)) as file:
            content = file.read(LARGEST + 1)
    except OSError:
        return None
    return decode(store.manifest, request, content) if len(content) <= LARGEST else None


def encode(manifest: Manifest, request: Request, found: Found) -> bytes:
    """The file's content. Raises ValueError for what JSON cannot express."""
    document = {**_label(manifest, request), "result": _plain(found, None)}
    document["sha256"] = digest(document)
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("ascii")


def decode(manifest: Manifest, request: Request, content: bytes) -> Any:
    """What `encode` got; None for any other content than it made of the same manifest and request."""
    kind = ErrorIndices if isinstance(request, IndicesRequest) else SubsetSimulation
    try:
        document = json.loads(content)
        signed = document.pop("sha256") == digest(document)
        result = document.pop("result")
        found = _restored(kind, result, None)
        signed = signed and _plain(found, None) == result
    except (LookupError, TypeError, ValueError, AttributeError, RecursionError, msgspec.MsgspecError):
        # A file of another making can be wrong in any way.
        return None
    if not signed or document != _label(manifest, request):
        return None
    return found if isinstance(request, IndicesRequest) or _fits(found, request) else None


def _label(manifest: Manifest, request: Request) -> dict[str, Any]:
    """What a study's file says besides its result and the digest."""
    return {
        "schema": SCHEMA,
        "study": "drivers" if isinstance(request, IndicesRequest) else "rare",
        "sweep_sha256": manifest.sha256,
        "seed": manifest.seed,
        "versions": manifest.versions,
        **request._asdict(),
    }


def _plain(value: Any, null: float | None) -> Any:
    """Records as mappings, arrays as lists, the number that is not finite as None."""
    if hasattr(value, "_fields"):
        null = NULLS[type(value)]
        return {name: _plain(one, FIELD_NULLS.get(name, null)) for name, one in value._asdict().items()}
    if isinstance(value, (tuple, list)):
        return [_plain(one, null) for one in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist(), null)
    if isinstance(value, float) and (value == null or (math.isnan(value) and null is math.nan)):
        return None
    return value


def _restored(kind: Any, value: Any, null: float | None) -> Any:
    """What `_plain` got, of that `kind`. Raises ValueError or TypeError for anything else."""
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
        return tuple(_restored(element[0], one, null) for one in value)
    return msgspec.convert(null if value is None else value, kind)


def _fits(found: SubsetSimulation, request: RareRequest) -> bool:
    """Whether its arrays have the shapes that belong together."""
    each = (request.replicates,)
    shaped = found.estimates.shape == found.formula_coefficients.shape == found.thresholds.shape[1:] == each
    return (
        shaped and found.worst_points.ndim == 2 and found.worst_points.shape[:1] == found.worst_values.shape
    )
