"""Identification from whole campaigns: estimates, verdict, mechanism file."""

from dataclasses import replace

import campaign_kinds
import campaign_rigs
import campaigns
import msgspec
import numpy as np
import pytest

import jaxhil
from jaxhil.mechanism.file import from_plain_data
from jaxhil.mechanism.structs import Uncertainty
from jaxhil.mechanism.uncertainty import draw
from tuning.identification.identify import IdentificationOptions, identify, select_held_out_contacts
from tuning.identification.mechanism_check import check_against_mechanism
from tuning.identification.mechanism_file import make_uncertainty_tables, to_toml

FEW = (0.003, 0.006, 0.012) * 3


def identify_kind(name, seed=0, options=None, **changes):
    law = campaigns.KINDS[name].contact["law"]
    return identify(
        campaigns.campaign(name, seed, **changes),
        options=options or IdentificationOptions(law=law, seed=seed),
    )


@pytest.fixture(scope="module")
def clean():
    return identify_kind("clean", speeds=FEW, seconds=30.0)


def test_identify_recovers_rig_from_clean_campaign(clean):
    assert clean["rig.simulator.natural_frequency"].value == pytest.approx(12.0, rel=0.003)
    assert clean["rig.simulator.delay"].value == pytest.approx(0.0043, abs=2e-5)
    assert clean["rig.force_sensor.delay"].value == pytest.approx(0.0037, abs=2.5e-4)
    critical = 2.0 * np.sqrt(1.2e5 * 350.0)
    assert clean["apparent damping"].value == pytest.approx(650.0 - 444.0, abs=0.01 * critical)
    assert clean["contact.stiffness.0"].value == pytest.approx(1.2e5, rel=0.003)
    assert clean["rig.contact_plane"].value == pytest.approx(0.0, abs=5e-6)
    assert clean["rig.force_sensor.noise_std"].value == pytest.approx(0.5, rel=0.04)
    for estimate in clean.estimates:
        assert estimate.low <= estimate.value <= estimate.high
    assert clean.good and clean.verdict.startswith("Good") and clean.effect < 0.01


def test_identified_mechanism_file_loads_with_uncertainty_and_correlation(clean, tmp_path):
    path = tmp_path / "mechanism.toml"
    path.write_text(to_toml(clean.mechanism, "identified"))
    mechanism = jaxhil.load(str(path))
    assert mechanism.contact.law == "kelvin_voigt"
    assert mechanism.contact.stiffness[0] == pytest.approx(clean["contact.stiffness.0"].value, rel=1e-9)
    assert mechanism.rig.force_sensor.noise_std == pytest.approx(clean["rig.force_sensor.noise_std"].value)
    assert "rig.force_sensor.delay" in mechanism.uncertainty
    draws = draw(mechanism, 4000, 0)
    apparent = (
        draws["contact.damping"][:, 0] - draws["contact.stiffness"][:, 0] * draws["rig.force_sensor.delay"]
    )
    # The lower bounds of the standard deviations of delay and stiffness are 2e-5 s and 0.1 %.
    floor = np.hypot(1.2e5 * 2e-5, 0.001 * 1.2e5 * 0.0037)
    assert apparent.std() < 1.3 * np.hypot(clean["apparent damping"].std, floor)


DEFECTS = {"hold": "command hold", "sign": "sign of the force", "scale": "scale"}


@pytest.mark.parametrize(
    ("wrong", "worst"),
    [
        ("order", "motion model"),
        *(pytest.param(*defect, marks=pytest.mark.slow) for defect in DEFECTS.items()),
    ],
)
def test_identify_reports_defect_of_rig_and_verdict_is_bad(wrong, worst):
    campaign = campaigns.campaign("resonance" if wrong == "order" else "clean", 1, speeds=FEW)
    options = IdentificationOptions(law="kelvin_voigt", order=2 if wrong == "order" else None)
    runs = campaign.runs
    if wrong == "hold":
        campaign = replace(campaign, timing=replace(campaign.timing, command_hold="zoh"))
    elif wrong == "sign":
        runs = [
            run if run.kind != "contact" else replace(run, force_measured=-run.force_measured) for run in runs
        ]
    elif wrong == "scale":
        runs = [replace(run, position_measured=1.02 * run.position_measured) for run in runs]
    result = identify(replace(campaign, runs=tuple(runs)), options=options)
    assert not result.good and result.verdict.startswith("Bad")
    assert any(line.name.startswith(worst) and line.is_significant for line in result.lines)


