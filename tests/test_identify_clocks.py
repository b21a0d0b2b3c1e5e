"""Forces logged with a separate clock: the clock rate is observable, a constant offset is not."""

from dataclasses import replace

import campaigns
import numpy as np
import pytest

import jaxhil
from tuning.identification.clock_drift import fit_weighted_slope
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.mechanism_check import check_against_mechanism

DELAY = {"rig.force_sensor.delay": 0.0037}


def contacts_with_clock_error(
    seed=0, constant=0.005, rate=4e-5, every=120.0, kind="clean", speeds=(0.003, 0.006, 0.012) * 2
):
    """Return contacts every `every` seconds; force time stamps have a constant delay [s] and a rate error."""
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
def test_identify_estimates_clock_rate_and_contact(constant, rate, every):
    campaign = contacts_with_clock_error(0, constant, rate, every)
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", fixed=DELAY, hold_out=0.0))
    drift = result.contact.drift
    assert abs(drift.rate - rate) < 4.0 * drift.std < 1e-6
    assert result["contact.stiffness.0"].value == pytest.approx(1.2e5, rel=0.003)
    assert abs(result["contact.damping.0"].value - 650.0) < 4.0 * result["contact.damping.0"].std < 240.0
    assert result["rig.contact_plane"].value == pytest.approx(0.0, abs=5e-6)
    assert result["rig.force_sensor.delay"].is_fixed
    # The only reason is the uncertain damping after six contacts.
    assert result.verdict.startswith("Bad: the parameters are too uncertain: contact.damping")
    assert replace(result, limit=0.03).good
    assert result.mechanism["rig"]["force_sensor"]["delay"] == 0.0037
    assert f"gains {1e6 * drift.rate:.3g}" in " ".join(result.notes)


@pytest.mark.slow
def test_identify_cannot_estimate_constant_clock_offset():
    campaign = contacts_with_clock_error(speeds=(0.012, 0.006, 0.012))
    result = identify(campaign, options=IdentificationOptions(law="linear", hold_out=0.0))
    assert result.mechanism is None and "rig.force_sensor.delay (specify it with --fix" in result.verdict
    prior = jaxhil.load("rig-300kg")
    result = identify(campaign, prior, IdentificationOptions(law="linear", hold_out=0.0))
    assert result.mechanism["rig"]["force_sensor"]["delay"] == prior.rig.force_sensor.delay


def test_identify_verdict_is_bad_for_undeclared_second_clock():
    campaign = contacts_with_clock_error(rate=1.6e-6)
    result = identify(
        replace(campaign, timing=replace(campaign.timing, two_clocks=False)),
        options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0),
    )
    line = next(item for item in result.lines if item.name == "drift of the force delay")
    assert line.is_significant and not result.good
    assert float(line.finding.split()[0]) == pytest.approx(0.96, abs=0.15)


def test_identify_rejects_unusable_logs_of_two_clocks():
    together = contacts_with_clock_error(every=0.0)
    with pytest.raises(jaxhil.InputError, match="6 contacts within 0 s, expected at least 3"):
        identify(together, options=IdentificationOptions(law="kelvin_voigt", fixed=DELAY, hold_out=0.0))
    with pytest.raises(jaxhil.InputError, match="forces that do not follow the motion"):
        identify(
            contacts_with_clock_error(constant=0.3),
            options=IdentificationOptions(law="linear", fixed=DELAY, hold_out=0.0),
        )
    with pytest.raises(jaxhil.InputError, match='"separate", expected "stamps" or "index"'):
        check_against_mechanism(together, jaxhil.load("rig-300kg"))


def test_standard_error_of_fitted_slope_matches_its_scatter():
    rng, position = np.random.default_rng(0), np.linspace(0.0, 1.0, 12)
    off = []
    for _ in range(2000):
        slope_estimate, std = fit_weighted_slope(
            3.0 + 2.0 * position + 0.1 * rng.standard_normal(12), np.full(12, 100.0), position
        )
        off.append((slope_estimate - 2.0) / std)
    # The scatter is never estimated below the stated standard deviation.
    assert 0.9 < np.std(off) < 1.0 and abs(np.mean(off)) < 0.08
