"""Filter missing from the model, detected at onset and end of contact; sampling times of forces."""

from dataclasses import replace
from typing import Any

import ambiguous_campaigns as ambiguous
import campaign_kinds
import campaigns
import numpy as np
import pytest
from msgspec.structs import replace as replace_fields
from scipy.signal import butter, lfilter

from jaxhil.mechanism.file import from_plain_data, to_plain_data
from tuning.identification.edge_check import check_force_smoothing
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.mechanism_check import check_against_mechanism
from tuning.identification.motion import MotionResponse
from tuning.identification.noise import estimate_noise
from tuning.identification.rational import STRUCTURES, MotionModel
from tuning.identification.uncertainty_effect import UncertaintyEffect


def zoned(campaign, size, is_cut):
    """Return the campaign of a force sensor with a dead zone [N], which is cut or continuous."""
    runs = []
    for run in campaign.runs:
        force = np.nan_to_num(np.asarray(run.force_measured, float))
        less = 0.0 if is_cut else size * np.sign(force)
        runs.append(replace(run, force_measured=np.where(np.abs(force) > size, force - less, 0.0)))
    return replace(campaign, runs=tuple(runs))


def checked(campaign, truth, check, lag, shift=0.0):
    """Return a check for a mechanism file with the time constant `lag` [s] and this true mechanism.

    The sum of force delay and lag is larger than the true one by `shift` [s], and the damping is larger, too.
    """
    raw: dict[str, Any] = to_plain_data(truth) | {"source": "identified from logs"}
    sensor, (stiffness,) = raw["rig"]["force_sensor"], raw["contact"]["stiffness"]
    raw["contact"]["damping"] = [raw["contact"]["damping"][0] + stiffness * shift]
    delay = sensor["delay"] + sensor.get("time_constant", 0.0) - lag + shift
    raw["rig"]["force_sensor"] = {**sensor, "time_constant": lag, "delay": delay}
    raw["uncertainty"] = {"rig.force_sensor.delay": {"distribution": "normal", "std": 1e-4}}
    raw["uncertainty"]["rig.contact_plane"] = {"distribution": "normal", "std": 1e-6}
    result = check_against_mechanism(campaign, from_plain_data(raw, "identified"))
    (line,) = (line for line in result.lines if line.name == check)
    return line


@pytest.mark.parametrize(("lag", "there"), [(0.0016, False), (0.0, True)])
def test_force_lag_missing_from_model_is_detected_at_onset_and_end_of_contact(monkeypatch, lag, there):
    campaign = ambiguous.campaign(monkeypatch, "lag", 0, seconds=5.0)
    line = checked(campaign, ambiguous.truth("lag"), "edges of contact", lag)
    assert line.is_significant == there
    assert not there or line.error_in_verdict > 0.01


def test_filter_that_explains_logs_with_another_damping_adds_to_the_effect(monkeypatch):
    campaign, cutoff = ambiguous.campaign(monkeypatch, "plain", 0, seconds=5.0), 100.0
    low_pass: Any = butter(2, cutoff, fs=1000.0)
    b, a = low_pass
    runs = [replace(run, force_measured=lfilter(b, a, run.force_measured)) for run in campaign.runs]
    truth = ambiguous.truth("plain")
    sensor = replace_fields(truth.rig.force_sensor, time_constant=0.7071 / np.pi / cutoff)
    truth = replace_fields(truth, rig=replace_fields(truth.rig, force_sensor=sensor))
    name = "filter of the force sensor"
    line = checked(replace(campaign, runs=tuple(runs)), truth, name, 0.0016, shift=3e-4)
    assert line.is_significant and line.error_in_verdict > 0.01
    line = checked(campaign, ambiguous.truth("plain"), name, 0.0)
    assert not line.is_significant and "larger with a filter of order 2" in line.finding


def test_dead_zone_is_estimated_from_noise_at_rest():
    signal = np.random.default_rng(1).standard_normal(20_000)
    noise = estimate_noise(np.sign(signal) * np.maximum(np.abs(signal) - 0.7, 0.0))
    assert noise.silent and noise.hidden is not None
    value, std = noise.hidden.zone, np.sqrt(noise.hidden.covariance[1, 1])
    assert abs(value - 0.7) < 4.0 * std < 0.1 and noise.std == pytest.approx(1.0, rel=0.05)
    cut = estimate_noise(np.where(np.abs(signal) > 0.7, signal, 0.0))
    assert cut.silent and cut.hidden is None