def test_identify_reports_stiffening_contact_as_drift():
    result = identify_kind("drifting", speeds=FEW)
    assert not result.good
    assert next(line for line in result.lines if line.name.startswith("drift")).is_significant


def test_identify_separates_dead_zone_from_bias_and_reports_confounded_pair():
    law = campaigns.KINDS["dead_zone"].contact["law"]
    options = IdentificationOptions(law=law, fixed={"rig.contact_plane": 0.0})
    result = identify_kind("dead_zone", options=options, speeds=FEW)
    dead = result["rig.force_sensor.dead_zone"]
    assert dead.value == pytest.approx(4.0, rel=0.03) and dead.low < 4.0 < dead.high
    assert any({"rig.force_sensor.delay", "contact.damping.0"} == {*pair[:2]} for pair in result.confounded)
    assert result.mechanism["rig"]["force_sensor"]["dead_zone"] == dead.value


@pytest.mark.parametrize("surface", [-2e-5, 2e-5])
def test_identify_estimates_surface_position_if_force_sensor_has_dead_zone(surface):
    """An assumed surface with an error of 14 um would bias the damping by 50 N s/m."""
    campaign = campaigns.campaign("dead_zone", 0, speeds=FEW)
    moved = [
        replace(
            run,
            position_desired=run.position_desired + surface,
            position_measured=run.position_measured + surface,
        )
        for run in campaign.runs
    ]
    result = identify(replace(campaign, runs=tuple(moved)), options=IdentificationOptions(law="kelvin_voigt"))
    truth = campaigns.KINDS["dead_zone"]
    for key, value in (
        ("rig.force_sensor.dead_zone", truth.rig["force_sensor"]["dead_zone"]),
        ("contact.damping.0", truth.contact["damping"][0]),
        ("rig.force_sensor.delay", truth.rig["force_sensor"]["delay"]),
    ):
        assert result[key].low < value < result[key].high, key
    assert not result.good and any("--fix rig.contact_plane" in note for note in result.notes)


def test_identify_detects_dead_zone_if_surface_is_nearer_than_assumed():
    """A fit without a dead zone would have an error of 0.018 in e - e*."""
    campaign = campaigns.campaign("dead_zone", 0, speeds=FEW)
    moved = [
        replace(
            run,
            position_desired=run.position_desired - 6e-5,
            position_measured=run.position_measured - 6e-5,
        )
        for run in campaign.runs
    ]
    result = identify(replace(campaign, runs=tuple(moved)), options=IdentificationOptions(law="kelvin_voigt"))
    dead = result["rig.force_sensor.dead_zone"]
    assert not result.good and dead.low <= 4.0 <= dead.high
    assert any("--fix rig.contact_plane" in note for note in result.notes)


@pytest.mark.parametrize("law", ["hunt_crossley", "piecewise_linear"])
def test_identify_widens_dead_zone_interval_by_surface_uncertainty(law):
    """A dead zone of 4 N and a surface error of 33 um are equally likely."""
    campaign = campaigns.campaign("dead_zone", 0, speeds=FEW)
    dead = identify(campaign, options=IdentificationOptions(law=law))["rig.force_sensor.dead_zone"]
    assert dead.low < 4.0 < dead.high and dead.high - dead.low > 5.0
    assert str(dead.low) == "0.0"


