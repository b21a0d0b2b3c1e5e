"""Throughput of `retrospective_reference` beside its C99.

The C is the exported controller alone in a compiled loop, guards and watchdog included, fed with what it
reads in the same runs: no mechanism, no motion simulator, no figures. Each runs on all cores at once, and
they take turns. Run with `pytest -m benchmark -s tests/benchmarks/test_retrospective_throughput.py`.
"""

import shutil
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import c99_cases
import jax
import numpy as np
import pytest
from gain_documents import gain_document, sign
from test_c_tick import WIDE
from test_throughput import PROCESSOR, best, case, timed

from jaxhil.runtime.limits import LIMITS
from jaxhil.simulation import evaluation
from jaxhil.simulation.environment import usable_cores
from jaxhil.simulation.recording import record_ticks

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine"),
]
LAW, LANES, RECORDED, REPEATS = "retrospective_reference", 2048, 8, 4


def rows_of(ticks, period):
    """The C driver's rows of every active tick, lane by lane, the first of a contact marked."""
    signals, active = ticks.signals, np.asarray(ticks.active)
    rows = []
    for lane in range(active.shape[1]):
        here = np.nonzero(active[:, lane])[0]
        force, position, velocity, measured, age = (np.asarray(leaf)[here, lane] for leaf in signals)
        command = np.asarray(ticks.command)[here, lane]
        time, shows = np.zeros(len(here)), np.ones(len(here))
        row = [age == 0, force, position, velocity, measured, time, shows]
        rows.append(np.stack([*row, position, velocity, -command / 350], axis=1))
    rows = np.concatenate(rows)
    rows[:, 5] = period * np.arange(len(rows))
    return rows


def law_alone(gains, rows, folder):
    """A function that tells the seconds of a tick of the exported controller, run on every core at once."""
    document = gain_document(LAW, **gains)
    document["limits"] = {name: {"value": value, "unit": LIMITS[name].unit} for name, value in WIDE.items()}
    c99_cases.write_sources(folder, sign(document))
    shutil.copy(Path(__file__).with_name("c99_ticks.c"), folder)
    program = c99_cases.compiled(folder, "c99_ticks.c", "c99_ticks", "-O2", "jaxhil_controller.c")
    (folder / "rows").write_bytes(rows.tobytes())

    def once(_):
        with (folder / "rows").open("rb") as stdin:
            command = str(program), str(len(rows)), str(REPEATS)
            ran = subprocess.run(command, stdin=stdin, capture_output=True, check=True)
        _, tick, contact, cause, _ = (float(number) for number in ran.stdout.split())
        assert cause == 0 and contact > 0
        return 1e-9 * tick

    def call():
        with ThreadPoolExecutor(usable_cores()) as cores:
            return np.mean(list(cores.map(once, range(usable_cores()))))

    return call


def test_rollout_beside_the_exported_law(tmp_path, capsys):
    loop, gains, scenarios = case(LAW, LANES)
    few = jax.tree.map(lambda leaf: leaf[..., :RECORDED], scenarios)
    _, ticks = record_ticks(loop, gains, few)
    alone = law_alone(gains, rows_of(ticks, scenarios.control_period[0]), tmp_path)
    arguments = evaluation.place(*evaluation.shard(scenarios, gains))
    taken = np.asarray(evaluation.run_tiles(loop, *arguments).metrics.ticks).max(axis=-2)
    seconds, tick = best(timed(lambda: evaluation.run_tiles(loop, *arguments)), alone, repeats=8)
    ours, theirs = np.sum(taken.max(axis=-1) * taken.shape[-1]) / seconds, usable_cores() / tick
    with capsys.disabled():
        print(
            f"\n{PROCESSOR}, {usable_cores()} cores"
            f"\n{LAW}, varying: lane-steps/s of rollout over C: {ours / theirs:.2f}"
            f" ({ours:.3g} over {theirs:.3g}, the law alone at {1e9 * tick:.0f} ns a tick)"
        )
    assert ours >= theirs
