"""Surface position from a press run always in contact: estimated with the bias at rest, rejected without."""

from dataclasses import replace

import campaigns
import numpy as np
import pytest
from campaign_rigs import commanded

from jaxhil.errors import InputError
from tuning.identification import contact_fit, contact_runs
from tuning.identification.motion import MotionResponse
from tuning.identification.noise import estimate_noise
from tuning.identification.press_bias import find_bias_prior
from tuning.identification.rational import STRUCTURES, MotionModel
from tuning.identification.records import CampaignTiming

TIMING = CampaignTiming(0.001, "linear", 0, "tick", None)
MODEL = MotionModel(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
KIND = campaigns.KINDS["clean"]


def multisine(seed=3, depth=0.0008, noise=1.0):
    kind = replace(KIND, rig={**KIND.rig, "force_sensor": {"delay": 0.0037, "noise_std": 0.5 * noise}})
    return campaigns._press_run(kind, np.random.default_rng(seed), seconds=5.0, depth=depth)


def ramp(begin, deepest=0.001, seconds=4.0):
    """Return a slow motion from one position to another and back."""
    up = np.linspace(begin, deepest, round(500 * seconds))
    return commanded("clean", "press", np.concatenate([np.full(500, begin), up, up[::-1]]), 1)


def rest(noise=1.0, bias=0.0):
    return estimate_noise(bias + 0.5 * noise * np.random.default_rng(0).standard_normal(3000))


def fit(run, noise):
    pieces = contact_runs.split_long_run(run, TIMING.control_period)
    return contact_fit.fit_contact(pieces, MODEL, TIMING, noise, "kelvin_voigt")


@pytest.mark.parametrize(
    ("run", "noise", "bias"),
    [
        pytest.param(multisine(), 1.0, 0.0, marks=pytest.mark.slow),
        pytest.param(multisine(), 1.0, 7.0, marks=pytest.mark.slow),
        (multisine(noise=10.0), 10.0, -7.0),
        pytest.param(ramp(2e-4), 1.0, 5.0, marks=pytest.mark.slow),
    ],
    ids=["multisine", "biased", "ten times the noise", "slow"],
)
def test_press_run_always_in_contact_gives_surface_if_bias_at_rest_is_measured(run, noise, bias):
    result = fit(replace(run, force_measured=run.force_measured + bias), rest(noise, bias)).posterior
    plane, stiffness = (result.names.index(name) for name in ("plane", "stiffness.0"))
    assert abs(result.mean[plane]) < 4.0 * np.std(result.draws[:, plane]) < 1e-4
    assert abs(result.mean[plane]) < 4e-6 * noise
    assert result.mean[stiffness] == pytest.approx(1.2e5, rel=0.01 * noise)


def test_press_run_always_in_contact_is_rejected_without_bias_at_rest():
    for run in (multisine(), ramp(2e-4), multisine(noise=10.0)):
        with pytest.raises(
            InputError, match=r"^press.csv: force_measured: found only a press run that stays"
        ):
            fit(run, None)


def test_press_run_that_starts_out_of_contact_estimates_bias():
    run = ramp(-1e-3)
    run = replace(run, force_measured=run.force_measured + 5.0)
    for noise in (rest(bias=0.0), None):
        result = fit(run, noise).posterior
        assert result.mean[result.names.index("bias")] == pytest.approx(5.0, abs=0.1)
        assert result.mean[result.names.index("plane")] == pytest.approx(0.0, abs=2e-6)


def bias_of(runs, noise=None, plane=None):
    return find_bias_prior(runs, MotionResponse(MODEL, runs, TIMING, 0.022), noise, plane)


def test_press_run_requires_bias_only_if_surface_is_unknown():
    inside, outside = multisine(), ramp(-1e-3)
    mean, std = bias_of([inside], rest(bias=2.0))
    assert mean == pytest.approx(2.0, abs=4 * std) and std > 0.04
    assert bias_of([inside], plane=0.0) is None
    assert bias_of([outside]) is None and bias_of([inside, outside]) is None
    assert bias_of([inside, replace(inside, kind="contact")]) is None
    lost = np.where(np.arange(len(inside.tick)) % 7 == 0, np.nan, inside.force_measured)
    assert bias_of([replace(inside, force_measured=lost)], rest()) is not None
