"""Time per tick of the C controller compared with a loop that only reads the inputs.

Every guard and the watchdog are active. The shortest of many repetitions counts, because the machine is
shared. Run with `pytest -m benchmark -s tests/benchmarks/test_c_tick.py`.
"""

import shutil
import subprocess
from pathlib import Path

import c99_cases
import numpy as np
import pytest
from gain_documents import gain_document, sign

from jaxhil.rig import COMPENSATORS
from jaxhil.rig.limits import LIMITS

pytestmark = [
    pytest.mark.benchmark,
    pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine"),
]
BAR = 100.0  # ns, largest time per tick
BARS = {"impulse_ledger": 5000.0}  # ns; this compensator updates 18 parameters and their covariance
ROWS = 200_000
REPEATS = 40
# Contacts of 0.2 s and up to 84 N, 0.3 s apart: every compensator's force decays in between, so that the
# watchdog audits each contact separately. Phase, rate [rad/s], amplitude [m].
CONTACTS = (0.0, 12.0, 1e-3)
WIDE = {
    "force_range": 1e5,
    "measured_lowest": -1.0,
    "measured_highest": 1.0,
    "held_readings": 3.0,
    "force_stuck_travel": 1.0,
    "position_stuck_travel": 1.0,
    "free_distance": 1e-4,
    "settling": 0.02,
    "free_force": 100.0,
    "late_fraction": 0.25,
    "missed_in_a_row": 3.0,
    "force_limit": 1e5,
    "force_slew": 1e9,
    "limited_in_a_row": 3.0,
    "command_lowest": -1.0,
    "command_highest": 1.0,
    "velocity_limit": 10.0,
    "deceleration": 1.0,
    "equivalent_mass": 350.0,
    "restitution_margin": 1e12,
    "energy_balance": 1e12,
    "longest_contact": 1e4,  # the motion does not depend on the compensator
    "alignment": 0.008,
}


@pytest.mark.parametrize("law", COMPENSATORS)
def test_c_controller_time_per_tick_is_within_limit(law, tmp_path):
    document, count = gain_document(law), ROWS
    document["limits"] = {name: {"value": value, "unit": LIMITS[name].unit} for name, value in WIDE.items()}
    folder = c99_cases.write_sources(tmp_path, sign(document))
    shutil.copy(Path(__file__).with_name("c99_ticks.c"), folder)
    program = c99_cases.compiled(folder, "c99_ticks.c", "c99_ticks", "-O2", "jaxhil_controller.c")
    rows = c99_cases.contact_rows(count, np.random.default_rng(0), c99_cases.PERIOD, *CONTACTS)
    ran = subprocess.run(
        [str(program), str(count), str(REPEATS)], input=rows.tobytes(), capture_output=True, check=True
    )
    bare, tick, contact, cause, tail = (float(number) for number in ran.stdout.split())
    print(
        f"\nC tick, {law}: {tick:.1f} ns (bar {BARS.get(law, BAR):.0f} ns); bare loop {bare:.1f} ns; "
        f"{contact / count:.0%} of the ticks in contact, "
        f"of these 999 in 1000 up to {1e-3 * tail:.1f} us"
    )
    assert cause == 0 and contact > 0
    assert tick <= BARS.get(law, BAR)
