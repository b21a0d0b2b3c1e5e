"""Time and memory of reading a log of 1e6 and 1e7 rows, compared with pyarrow alone.

Run with `pytest -m benchmark -s tests/benchmarks/test_reading_logs.py`; the larger files take 1 GB.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from log_cases import CHANNELS, sway, touches

pytestmark = pytest.mark.benchmark
PERIOD = 1e-3
BLOCK = 60_000  # rows
MILLION = 1_000_000
SECONDS = {MILLION: 2.0, 10 * MILLION: 20.0}
LARGEST = 2.0  # GiB, memory of the whole process

READ = """
import resource, sys, time
from pathlib import Path
from log_cases import mapping
from tuning.identification.logs.campaign import read_campaign
begin = time.perf_counter(), time.process_time()
runs = read_campaign([Path(sys.argv[1])], mapping(sys.argv[2])).runs
end = time.perf_counter(), time.process_time()
rows = sum(len(run.tick) for run in runs)
"""
BARE = """
import resource, sys, time
from pyarrow import csv
begin = time.perf_counter(), time.process_time()
rows = csv.read_csv(sys.argv[1]).num_rows
end = time.perf_counter(), time.process_time()
"""
SAID = "print(rows, end[0] - begin[0], end[1] - begin[1], resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"


def write(path: Path, rows: int, kind: str) -> None:
    """Write a block of a rig's rows repeatedly, with increasing time stamps."""
    columns = touches(BLOCK // 600) if kind == "contact" else sway(BLOCK)
    names = [name for name in CHANNELS.values() if name != "t"]
    rows_of = zip(*(columns.get(name, columns["xm"]).tolist() for name in names), strict=True)
    block = [",".join(map(repr, row)) for row in rows_of]
    with path.open("w") as file:
        file.write(",".join(CHANNELS.values()) + "\n")
        for first in range(0, rows, BLOCK):
            several = block[: rows - first]
            file.writelines(f"{PERIOD * (first + n):.3f},{line}\n" for n, line in enumerate(several))


def run(code: str, *arguments: object) -> tuple[int, float, float, float]:
    """Return rows, seconds, CPU seconds and largest memory [GiB] of reading in a separate process."""
    ran = subprocess.run(
        [sys.executable, "-c", code + SAID, *map(str, arguments)],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": ":".join(sys.path)},
    )
    rows, wall, processor, kilobytes = ran.stdout.split()
    return int(rows), float(wall), float(processor), float(kilobytes) / 2**20


@pytest.mark.parametrize("rows", SECONDS)
@pytest.mark.parametrize("kind", ["free", "contact"])
def test_log_reading_time_and_memory_are_within_limits(kind, rows, tmp_path, capsys):
    path = tmp_path / "log.csv"
    write(path, rows, kind)
    _, bare, bare_processor, bare_memory = run(BARE, path)
    rows_read, took, processor, memory = run(READ, path, kind)
    with capsys.disabled():
        print(
            f"\n{kind}, {rows} rows ({path.stat().st_size / 1e6:.0f} MB): {took:.1f} s, {rows / took:.2g}/s, "
            f"{processor:.1f} s of the processor, {memory:.2f} GiB; pyarrow alone {bare:.1f} s, "
            f"{bare_processor:.1f} s of the processor, {bare_memory:.2f} GiB"
        )
    path.unlink()
    assert rows_read >= 0.99 * rows and memory <= LARGEST
    # A single thread reads, so its CPU time is the duration on an idle machine.
    assert processor <= SECONDS[rows]