def test_identified_dead_zone_decreases_if_assumed_surface_is_further_away():
    """The readings determine only the sum of dead zone and stiffness times surface position."""
    campaign = campaigns.campaign("dead_zone", 0, speeds=FEW)
    posterior = identify(campaign, options=IdentificationOptions(law="kelvin_voigt")).contact.posterior
    surface, bias = (posterior.draws[:, posterior.names.index(name)] for name in ("plane", "bias"))
    assert np.all(bias <= 1e-9) and np.corrcoef(surface, -bias)[0, 1] < -0.9


@pytest.mark.slow
def test_identify_uses_prior_for_missing_motion_or_contact():
    campaign = campaigns.campaign("clean", 2, speeds=FEW, seconds=0)
    overrides = {"rig.simulator.natural_frequency": 12.0, "rig.simulator.delay": 0.0043}
    result = identify(campaign, jaxhil.load("varying", overrides), IdentificationOptions(law="kelvin_voigt"))
    assert result["contact.stiffness.0"].value == pytest.approx(1.2e5, rel=0.005)
    assert result.mechanism["rig"]["simulator"]["delay"] == 0.0043 and "prior" in result.notes[0]
    free = campaigns.campaign("clean", 2, speeds=(), seconds=30.0)
    result = identify(free, jaxhil.load("varying"))
    assert result.mechanism["contact"]["stiffness"] == [124355.0, 373065.0, 62177.5]
    assert result["rig.simulator.natural_frequency"].value == pytest.approx(12.0, rel=0.003)


@pytest.mark.parametrize("speeds, seconds, says", (
    ((0.006, 0.012), 0, "rig.simulator (add a run of kind free) and contact.stiffness"),
    ((), 5.0, "contact.stiffness (add a run of kind contact or press)"),
))  # fmt: skip
def test_identify_without_prior_reports_missing_runs(speeds, seconds, says):
    result = identify(campaigns.campaign("clean", 2, speeds, seconds))
    assert result.mechanism is None and not result.good
    assert f"logs and prior do not determine {says}" in result.verdict
    assert result["rig.force_sensor.noise_std"].value == pytest.approx(0.5, rel=0.06)


def test_identify_uses_prior_if_contact_force_is_below_noise():
    """The noise of 2.67 N exceeds the contact force at 0.3 mm/s."""
    campaign = campaigns.campaign("noisy", 0, speeds=(0.0002, 0.0003), seconds=5.0)
    options = IdentificationOptions(law="linear", fixed={"rig.contact_plane": 0.0}, hold_out=0.0)
    result = identify(campaign, jaxhil.load("varying"), options)
    assert result.mechanism["contact"]["stiffness"] == [124355.0, 373065.0, 62177.5]
    assert "the contact is the prior's" in result.notes[0]
    assert not any(estimate.key.startswith("contact") for estimate in result.estimates)


def test_identify_does_not_change_fixed_values(clean):
    fixed = {"rig.contact_plane": 0.0, "rig.position_sensor.delay": 0.001}
    result = identify_kind(
        "clean", speeds=FEW, seconds=30.0, options=IdentificationOptions(law="kelvin_voigt", fixed=fixed)
    )
    assert result["rig.contact_plane"].is_fixed and "rig.contact_plane" not in result.mechanism["uncertainty"]
    assert result["rig.simulator.delay"].value == pytest.approx(
        clean["rig.simulator.delay"].value - 0.001, abs=1e-6
    )
    shift = result["rig.force_sensor.delay"].value - clean["rig.force_sensor.delay"].value
    assert shift == pytest.approx(0.001, abs=1e-4)
    assert result.mechanism["rig"]["position_sensor"]["delay"] == 0.001
    with pytest.raises(jaxhil.InputError, match=r"fix: found rig\.range"):
        identify(
            campaigns.campaign("clean", 0, speeds=(), seconds=5.0),
            options=IdentificationOptions(fixed={"rig.range": 1.0}),
        )


