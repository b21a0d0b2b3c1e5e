"""Time per tick of the Python controller compared with an empty loop, with and without guards.

A tick is `step` with its time, followed by `position_command`; the watchdog is active. Times are CPU times.
Run with `pytest -m benchmark -s tests/benchmarks/test_python_tick.py`.
"""

import time

import numpy as np
import pytest
from c99_cases import contact_rows
from gain_documents import gain_document, sign
from test_c_tick import CONTACTS, WIDE

from jaxhil.rig import COMPENSATORS, Controller
from jaxhil.rig.limits import LIMITS

pytestmark = pytest.mark.benchmark
TICKS = 200_000
BAR = 10.0  # us, largest time per tick
# The impulse ledger updates 17 parameters and their covariance on every tick in contact.
BARS = {"impulse_ledger": 250.0}
TAILS = {"impulse_ledger": 500.0}  # us, limit for 99.9 % of the ticks in contact


@pytest.mark.parametrize("guarded", [False, True], ids=["bare", "guarded"])
@pytest.mark.parametrize("law", COMPENSATORS)
def test_python_controller_time_per_tick_is_within_limit(law, guarded, capsys):
    document, count = gain_document(law), TICKS // 10 if law in TAILS else TICKS
    if guarded:
        document["limits"] = {
            name: {"value": value, "unit": LIMITS[name].unit} for name, value in WIDE.items()
        }
    controller = Controller.from_dict(sign(document))
    rows = contact_rows(count, np.random.default_rng(0), controller.control_period, *CONTACTS)
    in_contact = rows[:, 2] > 0.0
    took, empty = [], []
    clock, step, position_command = time.thread_time_ns, controller.step, controller.position_command
    for _, force, desired, velocity, measured, now, _, x, v, a in rows.tolist():
        begin = clock()
        step(force, desired, velocity, measured, now)
        position_command(x, v, a)
        took.append(clock() - begin)
        begin = clock()
        empty.append(clock() - begin)
    assert controller.status == "ok"
    (median, tail), (bare, bare_tail) = (
        np.percentile(np.array(times)[in_contact], [50, 99.9]) / 1e3 for times in (took, empty)
    )
    with capsys.disabled():
        print(
            f"\n{law}, {'guarded' if guarded else 'bare'}: {median:.2f} us a tick in contact (median), "
            f"{tail:.2f} us (99.9th percentile); empty loop {bare:.2f} and {bare_tail:.2f} us"
        )
    assert median <= BARS.get(law, BAR) and tail <= TAILS.get(law, np.inf)
