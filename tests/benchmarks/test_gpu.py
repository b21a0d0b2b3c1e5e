"""Script for graphics cards: with tiny sizes, every row of its table has a result on this machine."""

import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("gpu.sh")


@pytest.mark.slow
def test_gpu_script_run_with_tiny_sizes_fills_every_row():
    done = subprocess.run(["bash", str(SCRIPT), "--smoke"], capture_output=True, text=True, check=True)
    rows = [line for line in done.stdout.splitlines() if line.startswith("|")][2:]
    assert len(rows) == 10
    for problem in ("failed", "not done", "skipped"):
        assert not any(problem in row for row in rows), rows
