"""A small bundle, for the tests of all that is done with one."""

import contextlib
import functools
import io
from typing import Any

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from tuning.bundle import selftest
from tuning.bundle.bundle import build_bundle
from tuning.bundle.manifest import manifest_text
from tuning.gain_file import build_document

TICKS = 240  # of the small bundle: the nominal run
LIMITS = {"force_limit": 900.0, "held_readings": 3.0, "velocity_limit": None}


def document(
    mechanism_name: str = "rig-300kg",
    compensator: str = "phase_lead",
    overrides: tuple[str, ...] = (),
    **changes: Any,
) -> dict[str, Any]:
    """A gain document of a built-in mechanism, at the literature's gains."""
    mechanism, sha256, _ = load(mechanism_name, overrides)
    gains = {gain.name: gain.nominal(mechanism) for gain in COMPENSATORS[compensator].gains}
    return build_document(compensator, {**gains, **changes}, mechanism, sha256, {}, {}, 0, {})


@functools.cache
def small_files() -> dict[str, bytes]:
    """The files of a bundle with few vectors: the nominal run's beginning, and the last hostile one."""
    made = build_bundle(document(), ["ros2", "matlab", "csv", "c99"], LIMITS)
    lines = made.files["vectors.csv"].splitlines(keepends=True)
    last = lines[-1].partition(b",")[0] + b","
    hostile = [line for line in lines if line.startswith(last)]
    return signed({**made.files, "vectors.csv": b"".join(lines[: TICKS + 1] + hostile)}, made.document)


def signed(files: dict[str, bytes], gain_document: dict[str, Any]) -> dict[str, bytes]:
    """The files with a manifest that fits them."""
    rest = {name: content for name, content in files.items() if name != selftest.MANIFEST_FILE}
    return {**rest, selftest.MANIFEST_FILE: manifest_text(rest, gain_document)}


def run_selftest(folder, *arguments: str) -> tuple[bool, str]:
    """Whether the self-test of the bundle passes, and what it prints; run in this process."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        good = selftest.main(arguments, str(folder))
    return good, output.getvalue()
