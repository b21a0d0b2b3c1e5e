"""Campaigns that hardly separate damping from force delay: intervals, verdict, bounds.

The slow study counts how often files with a good verdict are accurate; `pytest -m slow -s
tests/test_identify_ambiguous.py` prints the results.
"""

from dataclasses import replace

import ambiguous_campaigns as ambiguous
import campaign_kinds
import campaign_rigs
import campaigns
import numpy as np
import pytest
from identify_study import evaluate_ambiguous_identification, summarise

from jaxhil.mechanism.file import from_plain_data, load
from tuning.identification import mechanism_models
from tuning.identification.estimates import make_estimates
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.mechanism_check import check_against_mechanism
from tuning.identification.mechanism_file import to_toml
from tuning.identification.result import UNCERTAINTY_CHECK
from tuning.identification.uncertainty_effect import (
    IDENTIFIED_SOURCE_PREFIX,
    _simulate_ideal_contact,
    compute_uncertainty_effect,
)

FEW = (0.003, 0.006, 0.012) * 3
PRESS = "a press run with a multisine to 45 Hz"


def delay_and_lag(result):
    """Return the estimated force delay, including the lag if the lag is estimated."""
    keys = ("delay and lag of force", "rig.force_sensor.delay")
    return next(estimate for estimate in (*result.combinations, *result.estimates) if estimate.key in keys)


def written(result, folder):
    """Write the identified mechanism file, load it and return the mechanism."""
    (folder / "mechanism.toml").write_text(to_toml(result.mechanism, result.verdict))
    return load(folder / "mechanism.toml").mechanism


@pytest.mark.parametrize(("name", "seed"), (("plain", 0), pytest.param("hidden", 1, marks=pytest.mark.slow)))
def test_identify_keeps_damping_in_the_model_while_delay_is_estimated(monkeypatch, tmp_path, name, seed):
    campaign = ambiguous.campaign(monkeypatch, name, seed, seconds=10.0)
    result = identify(campaign, ambiguous.prior(name), IdentificationOptions(seed=seed))
    assert result.contact.law.name == "kelvin_voigt"
    damping, age = result["contact.damping.0"], delay_and_lag(result)
    assert damping.low < 264.0 < damping.high and age.low < 0.0037 < age.high
    mechanism = written(result, tmp_path)
    assert {"rig.force_sensor.delay", "contact.damping"} <= {*mechanism.correlation.keys}
    (line,) = (line for line in result.lines if line.name == UNCERTAINTY_CHECK)
    assert line.on_error > 1.2 * line.effect
    if name == "hidden":
        pair = {"rig.force_sensor.delay", "contact.damping.0"}
        assert any(pair == {*entry[:2]} and entry[3] == PRESS for entry in result.confounded)
        assert not result.good and result.verdict.startswith("Bad: the parameters are too uncertain")
        assert PRESS in result.verdict


@pytest.mark.slow
def test_identify_widens_damping_and_delay_for_possible_lag(monkeypatch):
    """Without a lag in the model, the estimated delay would be 2.84 +- 0.10 ms instead of 4.2 ms."""
    name, seed = "lag", 1002
    campaign = ambiguous.campaign(monkeypatch, name, seed, seconds=10.0)
    result = identify(
        campaign, ambiguous.prior(name), IdentificationOptions(law="kelvin_voigt", hold_out=0.0, seed=seed)
    )
    age, damping = delay_and_lag(result), result["contact.damping.0"]
    assert abs(age.value - 0.0053) < 3.0 * age.std and abs(damping.value - 264.0) < 3.0 * damping.std
    assert not result.good and PRESS in result.verdict


@pytest.mark.parametrize(("name", "possible"), (("undamped", True), ("plain", False)))
def test_identify_uncertainty_draws_include_undamped_contact(monkeypatch, name, possible):
    campaign = ambiguous.campaign(monkeypatch, name, 0, seconds=10.0)
    result = identify(
        campaign, ambiguous.prior(name), IdentificationOptions(law="kelvin_voigt", hold_out=0.0)
    )
    posterior = result.contact.posterior
    share = np.mean(posterior.draws[:, posterior.names.index("damping")] == 0.0)
    assert (0.05 < share < 1.0) if possible else share == 0.0
    assert (result["contact.damping.0"].low == 0.0) is possible


def test_identified_delay_interval_includes_delay_of_undamped_contact():
    rng = np.random.default_rng(0)
    damping = np.abs(rng.normal(0.0, 100.0, 4000))
    delay = 0.0037 + damping / 124355.0 + 2e-5 * rng.standard_normal(4000)
    draws = {"contact.damping.0": damping, "rig.force_sensor.delay": delay}
    of_damping, of_delay = make_estimates(draws, None, None, None, None, {})
    assert of_damping.low == 0.0 and np.quantile(delay, 0.025) > 0.00371
    assert 0.00364 < of_delay.low < 0.00368 and of_delay.high < np.quantile(delay, 0.99)


def test_identify_uses_specified_contact_law(monkeypatch):
    campaign = ambiguous.campaign(monkeypatch, "undamped", 0, speeds=FEW, seconds=10.0)
    result = identify(campaign, options=IdentificationOptions(law="linear", hold_out=0.0))
    assert result.contact.law.name == "linear" and result["rig.force_sensor.delay"].std < 5e-5
    assert any(note.startswith("law linear: without damping, as specified") for note in result.notes)


