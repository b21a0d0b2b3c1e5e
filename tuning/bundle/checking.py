"""A bundle checked from the workstation: against its manifest, then by its own self-test, on its own."""

import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from jaxhil.errors import one_line
from tuning.bundle.manifest import damage

LONGEST = 600.0  # s


class Checked(NamedTuple):
    """The verdict on a bundle."""

    lines: list[str]  # what its self-test printed
    reasons: list[str]  # why it is bad; none if it is good


def check_bundle(folder: Path) -> Checked:
    """Nothing of a bundle that differs from its manifest is run."""
    reasons = damage(folder)
    if reasons:
        return Checked([], reasons)
    # Isolated: nothing that is installed here may stand in for what is not there.
    command = [sys.executable, "-I", "-S", "-B", str(folder / "selftest.py")]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=LONGEST, check=False
        )
    except subprocess.TimeoutExpired:
        return Checked([], [f"selftest.py: found no end within {LONGEST:g} s"])
    lines = [one_line(line) for line in (done.stdout + done.stderr).splitlines()]
    if not done.returncode:
        return Checked(lines, [])
    failed = [line.removeprefix("FAIL").strip() for line in lines if line.startswith("FAIL ")]
    return Checked(lines, failed or [f"selftest.py: ended with exit code {done.returncode}"])