@pytest.mark.parametrize(("bias", "zone", "pole"), [(-0.27, 0.57, 0.0), (0.3, 0.4, 0.0), (0.1, 0.5, 0.9)])
def test_bias_behind_dead_zone_is_estimated_with_its_stated_error(bias, zone, pole):
    scores = []
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(8000)
        if pole:
            noise = lfilter([np.sqrt(1.0 - pole**2)], [1.0, -pole], noise)
        signal = bias + 0.34 * noise
        hidden = estimate_noise(np.sign(signal) * np.maximum(np.abs(signal) - zone, 0.0)).hidden
        assert hidden is not None
        missing, std = hidden.missing_force
        errors = hidden.bias - bias, hidden.zone - zone, missing - zone + bias
        scores.append(np.array(errors) / [*np.sqrt(np.diag(hidden.covariance)), std])
    rms = np.sqrt(np.mean(np.square(scores), axis=0))
    assert np.all((rms > 0.4) & (rms < 1.5))


def test_dead_zone_of_rounded_readings_is_estimated():
    signal = np.random.default_rng(2).standard_normal(20_000)
    rounded = 0.15 * np.round(np.sign(signal) * np.maximum(np.abs(signal) - 0.7, 0.0) / 0.15)
    hidden = estimate_noise(rounded).hidden
    assert hidden is not None
    assert abs(hidden.zone - 0.7) < 4.0 * np.sqrt(hidden.covariance[1, 1]) < 0.1


def test_bias_and_dead_zone_are_unknown_if_readings_have_one_sign():
    signal = -10.0 + 0.34 * np.random.default_rng(0).standard_normal(8000)
    assert estimate_noise(np.sign(signal) * np.maximum(np.abs(signal) - 10.2, 0.0)).hidden is None


@pytest.mark.parametrize(("bias", "zone"), [(-0.27, 0.57), (0.45, 0.4)])
def test_identify_separates_dead_zone_from_bias(monkeypatch, bias, zone):
    """The zone hides only a part of the noise; with the larger bias, no force is missing in contact."""
    sensor = {"force_sensor__dead_zone": zone, "force_sensor__bias": bias, "force_sensor__delay": 0.0037}
    rig = campaign_kinds.rig(noise=0.34, **sensor)
    monkeypatch.setitem(campaigns.KINDS, "zone", campaign_kinds.Kind(rig, campaign_kinds.voigt()))
    result = identify(campaigns.campaign("zone", 0), options=IdentificationOptions(law="kelvin_voigt"))
    for key, true in (
        ("rig.force_sensor.dead_zone", zone),
        ("rig.force_sensor.bias", bias),
        ("rig.force_sensor.delay", 0.0037),
        ("contact.damping.0", 650.0),
        ("rig.contact_plane", 0.0),
    ):
        assert abs(result[key].value - true) < 3.5 * result[key].std


DATA_FINDING = "no reading lies between 0 and 3 N, as with a dead zone that is not subtracted"


@pytest.mark.parametrize(
    ("is_cut", "kind", "expected"),
    [
        (True, "continuous", [DATA_FINDING]),
        pytest.param(True, "cut", [], marks=pytest.mark.slow),
        pytest.param(False, "continuous", [], marks=pytest.mark.slow),
    ],
)
def test_identify_reports_dead_zone_that_sensor_does_not_subtract_as_defect(
    monkeypatch, is_cut, kind, expected
):
    campaign = zoned(ambiguous.campaign(monkeypatch, "plain", 0, seconds=5.0), 3.0, is_cut)
    prior: dict[str, Any] = to_plain_data(ambiguous.prior("plain"))
    prior["rig"]["force_sensor"] |= {"dead_zone": 3.0, "dead_zone_kind": kind}
    result = identify(campaign, from_plain_data(prior, "prior"))
    findings = [line.finding for line in result.lines if line.name == "dead zone of the force sensor"]
    assert findings == expected
    assert not (is_cut and result.good)
    assert result.mechanism is not None
    assert (result.mechanism["rig"]["force_sensor"].get("dead_zone_kind") == "cut") == (kind == "cut")