def test_identify_adds_computing_delay_to_motion_simulator_delay(clean):
    campaign = campaigns.campaign("clean", 0, speeds=FEW, seconds=30.0)
    late = replace(campaign, timing=replace(campaign.timing, computing_delay=2), integrator="explicit_euler")
    result = identify(late, options=IdentificationOptions(law="kelvin_voigt"))
    delay = clean["rig.simulator.delay"].value
    assert result["rig.simulator.delay"].value == pytest.approx(delay + 0.002, abs=1e-8)
    force = clean["rig.force_sensor.delay"].value
    assert result["rig.force_sensor.delay"].value == pytest.approx(force, abs=1e-6)
    assert (
        result.mechanism["rig"]["integrator"] == "explicit_euler"
        and "integrator" not in clean.mechanism["rig"]
    )


def test_identify_takes_prior_values_only_for_unobservable_parameters(clean):
    sensors = {"rig.force_sensor.time_constant": 0.002, "rig.force_sensor.dead_zone": 3.0}
    prior = jaxhil.load("rig-300kg", {**sensors, "rig.force_sensor.range": 800.0})
    stated = {"rig.position_sensor.noise_std": Uncertainty(distribution="normal", std=1e-7)}
    stated |= {"rig.simulator.damping_ratio": Uncertainty(distribution="normal", std=0.3)}
    prior = msgspec.structs.replace(prior, uncertainty=stated, correlation=None)
    campaign = campaigns.campaign("clean", 0, speeds=FEW, seconds=30.0)
    result = identify(campaign, prior, IdentificationOptions(law="kelvin_voigt")).mechanism
    sensor, uncertain = result["rig"]["force_sensor"], result["uncertainty"]
    assert not {"time_constant", "dead_zone"} & sensor.keys() and sensor["range"] == 800.0
    assert uncertain["rig.position_sensor.noise_std"]["std"] == 1e-7
    assert uncertain["rig.simulator.damping_ratio"]["std"] < 1e-3


def test_identify_copies_previous_list_entry_for_missing_contact():
    campaign = campaigns.campaign("stiffnesses", 0, speeds=(0.006, 0.012, 0.003) * 2, seconds=15.0)
    runs = tuple(run for run in campaign.runs if run.kind != "contact" or run.contact_index[0] != 1)
    result = identify(replace(campaign, runs=runs), options=IdentificationOptions(law="kelvin_voigt"))
    first, between, last = result.mechanism["contact"]["stiffness"]
    assert first == between == pytest.approx(1.2e5, rel=0.01) and last == pytest.approx(7e4, rel=0.01)
    assert "the logs contain only entries 0, 2" in result.notes[0]


@pytest.mark.slow
def test_identify_copies_previous_list_entry_for_grazing_contact():
    campaign = campaigns.campaign("stiffnesses", 0, speeds=(0.012, 0.0002, 0.012, 0.006, 0.0002, 0.006))
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0))
    first, second, last = result.mechanism["contact"]["stiffness"]
    assert first == second == pytest.approx(1.2e5, rel=0.02) and last == pytest.approx(7e4, rel=0.02)
    assert "contact.stiffness.1: known to 30 % at best: taken as the entry before it" in result.notes[0]


def test_identify_keeps_position_delay_if_force_delay_may_be_zero(monkeypatch):
    """Both sensors have the same lag, so the force delay is 0; its estimate is slightly negative."""
    rig = campaign_kinds.rig(force_sensor__delay=0.003, position_sensor__delay=0.003)
    monkeypatch.setitem(campaigns.KINDS, "same", campaign_kinds.Kind(rig, campaign_kinds.voigt()))
    campaign = campaigns.campaign("same", 2, speeds=FEW, seconds=30.0)
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt"))
    delay = result["rig.force_sensor.delay"]
    assert -2.0 * delay.std < delay.value < 0.0 and result.good
    assert result["rig.simulator.delay"].value == pytest.approx(0.0073, abs=2e-5)
    assert result.mechanism["rig"]["position_sensor"]["delay"] == 0.0


