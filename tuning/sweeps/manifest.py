"""Manifest of a sweep: all inputs that determine its rows (`schema = "jaxhil/sweep/2"`), as JSON.

It is written before the sweep and identifies the store. Every part of the store holds the `digest` of its
content, so that parts of other sweeps are detected.
"""

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
from msgspec import Meta

from jaxhil.contact.laws import contact_law
from jaxhil.errors import InputError, one_line, shown
from jaxhil.files import open_plain
from jaxhil.laws.compensators import compensator_of
from jaxhil.rig import digest
from jaxhil.simulation.environment import rounding_flags, xla_flags
from jaxhil.simulation.gain_file import LoadedGains, check_document
from jaxhil.simulation.sources import sources_sha256, versions
from tuning.sweeps import LARGEST_CHUNK, LARGEST_SEED, MOST
from tuning.sweeps.columns import Column, sweep_columns
from tuning.sweeps.draws import REPLICATES

SCHEMA = "jaxhil/sweep/2"
NAME = "manifest.json"
CHUNK = 16384  # default number of scenarios per chunk
LARGEST = 8 * 1024 * 1024  # largest size of a file [bytes]
OTHER_COLUMNS = "columns: found others than this version writes"
Digest = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """All inputs that determine a sweep's rows."""

    schema: Literal["jaxhil/sweep/2"]
    scenarios: Annotated[int, Meta(ge=1, le=MOST)]  # number of scenarios, the largest one with `until_width`
    chunk: Annotated[int, Meta(ge=1, le=LARGEST_CHUNK)]  # scenarios per part
    seed: Annotated[int, Meta(ge=0, le=LARGEST_SEED)]
    sampling: Literal["random", "sobol"]
    replicates: Annotated[int, Meta(ge=1)]  # Sobol sequences; 1 for random sampling
    precision: Literal["float64", "float32"]
    limit: Annotated[float, Meta(ge=0)] | None  # limit of the restitution error [1]; None: no limit
    works: bool  # whether mechanical works are computed
    columns: list[Column]
    gains_sha256: Digest  # digest of the gain file
    mechanism_sha256: Digest  # digest of its mechanism's file
    gain_file: dict[str, Any]  # content of the gain file
    sources_sha256: Digest  # digest of the code that computes the rows
    versions: dict[str, str]  # versions of the packages that the code uses
    xla_flags: str  # compiler flags that may change the last bits
    created: str  # date
    sha256: Digest  # digest of all but the date
    # the sweep ends with the first part after which the confidence sequence has this width [1]
    until_width: Annotated[float, Meta(gt=0, le=1)] | None = None

    @property
    def parts(self) -> int:
        """Return the number of parts of the store, all of `chunk` rows but the last."""
        return -(-self.scenarios // self.chunk)

    @property
    def largest_error(self) -> float:
        """Return the limit of the restitution error [1]; infinite if there is none."""
        return math.inf if self.limit is None else self.limit

    @property
    def axes(self) -> int:
        """Return the number of axes, 1 or 6."""
        return self.gain_file.get("axes", 1)

    def part_rows(self, part: int) -> tuple[int, int]:
        """Return the index of a part's first scenario, and the number of its scenarios."""
        first = part * self.chunk
        return first, min(self.chunk, self.scenarios - first)


class Choices(NamedTuple):
    """Options of a sweep, which are fields of `Manifest`."""

    scenarios: int
    seed: int = 0
    sampling: str = "random"
    precision: str = "float64"
    limit: float = 0.01
    works: bool = False
    chunk: int = CHUNK
    until_width: float | None = None


def build_manifest(loaded: LoadedGains, choices: Choices) -> Manifest:
    """Build the manifest of a sweep of a checked gain file; raise `InputError` for an invalid option."""
    if choices.sampling == "sobol" and choices.scenarios < REPLICATES:
        allowed = f"{REPLICATES} or more, the replicates of sobol sampling"
        raise InputError(f"--scenarios: found {choices.scenarios}, allowed {allowed}")
    document = {
        "schema": SCHEMA,
        **choices._asdict(),
        "limit": float(choices.limit) if math.isfinite(choices.limit) else None,
        "replicates": REPLICATES if choices.sampling == "sobol" else 1,
        "columns": msgspec.to_builtins(sweep_columns(loaded.mechanism, choices.works)),
        "gains_sha256": loaded.document["sha256"],
        "mechanism_sha256": loaded.document["mechanism_sha256"],
        "gain_file": loaded.document,
        "sources_sha256": _sources(loaded),
        "versions": versions(),
        "xla_flags": rounding_flags(xla_flags()),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    if choices.until_width is None:
        del document["until_width"]
    return _decode({**document, "sha256": digest(document)}, "sweep")


def encode(manifest: Manifest) -> bytes:
    """Return the content of the manifest file."""
    document = msgspec.to_builtins(manifest)
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode("ascii")


def decode(content: bytes, source: str) -> Manifest:
    """Parse the content of a manifest file called `source`; raise `InputError` if it is invalid."""
    try:
        document = json.loads(content.decode("utf-8"), parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{source}: not valid JSON: {one_line(str(error), 100)}") from None
    if not isinstance(document, dict):
        raise InputError(f"{source}: found {shown(document)}, allowed a JSON object, {SCHEMA}")
    return _decode(document, source)


def read_manifest(folder: Path) -> Manifest:
    """Read the manifest of the store in `folder`; raise `InputError` if it is missing or invalid."""
    path = folder / NAME
    source = one_line(str(path))
    try:
        with open_plain(path) as file:
            content = file.read(LARGEST + 1)
    except FileNotFoundError:
        raise InputError(
            f"{source}: found no such file, allowed a folder that `jaxhil sweep` wrote"
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{source}: cannot be read: {one_line(reason, 100)}") from None
    if len(content) > LARGEST:
        raise InputError(f"{source}: found more than {LARGEST} bytes, allowed a manifest, {SCHEMA}")
    return decode(content, source)


def loaded_gains(manifest: Manifest, source: str = "sweep") -> LoadedGains:
    """Return the gain file within a manifest, checked like a file."""
    return check_document(manifest.gain_file, f"{source}: gain_file", any_axes=True)


def differences(old: Manifest, new: Manifest) -> list[str]:
    """Return the differences of the inputs, each as "key: found OLD, asked for NEW"."""
    keys = ("gains_sha256", *Choices._fields, "xla_flags")
    values = ((key, getattr(old, key), getattr(new, key)) for key in keys)
    return [
        f"{key}: found {_short(before)}, asked for {_short(now)}"
        for key, before, now in values
        if before != now
    ]


def other_code(old: Manifest, new: Manifest) -> list[str]:
    """Return the differences of the code that computes the rows, likewise."""
    changes = _other_versions(old, new.sources_sha256, new.versions)
    return changes + ([OTHER_COLUMNS] if old.columns != new.columns else [])


def unlike_here(manifest: Manifest) -> list[str]:
    """Return the differences of this process from the manifest that may change the rows' last bits."""
    flags = rounding_flags(xla_flags())
    loaded = loaded_gains(manifest)
    changes = _other_versions(manifest, _sources(loaded), versions())
    if flags != manifest.xla_flags:
        changes.append(f"xla_flags: found {_short(manifest.xla_flags)}, here {_short(flags)}")
    if manifest.columns != sweep_columns(loaded.mechanism, manifest.works):
        changes.append(OTHER_COLUMNS)
    return changes


def _sources(loaded: LoadedGains) -> str:
    contact = loaded.mechanism.contact
    contacts = contact.values() if isinstance(contact, dict) else [contact]
    return sources_sha256(compensator_of(loaded.compensator), *(contact_law(c.law) for c in contacts))


def _other_versions(manifest: Manifest, sources: str, here: Mapping[str, str]) -> list[str]:
    old = {"sources_sha256": manifest.sources_sha256, **_prefixed(manifest.versions)}
    new = {"sources_sha256": sources, **_prefixed(here)}
    return [
        f"{key}: found {_short(old.get(key))}, here {_short(new.get(key))}"
        for key in sorted(old.keys() | new.keys())
        if old.get(key) != new.get(key)
    ]


def _prefixed(packages: Mapping[str, str]) -> dict[str, str]:
    return {f"versions.{name}": number for name, number in packages.items()}


def _decode(document: Mapping[str, Any], source: str) -> Manifest:
    schema = document.get("schema")
    if isinstance(schema, str) and schema.startswith("jaxhil/sweep/") and schema != SCHEMA:
        allowed = f"{SCHEMA}: sweep again into a new folder, or use the version that made it"
        raise InputError(f"{source}: schema: found {shown(schema)}, allowed {allowed}")
    try:
        manifest = msgspec.convert(document, Manifest)
    except (msgspec.ValidationError, RecursionError) as error:
        raise InputError(f"{source}: {one_line(str(error), 160)}") from None
    try:
        computed = digest(document)
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{source}: {one_line(str(error), 160)}") from None
    if computed != manifest.sha256:
        raise InputError(f"{source}: sha256: found {manifest.sha256[:12]}..., allowed {computed[:12]}...")
    if manifest.until_width is not None and manifest.sampling != "random":
        raise InputError(f"{source}: until_width: found with {manifest.sampling}, allowed with random")
    for key, inner in (("gains_sha256", "sha256"), ("mechanism_sha256", "mechanism_sha256")):
        if manifest.gain_file.get(inner) != getattr(manifest, key):
            raise InputError(f"{source}: {key}: found another than the gain file's, allowed the same")
    return manifest


def _short(value: Any) -> str:
    return f"{value[:12]}..." if isinstance(value, str) and len(value) > 24 else shown(value)


def _no_constant(name: str) -> None:
    raise ValueError(f"found {name}")
