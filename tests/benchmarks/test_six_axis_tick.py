"""Time of a tick of the six-axis controller in C and in Python, with every guard and the watchdog.

The rows are recorded contacts of probe-drogue with noise. In C, the shortest of many repetitions counts; in
Python, CPU times are compared, because the machine is shared. Run with `pytest -m benchmark -s
tests/benchmarks/test_six_axis_tick.py`.
"""

import ctypes
import time

import c99_cases
import numpy as np
import pytest
from six_axis_c99 import built, pointer, rows_of
from six_axis_ranges import NOISE, POSE_NOISE
from six_axis_records import recorded

from jaxhil.laws import built_in_compensators
from jaxhil.mechanism.file import load_any
from jaxhil.rig.six_axes import Controller6

pytestmark = pytest.mark.benchmark
C_BAR, PYTHON_BAR = 5.0, 200.0  # us
REPEATS = 200


@pytest.fixture(scope="module")
def rows():
    changes = {"rig.force_sensor.noise_std": NOISE, "rig.position_sensor.noise_std": POSE_NOISE}
    records = recorded(load_any("probe-drogue", changes).mechanism, "impulse_ledger", 1)
    return rows_of(records.lanes[0][:4], 1e-3)


@pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
@pytest.mark.parametrize("name", built_in_compensators(6))
def test_six_axis_c_controller_time_per_tick_is_within_limit(name, rows, capsys):
    _, made = built(name, wide=True)
    count, best = ctypes.c_size_t(len(rows)), np.inf
    for _ in range(REPEATS):
        assert made.library.driver_init(made.state)
        begin = time.thread_time_ns()
        made.library.driver_ticks(made.state, count, pointer(rows))
        best = min(best, (time.thread_time_ns() - begin) / len(rows) / 1e3)
    with capsys.disabled():
        print(f"\nC tick in six axes, {name}: {best:.2f} us; state {made.library.driver_size()} bytes")
    assert best <= C_BAR


@pytest.mark.parametrize("name", built_in_compensators(6))
def test_six_axis_python_controller_time_per_tick_is_within_limit(name, rows, capsys):
    document, _ = built(name, wide=True)
    times = []
    for _ in range(20):
        rig = Controller6.from_dict(document)
        for row in rows.tolist():
            inputs = (row[1:7], row[7:13], row[13:19], row[19:25], row[25])
            begin = time.thread_time_ns()
            rig.step(*inputs)
            rig.pose_command(row[27:33], row[33:39])
            times.append(time.thread_time_ns() - begin)
    median, tail = np.percentile(times, [50, 99.9]) / 1e3
    with capsys.disabled():
        print(
            f"\nPython tick in six axes, {name}: {median:.1f} us (median), {tail:.0f} us (99.9th percentile)"
        )
    assert median <= PYTHON_BAR
