"""Forces logged by a clock of their own: a constant nobody can tell, a rate that touches do."""

from dataclasses import replace

import campaigns
import numpy as np
import pytest

import jaxhil
from tuning.identification.check import check
from tuning.identification.estimate import Options, identify
from tuning.identification.two_clocks import slope

DELAY = {"rig.force_sensor.delay": 0.0037}


def day(seed=0, constant=0.005, rate=4e-5, every=120.0, kind="clean", speeds=(0.003, 0.006, 0.012) * 2):
    """Touches `every` so many seconds; forces are written late by a constant [s] and by a rate."""
    whole, rng = campaigns.campaign(kind, seed, speeds=(), seconds=10.0), np.random.default_rng(seed)
    kind, runs = campaigns.KINDS[kind], list(whole.runs)
    for number, speed in enumerate(speeds):
        begin = 7.0 + every * number
        sensor = {**kind.rig["force_sensor"], "delay": 0.0037 + constant + rate * begin}
        (run,) = campaigns._touch_runs(replace(kind, rig={**kind.rig, "force_sensor": sensor}), rng, (speed,))
        runs.append(replace(run, source=f"{number}.csv", begin=begin))
    return replace(whole, runs=tuple(runs), timing=replace(whole.timing, two_clocks=True))


@pytest.mark.parametrize(("constant", "rate", "every"), (
    (0.005, 4e-5, 120.0),
    pytest.param(-0.003, -1.2e-6, 120.0, marks=pytest.mark.slow),
    pytest.param(0.01, 5e-6, 600.0, marks=pytest.mark.slow),
))  # fmt: skip
def test_a_rate_is_found_and_the_contact_as_with_one_clock(constant, rate, every):
    campaign = day(0, constant, rate, every)
    found = identify(campaign, options=Options(law="kelvin_voigt", fixed=DELAY, hold_out=0.0))
    drift = found.contact.drift
    assert abs(drift.rate - rate) < 4.0 * drift.std < 1e-6
    assert found["contact.stiffness.0"].value == pytest.approx(1.2e5, rel=0.003)
    assert abs(found["contact.damping.0"].value - 650.0) < 4.0 * found["contact.damping.0"].std < 240.0
    assert found["rig.contact_plane"].value == pytest.approx(0.0, abs=5e-6)
    assert found["rig.force_sensor.delay"].told
    # Nothing but what six touches leave of the damping is wanting.
    assert found.verdict.startswith("Bad: the numbers are too uncertain: contact.damping")
    assert replace(found, limit=0.03).good
    assert found.mechanism["rig"]["force_sensor"]["delay"] == 0.0037
    assert f"gains {1e6 * drift.rate:.3g}" in " ".join(found.notes)


def test_the_constant_is_nobodys_to_tell():
    campaign = day(speeds=(0.012, 0.006, 0.012))
    found = identify(campaign, options=Options(law="linear", hold_out=0.0))
    assert found.mechanism is None and "rig.force_sensor.delay (--fix would" in found.verdict
    prior = jaxhil.load("rig-300kg")
    found = identify(campaign, prior, Options(law="linear", hold_out=0.0))
    assert found.mechanism["rig"]["force_sensor"]["delay"] == prior.rig.force_sensor.delay


def test_two_clocks_that_nobody_told_of_are_a_bad_verdict():
    campaign = day(rate=1.6e-6)
    found = identify(
        replace(campaign, timing=replace(campaign.timing, two_clocks=False)),
        options=Options(law="kelvin_voigt", hold_out=0.0),
    )
    line = next(one for one in found.lines if one.name == "drift of the force delay")
    assert line.there and not found.good
    # From 7 s to 607 s.
    assert float(line.finding.split()[0]) == pytest.approx(0.96, abs=0.15)


def test_what_cannot_be_is_refused():
    together = day(every=0.0)
    with pytest.raises(jaxhil.InputError, match="6 touches within 0 s, allowed 3 apart"):
        identify(together, options=Options(law="kelvin_voigt", fixed=DELAY, hold_out=0.0))
    with pytest.raises(jaxhil.InputError, match="forces that follow no touch"):
        identify(day(constant=0.3), options=Options(law="linear", fixed=DELAY, hold_out=0.0))
    with pytest.raises(jaxhil.InputError, match='"separate", allowed "stamps" or "index"'):
        check(together, jaxhil.load("rig-300kg"))


def test_the_slope_of_a_line_and_its_error():
    rng, place = np.random.default_rng(0), np.linspace(0.0, 1.0, 12)
    off = []
    for _ in range(2000):
        found, std = slope(3.0 + 2.0 * place + 0.1 * rng.standard_normal(12), np.full(12, 100.0), place)
        off.append((found - 2.0) / std)
    # The scatter is never taken for less than was told.
    assert 0.9 < np.std(off) < 1.0 and abs(np.mean(off)) < 0.08
