"""What a store keeps beside its rows: the verdict, and the studies of its sweep, as JSON.

    DIR/verdict.json
    DIR/studies/drivers-1024.json, rare-0.04-10x1000.json, ...

A study follows to the bit from the sweep's manifest and a few arguments. Its file (`schema =
"jaxhil/study/1"`) names both and carries a digest of its content: one that is damaged, or of another sweep,
is as good as none, and the study can be run again. JSON knows no number that is not finite; null stands for
the only such number that its place can have, and any other cannot be written.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import Meta

from jaxhil.runtime import digest
from tuning.files import write_whole, writing
from tuning.statistics.subset_simulation import SubsetSimulation
from tuning.sweeps import LARGEST_SEED
from tuning.sweeps.manifest import LARGEST, Digest, Manifest
from tuning.sweeps.store import STUDIES, VERDICT, Store
from tuning.sweeps.studies import REPLICATES, SAMPLES, ErrorIndices, InputIndices

SCHEMA = "jaxhil/study/1"
Count = Annotated[int, Meta(ge=0)]


class InputIndicesEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`InputIndices`; None for nan."""

    input: str
    first_order: float | None
    first_order_low: float | None
    first_order_high: float | None
    total: float | None
    total_low: float | None
    total_high: float | None


class ErrorIndicesEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`ErrorIndices`."""

    inputs: list[InputIndicesEntry]
    cap: float
    evaluations: Count
    capped: Count


class SubsetSimulationEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`SubsetSimulation`; None for nan among the thresholds, for an infinite number elsewhere."""

    probability: float
    low: float
    high: float
    coefficient_of_variation: float | None
    formula_coefficient_of_variation: float | None
    estimates: list[float]
    formula_coefficients: list[float | None]
    thresholds: list[list[float | None]]
    evaluations: Count
    worst_points: list[list[float]]
    worst_values: list[float | None]


class Study(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="study"):
    """What every study's file has: the manifest's digest, seed and versions, and the digest of all else."""

    schema: Literal["jaxhil/study/1"]
    sweep_sha256: Digest
    seed: Annotated[int, Meta(ge=0, le=LARGEST_SEED)]
    versions: dict[str, str]
    sha256: Digest


class IndicesStudy(Study, frozen=True, kw_only=True, tag="drivers"):
    """`error_indices`: its argument and what it found."""

    number: Count
    result: ErrorIndicesEntry


class RareStudy(Study, frozen=True, kw_only=True, tag="rare"):
    """`rare_failure`: its arguments and what it found."""

    limit: float
    samples: Count
    replicates: Count
    result: SubsetSimulationEntry


Kind = TypeVar("Kind", IndicesStudy, RareStudy)


def write_verdict(store: Store, text: str) -> None:
    """Write the verdict, whole or not at all. Raises `InputError` when it cannot be written."""
    path = store.folder / VERDICT
    with writing(path):
        write_whole(path, text.encode("ascii"))


def write_indices(store: Store, number: int, found: ErrorIndices) -> None:
    """Write what `error_indices` found. Raises `InputError` when it cannot be written."""
    path = indices_path(store, number)
    with writing(path):
        _write(path, indices_study(store.manifest, number, found))


def read_indices(store: Store, number: int) -> ErrorIndices | None:
    """What `write_indices` wrote; None if it is missing, damaged, or not of this sweep."""
    study = _read(store, indices_path(store, number), IndicesStudy, {"number": number})
    return None if study is None else indices_of(study)


def write_rare(
    store: Store, limit: float, found: SubsetSimulation, samples: int = SAMPLES, replicates: int = REPLICATES
) -> None:
    """Write what `rare_failure` found. Raises `InputError` when it cannot be written."""
    path = rare_path(store, limit, samples, replicates)
    with writing(path):
        _write(path, rare_study(store.manifest, limit, samples, replicates, found))


def read_rare(
    store: Store, limit: float, samples: int = SAMPLES, replicates: int = REPLICATES
) -> SubsetSimulation | None:
    """What `write_rare` wrote; None if it is missing, damaged, or not of this sweep."""
    asked = {"limit": limit, "samples": samples, "replicates": replicates}
    study = _read(store, rare_path(store, limit, samples, replicates), RareStudy, asked)
    return None if study is None else rare_of(study)


def indices_path(store: Store, number: int) -> Path:
    """Where the drivers of so many scenarios per input are kept."""
    return store.folder / STUDIES / f"drivers-{number}.json"


def rare_path(store: Store, limit: float, samples: int = SAMPLES, replicates: int = REPLICATES) -> Path:
    """Where a subset simulation beyond the limit is kept."""
    return store.folder / STUDIES / f"rare-{float(limit)!r}-{replicates}x{samples}.json"


