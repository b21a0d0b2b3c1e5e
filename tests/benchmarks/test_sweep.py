"""Speed of complete sweeps, including sampling and files, compared with the C++ baseline; memory use.

Run with `pytest -m benchmark -s tests/benchmarks/test_sweep.py`.
"""

import json
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from baseline import compile_baseline

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.loop import build_rig_constants
from tuning.gain_file import build_document, write_gain_file
from tuning.sweeps.chunks import build_sweep, run_chunks
from tuning.sweeps.draws import draw_scenarios
from tuning.sweeps.manifest import DEFAULT_CHUNK_SIZE, ManifestOptions, build_manifest
from tuning.sweeps.store import open_store, write_chunk
from tuning.sweeps.tally import add_to_tally, build_empty_tally

pytestmark = pytest.mark.benchmark
REPEATS = 5
PARTS = 6
BASELINE_LANES = 8192
FEW, MANY = 100_000, 10_000_000  # numbers of scenarios whose memory is compared

# Peak memory of the sweep's own process: `ru_maxrss` includes the process that started it.
MEASURED = """
import json, sys
from tuning.__main__ import main
code = main(sys.argv[1:])
status = dict(line.split(":") for line in open("/proc/self/status") if line.startswith("VmHWM"))
peak = int(status["VmHWM"].split()[0]) / 1024
print(json.dumps({"code": code, "peak_MiB": peak}))
"""


def default_gains():
    loaded = load("varying")
    gains = literature_gains(loaded.mechanism, "response_error")
    return build_document("response_error", gains, loaded.mechanism, loaded.sha256, {}, {}, 0, {})


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_sweep_reaches_80_percent_of_cpp_baseline_speed(precision, tmp_path, capsys):
    baselines = [compile_baseline(skips=skips) for skips in (False, True)]
    if None in baselines:
        pytest.skip("no C++ compiler")
    loaded = check_document(default_gains())
    manifest = build_manifest(loaded, ManifestOptions(PARTS * DEFAULT_CHUNK_SIZE, precision=precision))
    sweep = build_sweep(manifest)
    store = open_store(tmp_path / "store", manifest, resume=False)
    shares = {}

    def sweep_seconds():
        begin, tally, written = time.perf_counter(), build_empty_tally(1), 0.0
        for part, rows in run_chunks(sweep, range(PARTS)):
            started = time.perf_counter()
            write_chunk(store, part, rows)
            written += time.perf_counter() - started
            tally = add_to_tally(tally, rows)
        took = time.perf_counter() - begin
        shares[took] = written / took
        return took

    _, scenarios = draw_scenarios(sweep.mechanism, "random", 0, 0, BASELINE_LANES)
    on_device = jax.tree.map(jnp.asarray, scenarios)
    rig = jax.jit(build_rig_constants, static_argnums=0)(sweep.loop, on_device)
    # Every scenario ends within the horizon.
    ends = [one.run(sweep.loop, rig, sweep.gains, on_device, 4000)["ticks"].max() for one in baselines]
    drawing = time.perf_counter()
    for part in range(32):
        draw_scenarios(sweep.mechanism, "random", 0, part * DEFAULT_CHUNK_SIZE, DEFAULT_CHUNK_SIZE)
    drawing = 32 * DEFAULT_CHUNK_SIZE / (time.perf_counter() - drawing)
    sweep_seconds()
    ours, theirs = [], []
    for _ in range(REPEATS):
        ours.append(sweep_seconds())
        theirs.append(
            [
                one.run(sweep.loop, rig, sweep.gains, on_device, int(end))["seconds"]
                for one, end in zip(baselines, ends, strict=True)
            ]
        )
    rate, compiled = PARTS * DEFAULT_CHUNK_SIZE / min(ours), BASELINE_LANES / np.min(theirs, axis=0)
    with capsys.disabled():
        print(
            f"\nsweep, {precision}: scenarios/s over C++ to the fixed horizon of {ends[0]} ticks:"
            f" {rate / compiled[0]:.2f} ({rate:.3g} over {compiled[0]:.3g}); over C++ that skips approaches"
            f" too, to {ends[1]} ticks: {rate / compiled[1]:.2f}; encoding and writing parts, while the next"
            f" is computed: {shares[min(ours)]:.0%} of the time; {drawing:.3g} draws/s"
        )
    assert rate >= 0.8 * compiled[0]


def test_sweep_memory_does_not_grow_with_number_of_scenarios(tmp_path, capsys):
    write_gain_file(tmp_path / "gains.json", default_gains())
    peaks = {}
    for number in FEW, MANY:
        arguments = ["sweep", str(tmp_path / "gains.json"), "--scenarios", str(number)]
        arguments += ["-o", str(tmp_path / str(number))]
        command = [sys.executable, "-c", MEASURED, *arguments]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        peaks[number] = json.loads(done.stdout.splitlines()[-1])["peak_MiB"]
    with capsys.disabled():
        shown = ", ".join(f"{peak:.0f} MiB for {number}" for number, peak in peaks.items())
        print(f"\npeak memory of a sweep: {shown}")
    assert peaks[MANY] < min(1.1 * peaks[FEW], 1536)