@pytest.mark.slow
def test_identify_separates_delays_if_position_sensor_lags_more_than_force_sensor(monkeypatch):
    rig = campaign_kinds.rig(force_sensor__delay=0.0012, position_sensor__delay=0.003)
    monkeypatch.setitem(campaigns.KINDS, "slow", campaign_kinds.Kind(rig, campaign_kinds.voigt()))
    campaign = campaigns.campaign("slow", 0, speeds=FEW, seconds=30.0)
    result = identify(campaign, options=IdentificationOptions(law="kelvin_voigt"))
    share = result["rig.position_sensor.delay"].value
    assert result["rig.simulator.delay"].value + share == pytest.approx(0.0073, abs=2e-5)
    assert 0.0 < result["rig.force_sensor.delay"].value == pytest.approx(share - 0.0018, abs=2.5e-4)
    assert "the position sensor lags more than the force sensor" in result.notes[0] and result.good
    assert check_against_mechanism(campaign, from_plain_data(result.mechanism, "found")).good
    # The prior specifies the delay of the position sensor; the other delays follow.
    prior = campaign_rigs.mechanism("slow")
    result = identify(campaign, prior, IdentificationOptions(law="kelvin_voigt"))
    assert result["rig.simulator.delay"].value == pytest.approx(0.0043, abs=2e-5)
    assert result["rig.force_sensor.delay"].value == pytest.approx(0.0012, abs=2.5e-4)
    assert result.mechanism["rig"]["position_sensor"]["delay"] == 0.003 and result.notes == ()


def test_identify_does_not_write_impossible_mechanism():
    """The message must not refer to a key of a file that was not written."""
    campaign = campaigns.campaign("clean", 0, speeds=(0.003, 0.006, 0.012) * 2, seconds=10.0)
    negative = tuple(replace(run, force_measured=-run.force_measured) for run in campaign.runs)
    result = identify(
        replace(campaign, runs=negative), options=IdentificationOptions(law="kelvin_voigt", hold_out=0.0)
    )
    assert result.mechanism is None and not result.good
    assert "mechanism file: identified mechanism: contact.stiffness[0]: found -" in result.verdict


@pytest.mark.parametrize("options, message", (
    ({"law": "rubber"}, "law: found 'rubber', expected linear"),
    ({"order": 7}, "order: found 7, expected 0, 1, 2"),
))  # fmt: skip
def test_identify_rejects_unknown_contact_law_and_simulator_order(options, message):
    with pytest.raises(jaxhil.InputError, match=message):
        identify(campaigns.campaign("clean", 0, (), 5.0), options=IdentificationOptions(**options))


def test_validation_contacts_of_identify_cover_every_speed():
    runs = campaigns.campaign("clean", 0, seconds=0, rest=0).runs
    is_held_out = select_held_out_contacts(runs, 0.2)
    assert is_held_out.sum() == 3 and {
        run.speed for run, out in zip(runs, is_held_out, strict=True) if out
    } == {
        0.003,
        0.006,
        0.012,
    }
    assert not select_held_out_contacts(runs, 0.0).any() and not select_held_out_contacts(runs[:2], 0.2).any()


def test_uncertainty_tables_have_minimum_std_and_positive_definite_correlation():
    rng = np.random.default_rng(0)
    column = rng.standard_normal(3000)
    draws = np.column_stack([column, column, 1e-9 * rng.standard_normal(3000), rng.standard_normal(3000)])
    tables = make_uncertainty_tables(["a.x.0", "a.x.1", "b", "c"], draws, np.array([0.0, 0.0, 0.5, 0.0]))
    assert (
        tables["uncertainty"]["b"]["std"] == pytest.approx(0.5)
        and tables["uncertainty"]["a.x"]["independent"]
    )
    matrix = np.zeros((3, 3))
    for i, row in enumerate(tables["correlation"]["matrix"]):
        matrix[i, : i + 1] = matrix[: i + 1, i] = row
    assert np.linalg.eigvalsh(matrix).min() > 1e-7 and np.all(np.diag(matrix) == 1.0)
