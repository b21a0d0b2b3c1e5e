"""Manifest of a bundle: checksums of every file, detailed enough to locate a changed line.

The manifest contains the SHA-256 of each file, a checksum of every line of text files, the values in the gain
file, the version of jaxhil, and checksums of the manifest itself. The bundle's self-test and `jaxhil verify`
read it.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from tuning.bundle import selftest

# A folder that contains one of these files is a bundle.
BUNDLE_MARKERS = (selftest.MANIFEST_FILE, selftest.SIGNATURE_FILE, "selftest.py", "jaxhil_runtime.py")


def manifest_text(files: Mapping[str, bytes], document: Mapping[str, Any]) -> bytes:
    """Return the content of manifest.json for the files of a bundle and its gain document."""
    entries = {}
    for name, content in sorted(files.items()):
        entry: dict[str, Any] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
        if is_text(content):
            entry["lines"] = selftest.line_checksums(content)
        entries[name] = entry
    body = json.dumps(
        {
            "schema": selftest.SCHEMA,
            "version": package_version(),
            "compensator": document["compensator"],
            "gains_sha256": document["sha256"],
            "values": dict(sorted(selftest.flatten_document(document, ""))),
            "files": entries,
        },
        indent=1,
    ).encode("ascii")
    body = body.removesuffix(b"\n}")
    return body + selftest.build_manifest_seal(body)


def package_version() -> str:
    """Return name and version of this package, such as "jaxhil 1.0"; manifests contain this text."""
    try:
        return f"jaxhil {metadata.version('jaxhil')}"
    except metadata.PackageNotFoundError:
        return "jaxhil, not installed"


def is_text(content: bytes) -> bool:
    """Return whether the content of a file is UTF-8 text."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError:
        return False
    return b"\0" not in content


def is_bundle(folder: Path) -> bool:
    """Return whether a folder contains a bundle, even an incomplete one."""
    return folder.is_dir() and any(os.path.lexists(folder / name) for name in BUNDLE_MARKERS)
