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
    "petals": (np.inf, 0.03, 0.15),
    "claw-two-arms": (np.inf, 0.05, 0.35),
}
SEARCH = {"scenarios": 32, "starts": 2, "steps": 12, "validation": 511}


@pytest.mark.slow
def test_nominal_ledger_errors_are_small_with_wide_ranges():
    [metrics] = evaluated(load_wide("probe-drogue"), "impulse_ledger", lanes=16)
    check_good(metrics)
    assert rms(metrics["energy_error"]) < 0.05
    assert rms(metrics["twist_error"]) < 0.012 and np.max(metrics["twist_error"]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["petals", "claw-two-arms"])
def test_nominal_ledger_errors_are_small_if_several_surfaces_touch(name):
    [metrics] = evaluated(load_wide(name), "impulse_ledger", lanes=511, seed=0x5EED)
    check_good(metrics)
    energy, twist = metrics["energy_error"], metrics["twist_error"]
    print(name, rms(energy), np.max(np.abs(energy)), rms(twist), np.max(twist))
    assert rms(twist) <= BARS[name][1] and np.max(twist) <= BARS[name][2]


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
