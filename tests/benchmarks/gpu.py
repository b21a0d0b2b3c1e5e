"""Table of computing speeds on this machine's device; `tests/benchmarks/gpu.sh` runs this script.

A lane-step is one tick of one scenario. The speeds include ticks of lanes that wait for the slowest lane of
their tile.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from test_sweep import default_gains
from test_throughput import best, case, jacobian, ticks_run, timed

from jaxhil.simulation import tile_size
from jaxhil.simulation.evaluation import place_gains
from jaxhil.simulation.one_axis import ONE_AXIS
from jaxhil.simulation.tile_size import DeviceDescription
from tuning.gain_file import write_gain_file
from tuning.sweeps.chunks import convert_precision

LIMIT, SMOKE_LIMIT = 480.0, 3600.0  # maximum time for the table, with full and with tiny sizes [s]
REPEATS = 3
ROOT = Path(__file__).parents[2]


def measure_rollout(
    compensator: str, lanes: int, precision: str = "float64", name: str = "varying", tiled: bool = False
) -> str:
    """Return the speed of a batch; if `tiled`, in the small tiles of a processor."""
    described = tile_size.describe_devices
    if tiled:
        tile_size.describe_devices = lambda: DeviceDescription(is_cpu=True)
    try:
        loop, gains, scenarios = case(compensator, lanes, (name,))
        scenarios = convert_precision(scenarios, precision)
        batch = ONE_AXIS.place_batch(scenarios, loop=loop)
        arguments = *place_gains(batch, gains), batch.scenarios
    finally:
        tile_size.describe_devices = described
    shape = arguments[-1].control_period.shape
    steps = int(np.sum(ticks_run(loop, *arguments))) * shape[-1]
    run = timed(lambda: ONE_AXIS.run_tiles(loop, *arguments))
    run()
    (seconds,) = best(run, repeats=REPEATS)
    return f"{steps / seconds:.2g} lane-steps/s, {lanes / seconds:.2g} scenarios/s, tiles {shape}"


def measure_jacobian(lanes: int) -> str:
    (seconds,) = best(jacobian(lanes, {}), repeats=REPEATS)
    return f"{seconds:.3g} s"


def measure_command(arguments: list[str], folder: Path, runs: int, end: float) -> str:
    """Return the durations of a command that runs `runs` times with the same cache of programs."""
    results = []
    for index in range(runs):
        begin = time.monotonic()
        command = [
            sys.executable,
            "-m",
            "tuning",
            *arguments,
            "-o",
            str(folder / f"out-{index}"),
            "--timings",
        ]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "JAXHIL_CACHE": str(folder / "programs")}
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=max(end - begin, 1)
            )
        except subprocess.TimeoutExpired:
            return " / ".join([*results, f"not done in {time.monotonic() - begin:.0f} s"])
        took = time.monotonic() - begin
        # Exit code 1 is a bad verdict about the gains, not an error.
        if done.returncode not in (0, 1):
            return f"failed: {done.stderr.strip().splitlines()[-1:]}"
        timings = [line for line in done.stderr.splitlines() if "took:" in line]
        results.append(f"{took:.1f} s ({'; '.join(timings).strip()})")
    return " / ".join(results)


def list_rows(smoke: bool, folder: Path, end: float) -> list[tuple[str, Callable[[], str]]]:
    """Return the label and the measurement of each row; with `smoke`, all sizes are tiny."""

    def lanes(number: int) -> int:
        return min(number, 128) if smoke else number

    gains = folder / "gains.json"
    write_gain_file(gains, default_gains())
    tune = ["tune", "varying", *(("--scenarios", "4", "--starts", "1") if smoke else ())]
    sweep = ["sweep", str(gains), "--scenarios", "200" if smoke else "1000000"]
    small, medium, large, huge = map(lanes, (16_384, 65_536, 262_144, 1_048_576))
    return [
        (f"none, {small} lanes, tiles of a processor", lambda: measure_rollout("none", small, tiled=True)),
        (f"none, {small} lanes", lambda: measure_rollout("none", small)),
        (f"none, {large} lanes", lambda: measure_rollout("none", large)),
        (f"none, {huge} lanes", lambda: measure_rollout("none", huge)),
        (f"none, {huge} lanes, float32", lambda: measure_rollout("none", huge, "float32")),
        (f"response_error, {huge} lanes", lambda: measure_rollout("response_error", huge)),
        (f"Jacobian over 12 gains, response_error, {medium} lanes", lambda: measure_jacobian(medium)),
        ("jaxhil sweep", lambda: measure_command(sweep, folder / "sweep", 1, end)),
        ("jaxhil tune varying, first / second time", lambda: measure_command(tune, folder / "tune", 2, end)),
        (
            f"impulse_ledger, suite-noisy, {medium} lanes",
            lambda: measure_rollout("impulse_ledger", medium, name="suite-noisy"),
        ),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, to check that the script works")
    smoke = parser.parse_args().smoke
    limit = SMOKE_LIMIT if smoke else LIMIT
    end = time.monotonic() + limit
    device = jax.devices()[0]
    print(f"{jax.device_count()} x {device.device_kind} ({device.platform}), JAX {jax.__version__}")
    print("| measurement | result |\n|---|---|")
    with tempfile.TemporaryDirectory() as temporary:
        for label, measure in list_rows(smoke, Path(temporary), end):
            if time.monotonic() > end:
                result = f"skipped: {limit:.0f} s are over"
            else:
                try:
                    result = measure()
                except jax.errors.JaxRuntimeError as error:  # for example, too little memory
                    result = f"failed: {str(error).splitlines()[0][:120]}"
            print(f"| {label} | {result} |", flush=True)
