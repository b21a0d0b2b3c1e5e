"""Small bundle for the tests that read or modify bundles."""

import contextlib
import functools
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from tuning.bundle import selftest
from tuning.bundle.bundle import build_bundle
from tuning.bundle.manifest import manifest_text
from tuning.gain_file import build_document

TICKS = 240  # ticks of the nominal run in the small bundle
LIMITS = {"force_limit": 900.0, "held_readings": 3.0, "velocity_limit": None}


def document(
    mechanism_name: str = "rig-300kg",
    compensator: str = "phase_lead",
    overrides: tuple[str, ...] = (),
    **changes: Any,
) -> dict[str, Any]:
    """Return the gain document of a built-in mechanism with the literature's gains."""
    mechanism, sha256, _ = load(mechanism_name, overrides)
    gains = {gain.name: gain.nominal(mechanism) for gain in COMPENSATORS[compensator].gains}
    return build_document(compensator, {**gains, **changes}, mechanism, sha256, {}, {}, 0, {})


def write_files(folder: Path, files: Mapping[str, bytes]) -> Path:
    """Write the files of a bundle, given by their paths, into a folder; return the folder."""
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


@functools.cache
def small_files() -> dict[str, bytes]:
    """Return the files of a bundle with few vectors: the start of the nominal run and a hostile run."""
    made = build_bundle(document(), ["ros2", "matlab", "csv", "c99"], LIMITS)
    lines = made.files["vectors.csv"].splitlines(keepends=True)
    last = lines[-1].partition(b",")[0] + b","
    hostile = [line for line in lines if line.startswith(last)]
    return signed({**made.files, "vectors.csv": b"".join(lines[: TICKS + 1] + hostile)}, made.document)


def signed(files: dict[str, bytes], gain_document: dict[str, Any]) -> dict[str, bytes]:
    """Return the files with a manifest that matches their content."""
    rest = {name: content for name, content in files.items() if name != selftest.MANIFEST_FILE}
    return {**rest, selftest.MANIFEST_FILE: manifest_text(rest, gain_document)}


def run_selftest(folder, *arguments: str) -> tuple[bool, str]:
    """Run the self-test of the bundle in this process; return whether it passes, and its output."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        good = selftest.main(arguments, str(folder))
    return good, output.getvalue()
