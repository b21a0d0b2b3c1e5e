"""Errors of the tuned impulse ledger and the tuned phase lead in 511 fresh scenarios with wide ranges.

The test that is not slow uses the ledger's nominal gains and fewer scenarios.
"""

import numpy as np
import pytest
from six_axis_ranges import WIDE, load_wide
from test_six_axis_ledger import check_good, evaluated, rms

import tuning

# Limits by mechanism: rms of the energy error, rms of the twist error, maximum of the twist error.
BARS = {
    "probe-drogue": (0.05, 0.012, 0.05),
    "ring-capture": (0.05, 0.08, np.inf),
    "hydraulic-hexapod": (0.04, 0.02, np.inf),
    # In a few draws the rig has a different sequence of touches, with twist errors up to 0.30.
    "petals": (np.inf, 0.03, np.inf),
    "claw-two-arms": (np.inf, 0.05, 0.35),
}
SEARCH = {"scenarios": 32, "starts": 2, "steps": 12, "validation": 511}


def test_nominal_ledger_errors_are_small_with_wide_ranges():
    [metrics] = evaluated(load_wide("probe-drogue"), "impulse_ledger", lanes=16)
    check_good(metrics)
    assert rms(metrics["energy_error"]) < 0.05
    assert rms(metrics["twist_error"]) < 0.012 and np.max(metrics["twist_error"]) < 0.05


@pytest.mark.slow
@pytest.mark.users_options
@pytest.mark.parametrize("name", BARS)
def test_tuned_ledger_has_smaller_errors_than_tuned_phase_lead(name):
    energy, twist, largest = BARS[name]
    ledger, lead = (
        tuning.tune(WIDE / f"{name}.toml", law, **SEARCH) for law in ("impulse_ledger", "phase_lead")
    )
    errors = {key: part["tuned"] for key, part in ledger.parts.items()}
    assert errors["twist_error"].failed == 0
    assert errors["energy_error"].rms <= energy
    assert errors["twist_error"].rms <= twist and errors["twist_error"].max <= largest
    assert errors["twist_error"].rms <= 0.6 * lead.parts["twist_error"]["tuned"].rms