def indices_study(manifest: Manifest, number: int, found: ErrorIndices) -> IndicesStudy:
    """The content of the file, signed. Raises ValueError for what JSON cannot express."""
    inputs = [
        InputIndicesEntry(name, *(None if x != x else x for x in shares)) for name, *shares in found.inputs
    ]
    return _signed(IndicesStudy, manifest, {"number": number}, ErrorIndicesEntry(inputs, *found[1:]))


def indices_of(study: IndicesStudy) -> ErrorIndices:
    """The result that `indices_study` got."""
    result = study.result
    rows = [msgspec.structs.astuple(one) for one in result.inputs]
    inputs = [InputIndices(name, *(math.nan if x is None else x for x in shares)) for name, *shares in rows]
    return ErrorIndices(tuple(inputs), result.cap, result.evaluations, result.capped)


def rare_study(
    manifest: Manifest, limit: float, samples: int, replicates: int, found: SubsetSimulation
) -> RareStudy:
    """The content of the file, signed. Raises ValueError for what JSON cannot express."""
    result = SubsetSimulationEntry(
        found.probability,
        found.low,
        found.high,
        _unless_infinite(found.coefficient_of_variation),
        _unless_infinite(found.formula_coefficient_of_variation),
        found.estimates.tolist(),
        _nulls(found.formula_coefficients, math.inf),
        _nulls(found.thresholds, math.nan),
        found.evaluations,
        found.worst_points.tolist(),
        _nulls(found.worst_values, math.inf),
    )
    asked = {"limit": float(limit), "samples": samples, "replicates": replicates}
    return _signed(RareStudy, manifest, asked, result)


def rare_of(study: RareStudy) -> SubsetSimulation | None:
    """The result that `rare_study` got; None if its arrays have not the shapes that belong together."""
    result = study.result
    try:
        found = SubsetSimulation(
            result.probability,
            result.low,
            result.high,
            _or_infinite(result.coefficient_of_variation),
            _or_infinite(result.formula_coefficient_of_variation),
            np.array(result.estimates, float),
            _array(result.formula_coefficients, math.inf),
            _array(result.thresholds, math.nan),
            result.evaluations,
            np.array(result.worst_points, float),
            _array(result.worst_values, math.inf),
        )
    except ValueError:
        # Rows of unequal length.
        return None
    each = (study.replicates,)
    shaped = found.estimates.shape == found.formula_coefficients.shape == found.thresholds.shape[1:] == each
    worst = found.worst_points.ndim == 2 and found.worst_points.shape[:1] == found.worst_values.shape
    return found if shaped and worst else None


def encode(study: Study) -> bytes:
    """The file's content."""
    return (json.dumps(msgspec.to_builtins(study), indent=1, allow_nan=False) + "\n").encode("ascii")


def decode(content: bytes, kind: type[Kind]) -> Kind | None:
    """The study of that kind in a file's content; None if that is anything else than `encode` made."""
    try:
        study = msgspec.json.decode(content, type=kind)
        found = digest(msgspec.to_builtins(study))
    except (msgspec.DecodeError, ValueError, RecursionError):
        return None
    return study if found == study.sha256 else None


def _write(path: Path, study: Study) -> None:
    path.parent.mkdir(exist_ok=True)
    write_whole(path, encode(study))


def _read(store: Store, path: Path, kind: type[Kind], asked: Mapping[str, Any]) -> Kind | None:
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST + 1)
    except OSError:
        return None
    study = decode(content, kind) if len(content) <= LARGEST else None
    if study is None:
        return None
    wanted = {**_label(store.manifest), **asked}
    return study if all(getattr(study, key) == value for key, value in wanted.items()) else None


def _label(manifest: Manifest) -> dict[str, Any]:
    return {
        "schema": SCHEMA,
        "sweep_sha256": manifest.sha256,
        "seed": manifest.seed,
        "versions": manifest.versions,
    }


def _signed(kind: type[Kind], manifest: Manifest, asked: Mapping[str, Any], result: Any) -> Kind:
    study = kind(**_label(manifest), **asked, result=result, sha256="")
    return msgspec.structs.replace(study, sha256=digest(msgspec.to_builtins(study)))


def _nulls(values: np.ndarray, number: float) -> list[Any]:
    """As lists, with None in the place of `number`, which is not finite."""
    gone = np.isnan(values) if math.isnan(number) else values == number
    plain = values.astype(object)
    plain[gone] = None
    return plain.tolist()


def _array(values: list[Any], number: float) -> np.ndarray:
    """The array that `_nulls` got."""
    array = np.array(values, float)
    return np.where(np.isnan(array), number, array)


def _unless_infinite(value: float) -> float | None:
    return None if value == math.inf else value


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value