def test_identify_reports_negative_delay_and_verdict_is_bad(monkeypatch, tmp_path):
    """The position sensor delay is specified as 0 instead of 3 ms: the force delay becomes -1.8 ms."""
    rig = campaign_kinds.rig(force_sensor__delay=0.0012, position_sensor__delay=0.003)
    monkeypatch.setitem(campaigns.KINDS, "slow", campaign_kinds.Kind(rig, campaign_kinds.voigt()))
    campaign = campaigns.campaign("slow", 0, speeds=FEW, seconds=10.0)
    fixed = {"rig.position_sensor.delay": 0.0}
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", fixed=fixed))
    assert result["rig.force_sensor.delay"].value == pytest.approx(-0.0018, abs=3e-4)
    assert result.mechanism["rig"]["force_sensor"]["delay"] == 0.0
    assert result.mechanism["uncertainty"]["rig.force_sensor.delay"]["std"] > 0.0015
    assert any(note.startswith("rig.force_sensor.delay: logs give -0.001") for note in result.notes)
    assert not result.good and not check_against_mechanism(campaign, written(result, tmp_path)).good


def _hold(campaign):
    return replace(campaign, timing=replace(campaign.timing, command_hold="zoh"))


def _same(campaign):
    return campaign


PROPERTY = [
    ("clean", {"law": "kelvin_voigt"}, _same),
    ("clean", {"law": "kelvin_voigt", "limit": 0.004}, _hold),
    ("drifting", {"law": "kelvin_voigt"}, _same),
    *(
        pytest.param(name, options, change, marks=pytest.mark.slow)
        for name in (*campaign_kinds.KINDS, *ambiguous.KINDS)
        for options, change in (({}, _same), ({"law": "linear"}, _same), ({"order": 2}, _hold))
    ),
]


@pytest.mark.parametrize(("name", "options", "change"), PROPERTY)
def test_identify_verdict_equals_verdict_of_check_of_written_file(
    monkeypatch, tmp_path, name, options, change
):
    monkeypatch.setattr(campaigns, "KINDS", campaign_kinds.KINDS | ambiguous.KINDS)
    campaign = change(campaigns.campaign(name, 3, speeds=FEW, seconds=10.0))
    result = identify(campaign, options=IdentificationOptions(**options))
    again = check_against_mechanism(campaign, written(result, tmp_path), result.limit)
    assert again.good == result.good
    assert again.effect == result.effect and again.effect_on_error == result.effect_on_error


@pytest.mark.parametrize("noise", (0.0, pytest.param(0.5, marks=pytest.mark.slow)))
def test_identify_accepts_log_of_one_contact(monkeypatch, noise):
    rig = campaign_kinds.rig(noise=noise, position_noise=noise * 1e-5)
    monkeypatch.setitem(campaigns.KINDS, "one", campaign_kinds.Kind(rig, ambiguous.SOFT))
    campaign = campaigns.campaign("one", 0, speeds=(0.006,), seconds=0, rest=0)
    prior = campaign_rigs.mechanism("clean")
    result = identify(campaign, prior)
    assert np.all(np.isfinite(result.draws)) and np.isfinite(result.effect_on_error)
    assert result["contact.stiffness.0"].value == pytest.approx(124355.0, rel=0.02)
    assert result.good == (noise == 0.0)


def test_effect_of_stiffness_uncertainty_matches_first_order_theory():
    mechanism = ambiguous.truth("undamped")
    contact, frequency = _simulate_ideal_contact(
        mechanism, mechanism_models.make_regression_law(mechanism.contact), 0
    )
    natural = np.sqrt(124355.0 / 350.0)
    assert contact.restitution == pytest.approx(1.0, abs=1e-3)
    assert 2.0 * np.pi * frequency == pytest.approx(natural, rel=0.01)
    assert contact.delay_sensitivity == pytest.approx(np.pi / 2.0 * natural, rel=0.01)
    # e* = exp(-pi zeta), zeta = b / (2 sqrt(k M)).
    assert contact.coefficient_sensitivity[1] == pytest.approx(
        -np.pi / 2.0 / np.sqrt(124355.0 * 350.0), rel=0.01
    )


def test_uncertainty_effect_includes_only_uncertainty_from_identification():
    """Other uncertainty in the file describes variation between mechanisms."""
    assert compute_uncertainty_effect(load("rig-300kg").mechanism).parts == {}
    document = ambiguous.to_plain_data(ambiguous.truth("plain")) | {
        "source": f"{IDENTIFIED_SOURCE_PREFIX} logs"
    }
    document["uncertainty"] = {"rig.force_sensor.delay": {"distribution": "normal", "std": 1e-4}}
    effect = compute_uncertainty_effect(from_plain_data(document, "one"))
    # 99 % of normal draws lie within 2.576 standard deviations.
    assert effect.error >= 0.9 * 2.576 * 1e-4 * 29.5 and effect.restitution >= effect.error


REPEATS = 200
GOOD_BUT_WRONG = 0.01


@pytest.mark.slow
@pytest.mark.users_options
@pytest.mark.parametrize("name", ambiguous.KINDS)
def test_identified_files_with_good_verdict_are_accurate(name):
    outcomes = [evaluate_ambiguous_identification(name, 80_000 + seed) for seed in range(REPEATS)]
    print(summarise(name, outcomes))
    good = [outcome for outcome in outcomes if outcome.verdict == "good"]
    assert sum(outcome.wrong for outcome in good) <= GOOD_BUT_WRONG * len(good)
    assert all(outcome.check == outcome.verdict for outcome in outcomes)
    assert all(len(outcome.covered) >= 2 for outcome in outcomes)
    for key in {key for outcome in outcomes for key in outcome.covered}:
        assert np.mean([outcome.covered[key] for outcome in outcomes if key in outcome.covered]) >= 0.9, key