@pytest.mark.parametrize(
    ("is_cut", "finding"), [(True, []), (False, ["0 readings out of contact are not 0, expected "])]
)
def test_stated_cut_dead_zone_is_compared_with_noise_out_of_contact(monkeypatch, is_cut, finding):
    campaign = zoned(ambiguous.campaign(monkeypatch, "plain", 0, seconds=5.0), 1.0 if is_cut else 3.0, is_cut)
    raw = to_plain_data(ambiguous.truth("plain"))
    size = 1.0 if is_cut else 0.5
    raw["rig"]["force_sensor"] |= {"dead_zone": size, "dead_zone_kind": "cut", "noise_std": 0.5}
    result = check_against_mechanism(campaign, from_plain_data(raw, "truth"))
    findings = [line.finding for line in result.lines if line.name == "dead zone of the force sensor"]
    assert len(findings) == len(finding) and all(map(str.startswith, findings, finding))
    effects = [line.effect_in_verdict for line in result.lines if line.name == "sampling of the dead zone"]
    assert effects == [pytest.approx(3.0 * size * 0.001 / 350.0 / 0.006)]
    assert result.good == is_cut


@pytest.mark.parametrize(
    ("size", "bias", "finding"),
    [
        (3.0, 0.0, []),
        (1.0, -2.0, ["100% of the readings without contact are 0, expected 2% with a bias of -2 N"]),
    ],
)
def test_bias_that_dead_zone_would_not_hide_contradicts_zeros_at_rest(monkeypatch, size, bias, finding):
    campaign = zoned(ambiguous.campaign(monkeypatch, "plain", 0, seconds=5.0), 3.0, False)
    raw = to_plain_data(ambiguous.truth("plain"))
    raw["rig"]["force_sensor"] |= {"dead_zone": size, "bias": bias, "noise_std": 0.5}
    result = check_against_mechanism(campaign, from_plain_data(raw, "truth"))
    findings = [line.finding for line in result.lines if line.name == "dead zone of the force sensor"]
    assert findings == finding and result.good == (not finding)


@pytest.mark.parametrize("is_cut", [True, False])
def test_cut_dead_zone_that_the_noise_exceeds_is_detected(monkeypatch, is_cut):
    campaign = zoned(ambiguous.campaign(monkeypatch, "plain", 0, seconds=5.0), 1.0, is_cut)
    raw = to_plain_data(ambiguous.truth("plain"))
    raw["rig"]["force_sensor"] |= {"dead_zone": 1.0, "noise_std": 0.5}
    result = check_against_mechanism(campaign, from_plain_data(raw, "truth"))
    findings = [line.finding for line in result.lines if line.name == "dead zone of the force sensor"]
    assert (
        findings == ["no reading lies between 0 and 1 N, as with a dead zone that is not subtracted"] * is_cut
    )


@pytest.mark.parametrize(
    ("response", "expected"), [((0.6, 0.4), 1), ((1.0,), 0), (0.8 ** np.arange(40), 0)], ids=str
)
def test_noise_at_rest_shows_interpolated_force(response, expected):
    readings = np.convolve(np.random.default_rng(3).standard_normal(5000), response)
    effect = UncertaintyEffect(0.002, 0.006, {"contact.damping": 0.002})
    lines = check_force_smoothing(estimate_noise(readings), effect, 3.0, 0.002)
    assert len(lines) == expected
    assert all(line.is_significant and 0.006 < line.error_in_verdict < 0.012 for line in lines)


def test_contact_motion_is_evaluated_at_the_times_of_force_readings():
    campaign = campaigns.campaign("clean", 0, speeds=(0.006, 0.012), seconds=0, rest=0)
    model = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
    late = [replace(run, force_late=np.full(len(run.tick), 3e-4)) for run in campaign.runs]
    motion, undelayed = (
        MotionResponse(model, runs, campaign.timing, 0.022) for runs in (late, campaign.runs)
    )
    for late_values, values in zip(motion.at(0.004), undelayed.at(0.0037), strict=True):
        np.testing.assert_allclose(late_values, values, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(motion.at_row_times().at(0.004)[0], undelayed.at(0.004)[0])
