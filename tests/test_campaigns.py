"""Campaign generator compared with the oracle, contact by contact."""

from dataclasses import replace

import campaigns
import numpy as np
import oracle
import pytest


@pytest.mark.parametrize("name", ("third_order", "lagging", "hertz", "resonance", "stiffnesses", "dead_zone"))
def test_contacts_of_simulated_campaign_match_oracle(name):
    kind = campaigns.KINDS[name]
    sensors = {
        sensor: {key: value for key, value in kind.rig[sensor].items() if key != "noise_std"}
        for sensor in ("force_sensor", "position_sensor")
    }
    kind = replace(kind, rig={**kind.rig, **sensors})
    mechanism = {
        "bodies": {"equivalent_mass": kind.mass},
        "approach": {"velocity": 0.006, "phase": 0.4},
        "contact": kind.contact,
        "rig": kind.rig,
    }
    signals = oracle.simulate(mechanism, record=True, contacts=1)[0]["signals"]
    seconds = len(signals["tick"]) * kind.rig["control_period"]
    log = campaigns.touches(
        kind, [0.006], [0], [0.4], np.random.default_rng(0), seconds, lead=0.02, damping=0, noise=False
    )
    assert signals["force_measured"].max() > 40.0
    # The oracle's lag is exact; the generator integrates numerically a force that begins with a jump.
    force, position = (0.02, 1e-8) if name == "lagging" else (1e-11, 1e-16)
    for theirs, ours, error in (
        ("x_desired", "position_desired", position),
        ("x_measured", "position_measured", position),
        ("force_measured", "force_measured", force),
    ):
        np.testing.assert_allclose(log[ours][:, 0], signals[theirs], rtol=0, atol=error)
