"""The page of the first ten minutes: its commands, one after the other, print what it shows."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "notebooks" / "guide" / "first_ten_minutes.md"
STEPS = re.compile(r"^\$ (.*)\n((?:(?!\$ |```).*\n)*)", re.M)
NUMBER = re.compile(r"\d+\.\d+|\d+")


@pytest.mark.slow
def test_its_commands_print_what_it_shows(tmp_path):
    """Words and lines; numbers too, where the page was made with the same versions on the same processor."""
    steps = STEPS.findall(PAGE.read_text(encoding="utf-8"))
    assert len(steps) == 6
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    names = {"jaxhil": [sys.executable, "-m", "tuning"], "python": [sys.executable]}
    for command, shown in steps:
        first, *others = command.split()
        ran = subprocess.run(
            [*names[first], *others], cwd=tmp_path, env={**os.environ, "PYTHONPATH": path, "COLUMNS": "110"},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert ran.returncode == ("Bad:" in shown), ran.stderr
        printed = {_words(line) for line in ran.stdout.splitlines()}
        missing = [line for line in shown.splitlines() if _words(line) not in printed]
        assert not missing, f"{command}: {missing}\n{ran.stdout}"


def _words(line):
    """A line without its numbers, which follow a solver."""
    return " ".join(NUMBER.sub("N", line).split())
