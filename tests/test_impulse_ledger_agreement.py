"""Agreement of the impulse ledger in JAX and in the runtime, in contacts of built-in mechanisms.

`pytest -m slow -s tests/test_impulse_ledger_agreement.py` compares a million ticks. `test_agreement.py`
compares random and hostile readings.
"""

import pytest

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.rig.gain_file import GainFile
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.recording import nominal_and_draws, record_lanes
from tuning.gain_file import build_document
from tuning.verification.runtime_replay import replay_lane

pytestmark = [pytest.mark.slow, pytest.mark.users_options]
LAW = "impulse_ledger"
LIMIT = 1e-9  # largest difference, divided by the command's range
TICKS = 250_000


@pytest.mark.parametrize("suite", ["noisy", "layered", "friction", "elastoplastic"])
def test_impulse_ledger_of_runtime_agrees_with_jax_in_simulated_contacts(suite):
    mechanism, sha256, _ = load(f"suite-{suite}")
    gains = literature_gains(mechanism, LAW)
    loaded = check_document(build_document(LAW, gains, mechanism, sha256, {}, {}, 0, {}))
    gain_file = GainFile(LAW, gains, mechanism.rig.control_period, mechanism.contact.clearance)
    _, lanes = record_lanes(loaded, nominal_and_draws(mechanism, 1000, seed=4))
    ticks, largest = 0, 0.0
    for lane in lanes:
        result = replay_lane(lane, gain_file)
        assert result.status == "ok" and result.parted is None
        ticks += result.ticks
        largest = max(largest, result.difference, result.near_difference)
        if ticks > TICKS:
            break
    print(f"{suite}: {ticks} ticks, largest difference {largest:.1e} of the range")
    assert ticks > TICKS and largest <= LIMIT
