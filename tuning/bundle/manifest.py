"""A bundle's manifest: what every file must be, in enough detail to say where one differs.

SHA-256 of each file, a check of every line of those that are text, the values of the gain file, the version
that wrote it, and at its end checks of the manifest itself. The bundle's own self-test reads it; `verify`
does so from here, too.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from tuning.bundle import selftest

# Of a folder that is meant as a bundle.
MARKS = (selftest.MANIFEST, selftest.SIGNATURE, "selftest.py", "jaxhil_runtime.py")


def manifest_text(files: Mapping[str, bytes], document: Mapping[str, Any]) -> bytes:
    """The manifest of these files, by their paths in the bundle, and of the gain document among them."""
    entries = {}
    for name, content in sorted(files.items()):
        entry: dict[str, Any] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
        if is_text(content):
            entry["lines"] = selftest.line_checks(content)
        entries[name] = entry
    body = json.dumps(
        {
            "schema": selftest.SCHEMA,
            "version": version(),
            "compensator": document["compensator"],
            "gains_sha256": document["sha256"],
            "values": dict(sorted(selftest.leaves(document, ""))),
            "files": entries,
        },
        indent=1,
    ).encode("ascii")
    body = body.removesuffix(b"\n}")
    return body + selftest.own_seal(body)


def version() -> str:
    """The version of this package, as it writes it into manifests."""
    try:
        return f"jaxhil {metadata.version('jaxhil')}"
    except metadata.PackageNotFoundError:
        return "jaxhil, not installed"


def is_text(content: bytes) -> bool:
    """Whether a file is lines of text."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return b"\0" not in content


def is_bundle(folder: Path) -> bool:
    """Whether a folder is one, or the remains of one, whatever stands there under the names of its files."""
    return folder.is_dir() and any(os.path.lexists(folder / name) for name in MARKS)
