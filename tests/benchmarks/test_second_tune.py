"""CPU time of a second `jaxhil tune` with cached programs, and with JAX's persistent cache alone.

Each run is a separate process; the first run with either cache fills the cache and is not counted. Run with
`pytest -m benchmark -s tests/benchmarks/test_second_tune.py`.
"""

import os
import resource
import subprocess
import sys

import numpy as np
import pytest

from jaxhil.simulation.jax_environment import CACHE_VARIABLE

pytestmark = pytest.mark.benchmark
PAIRS = 5
TUNE = """
import sys
from jaxhil.simulation import environment, kept_programs
if sys.argv[1] == "jax":
    environment.keep_sealed = lambda folder: True
    kept_programs.compiled = lambda made_of, made, arguments, folder: made()
from tuning.__main__ import main
sys.exit(main(["tune", "rig-300kg", "-o", sys.argv[2]]) == 2)
"""


def seconds(kind, folder):
    """Return the CPU time of one run."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-c", TUNE, kind, str(folder / "out")]
    subprocess.run(
        command, env={**os.environ, CACHE_VARIABLE: str(folder / kind)}, check=True, capture_output=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_second_tune_is_faster_with_cached_programs(tmp_path, capsys):
    kinds = ("ours", "jax")
    first = [seconds(kind, tmp_path) for kind in kinds]
    ours, jax_alone = np.array([[seconds(kind, tmp_path) for kind in kinds] for _ in range(PAIRS)]).T
    ratio = np.median(ours / jax_alone)
    with capsys.disabled():
        print(
            f"\nfirst tune: {first[0]:.1f} s with our cache, {first[1]:.1f} s with JAX's alone; second: "
            f"{np.median(ours):.1f} s and {np.median(jax_alone):.1f} s, ratio {ratio:.2f}"
        )
    assert ratio < 0.9
