"""Time to tune many mechanisms in one call, compared with separate calls that use compiled programs.

Run with `pytest -m benchmark -s tests/benchmarks/test_many_mechanisms.py`.
"""

import re
import time

import numpy as np
import pytest
from test_start_up import run

import jaxhil
import tuning
from jaxhil.mechanism.file import builtin_path
from jaxhil.simulation.jax_environment import count_usable_cores

pytestmark = pytest.mark.benchmark
NUMBER, SINGLE = 64, 6
MASSES = np.geomspace(150.0, 600.0, NUMBER)
# Largest allowed time relative to separate commands or calls. For calls, the simulations themselves, at least
# three tenths of a single call's time, are subtracted.
SHARE = 0.25


def computing_seconds():
    """Return the CPU time of all other threads divided by the number of cores [s]."""
    return (time.process_time() - time.thread_time()) / count_usable_cores()


def test_tuning_many_mechanisms_in_one_command_is_faster_than_separate_commands(tmp_path, capsys):
    content = builtin_path("varying").read_text()
    for i, mass in enumerate(MASSES):
        other = re.sub(r"(?m)^equivalent_mass = \S+", f"equivalent_mass = {mass:.1f}", content)
        other = re.sub(r"(?m)^name = .*", f'name = "mass-{i}"', other)
        (tmp_path / f"{i}.toml").write_text(other)
    every = [f"{i}.toml" for i in range(NUMBER)]
    singles = every[:: NUMBER // SINGLE][:SINGLE]

    def seconds(some, out):
        return run(("tune", *some, "-o", out), tmp_path, tmp_path / "programs")[0]

    seconds(every[:1], "compiled")
    seconds(every, "compiled together")
    before = [seconds([name], name[:-5]) for name in singles[::2]]
    together = seconds(every, "together")
    one = float(np.mean([*before, *(seconds([name], name[:-5]) for name in singles[1::2])]))
    share = together / (NUMBER * one)
    with capsys.disabled():
        print(
            f"\n{NUMBER} mechanisms in one `jaxhil tune` take {together:.1f} s, {share:.2f} of {NUMBER}"
            f" commands that find their programs compiled, {one:.2f} s each"
        )
    assert share <= SHARE


@pytest.mark.parametrize("compensator", ["phase_lead", "response_error"])
def test_tuning_many_mechanisms_in_one_call_is_faster_than_separate_calls(compensator, capsys):
    every = [
        jaxhil.load("varying", {"bodies.equivalent_mass": float(mass), "name": f"mass {i}"})
        for i, mass in enumerate(MASSES)
    ]

    def seconds(some):
        """Return the duration [s] of a call, and the CPU time of its other threads per core."""
        begin, computed = time.perf_counter(), computing_seconds()
        tuning.tune(some, compensator)
        return np.array([time.perf_counter() - begin, computing_seconds() - computed])

    # Compile the programs of one mechanism, and of as many as are tuned together.
    seconds(every[0])
    seconds(every[: NUMBER // 2])
    singles = every[:: NUMBER // SINGLE][:SINGLE]
    before = [seconds(one) for one in singles[::2]]
    together = seconds(every)
    one, own_runs = np.mean([*before, *(seconds(one) for one in singles[1::2])], axis=0)
    whole, beside_runs = together[0] / (NUMBER * one), (together[0] - together[1]) / (NUMBER * one)
    with capsys.disabled():
        print(
            f"\n{compensator}: {NUMBER} mechanisms in one call of Python take {together[0]:.1f} s,"
            f" {whole:.2f} of {NUMBER} calls once compiled, {one:.2f} s each, and {beside_runs:.2f} without"
            f" the runs; the runs alone, on all cores, are {own_runs / one:.2f} of those calls"
        )
    assert beside_runs <= SHARE
