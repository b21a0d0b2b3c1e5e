"""Manifest of a sweep: a JSON file with all inputs that determine the rows (`schema = "jaxhil/sweep/2"`).

The manifest is written before the sweep starts, and identifies the store. Every chunk file holds the
manifest's digest, so that chunks of other sweeps are detected.
"""

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.files import open_regular
from jaxhil.laws.compensators import axes_of, get_compensator
from jaxhil.rig import digest
from jaxhil.simulation.gain_file import LoadedGains, check_document
from jaxhil.simulation.jax_environment import active_xla_flags, rounding_flags
from jaxhil.simulation.source_fingerprint import dependency_versions, sources_sha256
from tuning.sweeps import MAX_CHUNK_SIZE, MAX_SCENARIOS, MAX_SEED
from tuning.sweeps.columns import Column, list_sweep_columns
from tuning.sweeps.draws import SOBOL_REPLICATES

MANIFEST_SCHEMA = "jaxhil/sweep/2"
MANIFEST_FILE = "manifest.json"
DEFAULT_CHUNK_SIZE = 16384  # default number of scenarios per chunk
MAX_FILE_BYTES = 8 * 1024 * 1024  # largest size of a manifest or study file [bytes]
COLUMN_DIFFERENCE = "columns: found other columns than this version writes"
Sha256Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Content of a sweep's manifest file: all inputs that determine the rows."""

    schema: Literal["jaxhil/sweep/2"]
    # number of scenarios; with `until_width`, the largest number
    scenarios: Annotated[int, Meta(ge=1, le=MAX_SCENARIOS)]
    chunk: Annotated[int, Meta(ge=1, le=MAX_CHUNK_SIZE)]  # number of scenarios per chunk
    seed: Annotated[int, Meta(ge=0, le=MAX_SEED)]
    sampling: Literal["random", "sobol"]
    replicates: Annotated[int, Meta(ge=1)]  # number of Sobol sequences; 1 for random sampling
    precision: Literal["float64", "float32"]
    limit: Annotated[float, Meta(ge=0)] | None  # limit of the restitution error [1]; None: no limit
    works: bool  # whether mechanical works are computed
    columns: list[Column]
    gains_sha256: Sha256Digest  # digest of the gain file
    mechanism_sha256: Sha256Digest  # digest of the mechanism file for which the gains were tuned
    gain_file: dict[str, Any]  # content of the gain file
    sources_sha256: Sha256Digest  # digest of the source code that computes the rows
    versions: dict[str, str]  # versions of the packages that compute the rows
    xla_flags: str  # compiler flags that can change the last bits
    created: str  # date and time in UTC
    sha256: Sha256Digest  # digest of the manifest without the date
    # the sweep ends when the confidence interval of the failure probability is at most this wide [1]
    until_width: Annotated[float, Meta(gt=0, le=1)] | None = None

    @property
    def parts(self) -> int:
        """Return the number of chunks; all chunks but the last have `chunk` rows."""
        return -(-self.scenarios // self.chunk)

    @property
    def error_limit(self) -> float:
        """Return the limit of the restitution error [1], infinite if the manifest has no limit."""
        return math.inf if self.limit is None else self.limit

    @property
    def axes(self) -> int:
        return self.gain_file.get("axes", 1)

    def chunk_range(self, part: int) -> tuple[int, int]:
        """Return the first index and the number of the scenarios in chunk number `part`."""
        first = part * self.chunk
        return first, min(self.chunk, self.scenarios - first)


class ManifestOptions(NamedTuple):
    """Options of a requested sweep; the fields are described in `Manifest`."""

    scenarios: int
    seed: int = 0
    sampling: str = "random"
    precision: str = "float64"
    limit: float = 0.01
    works: bool = False
    chunk: int = DEFAULT_CHUNK_SIZE
    until_width: float | None = None


def build_manifest(loaded: LoadedGains, choices: ManifestOptions) -> Manifest:
    """Build the manifest of a sweep from a loaded gain file; raise `InputError` if an option is invalid."""
    if choices.sampling == "sobol" and choices.scenarios < SOBOL_REPLICATES:
        allowed = f"{SOBOL_REPLICATES} or more: one for each replicate of sobol sampling"
        raise InputError(f"--scenarios: found {choices.scenarios}, expected {allowed}")
    document = {
        "schema": MANIFEST_SCHEMA,
        **choices._asdict(),
        "limit": float(choices.limit) if math.isfinite(choices.limit) else None,
        "replicates": SOBOL_REPLICATES if choices.sampling == "sobol" else 1,
        "columns": msgspec.to_builtins(list_sweep_columns(loaded.mechanism, choices.works)),
        "gains_sha256": loaded.document["sha256"],
        "mechanism_sha256": loaded.document["mechanism_sha256"],
        "gain_file": loaded.document,
        "sources_sha256": _compute_sources_digest(loaded),
        "versions": dependency_versions(),
        "xla_flags": rounding_flags(active_xla_flags()),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    if choices.until_width is None:
        del document["until_width"]
    return _convert_document({**document, "sha256": digest(document)}, "sweep")


def encode_manifest(manifest: Manifest) -> bytes:
    """Encode the manifest as the content of its JSON file."""
    document = msgspec.to_builtins(manifest)
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("ascii")


def decode_manifest(content: bytes, source: str) -> Manifest:
    """Parse the content of the manifest file `source`; raise `InputError` if it is invalid."""
    try:
        document = json.loads(content.decode("utf-8"), parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source}: not valid JSON: {to_one_line(str(error), 100)}") from None
    if not isinstance(document, dict):
        raise InputError(
            f"{source}: found {format_value(document)}, expected a JSON object, {MANIFEST_SCHEMA}"
        )
    return _convert_document(document, source)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of the store in `folder`; raise `InputError` if it is missing or invalid."""
    path = folder / MANIFEST_FILE
    source = to_one_line(str(path))
    try:
        with open_regular(path) as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except FileNotFoundError:
        raise InputError(
            f"{source}: found no such file, expected a folder that `jaxhil sweep` wrote"
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{source}: cannot be read: {to_one_line(reason, 100)}") from None
    if len(content) > MAX_FILE_BYTES:
        raise InputError(
            f"{source}: found more than {MAX_FILE_BYTES} bytes, expected a manifest, {MANIFEST_SCHEMA}"
        )
    return decode_manifest(content, source)


def load_gains(manifest: Manifest, source: str = "sweep") -> LoadedGains:
    """Load and check the gain file that a manifest contains; raise `InputError` if it is invalid."""
    return check_document(manifest.gain_file, f"{source}: gain_file", any_axes=True)


def list_input_differences(old: Manifest, new: Manifest) -> list[str]:
    """Return differences between the inputs of two manifests, as texts "key: found OLD, requested NEW"."""
    keys = ("gains_sha256", *ManifestOptions._fields, "xla_flags")
    values = ((key, getattr(old, key), getattr(new, key)) for key in keys)
    return [
        f"{key}: found {_shorten(before)}, requested {_shorten(now)}"
        for key, before, now in values
        if before != now
    ]


def list_code_differences(old: Manifest, new: Manifest) -> list[str]:
    """Return the differences in the code that computes the rows, as texts "key: found OLD, here NEW"."""
    changes = _list_version_differences(old, new.sources_sha256, new.versions)
    return changes + ([COLUMN_DIFFERENCE] if old.columns != new.columns else [])


def list_process_differences(manifest: Manifest) -> list[str]:
    """Return the differences in code and compiler flags between this process and the manifest, as texts."""
    flags = rounding_flags(active_xla_flags())
    loaded = load_gains(manifest)
    changes = _list_version_differences(manifest, _compute_sources_digest(loaded), dependency_versions())
    if flags != manifest.xla_flags:
        changes.append(f"xla_flags: found {_shorten(manifest.xla_flags)}, here {_shorten(flags)}")
    if manifest.columns != list_sweep_columns(loaded.mechanism, manifest.works):
        changes.append(COLUMN_DIFFERENCE)
    return changes


def _compute_sources_digest(loaded: LoadedGains) -> str:
    law = get_compensator(loaded.compensator, axes_of(loaded.mechanism))
    contact = loaded.mechanism.contact
    contacts = contact.values() if isinstance(contact, dict) else [contact]
    return sources_sha256(law, *(find_contact_law(c.law) for c in contacts))


def _list_version_differences(manifest: Manifest, sources: str, here: Mapping[str, str]) -> list[str]:
    old = {"sources_sha256": manifest.sources_sha256, **_prefix_versions(manifest.versions)}
    new = {"sources_sha256": sources, **_prefix_versions(here)}
    return [
        f"{key}: found {_shorten(old.get(key))}, here {_shorten(new.get(key))}"
        for key in sorted(old.keys() | new.keys())
        if old.get(key) != new.get(key)
    ]


def _prefix_versions(packages: Mapping[str, str]) -> dict[str, str]:
    return {f"versions.{name}": number for name, number in packages.items()}


def _convert_document(document: Mapping[str, Any], source: str) -> Manifest:
    schema = document.get("schema")
    if isinstance(schema, str) and schema.startswith("jaxhil/sweep/") and schema != MANIFEST_SCHEMA:
        allowed = f"{MANIFEST_SCHEMA}: sweep again into a new folder, or use the version that made it"
        raise InputError(f"{source}: schema: found {format_value(schema)}, expected {allowed}")
    try:
        manifest = msgspec.convert(document, Manifest)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{source}: {to_one_line(str(error), 160)}") from None
    try:
        computed = digest(document)
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{source}: {to_one_line(str(error), 160)}") from None
    if computed != manifest.sha256:
        raise InputError(f"{source}: sha256: found {manifest.sha256[:12]}..., expected {computed[:12]}...")
    if manifest.until_width is not None and manifest.sampling != "random":
        raise InputError(f"{source}: until_width: found sampling {manifest.sampling}, expected random")
    for key, inner in (("gains_sha256", "sha256"), ("mechanism_sha256", "mechanism_sha256")):
        if manifest.gain_file.get(inner) != getattr(manifest, key):
            allowed = f"{_shorten(manifest.gain_file.get(inner))}, as in gain_file"
            raise InputError(f"{source}: {key}: found {_shorten(getattr(manifest, key))}, expected {allowed}")
    return manifest


def _shorten(value: Any) -> str:
    return f"{value[:12]}..." if isinstance(value, str) and len(value) > 24 else format_value(value)


def _reject_constant(name: str) -> None:
    raise ValueError(f"found {name}")
