"""Surface of a contact that a press never leaves: told by the bias at rest, or refused by name."""

from dataclasses import replace

import campaigns
import numpy as np
import pytest
from campaign_rigs import commanded

from jaxhil.errors import InputError
from tuning.identification import contact
from tuning.identification.motion import Motion
from tuning.identification.noise import at_rest
from tuning.identification.press import known_bias
from tuning.identification.rational import STRUCTURES, Model
from tuning.identification.records import Timing

TIMING = Timing(0.001, "linear", 0, "tick", None)
MODEL = Model(STRUCTURES[2], np.array([np.log(2.0 * np.pi * 12.0), np.log(0.8), 0.0043]))
KIND = campaigns.KINDS["clean"]


def multisine(seed=3, depth=0.0008, noise=1.0):
    kind = replace(KIND, rig={**KIND.rig, "force_sensor": {"delay": 0.0037, "noise_std": 0.5 * noise}})
    return campaigns._press_run(kind, np.random.default_rng(seed), seconds=5.0, depth=depth)


def ramp(begin, deepest=0.001, seconds=4.0):
    """A slow push from one position to another and back."""
    up = np.linspace(begin, deepest, round(500 * seconds))
    return commanded("clean", "press", np.concatenate([np.full(500, begin), up, up[::-1]]), 1)


def rest(noise=1.0, bias=0.0):
    return at_rest(bias + 0.5 * noise * np.random.default_rng(0).standard_normal(3000))


def fit(run, noise):
    pieces = contact.pieces(run, TIMING.control_period)
    return contact.estimate(pieces, MODEL, TIMING, noise, "kelvin_voigt")


@pytest.mark.parametrize(
    ("run", "noise", "bias"),
    [
        (multisine(), 1.0, 0.0),
        (multisine(), 1.0, 7.0),
        (multisine(noise=10.0), 10.0, -7.0),
        (ramp(2e-4), 1.0, 5.0),
    ],
    ids=["multisine", "biased", "ten times the noise", "slow"],
)
def test_press_that_stays_inside_finds_the_surface_by_the_bias_at_rest(run, noise, bias):
    found = fit(replace(run, force_measured=run.force_measured + bias), rest(noise, bias)).posterior
    plane, stiffness = (found.names.index(name) for name in ("plane", "stiffness.0"))
    assert abs(found.mean[plane]) < 4.0 * np.std(found.draws[:, plane]) < 1e-4
    assert abs(found.mean[plane]) < 4e-6 * noise
    assert found.mean[stiffness] == pytest.approx(1.2e5, rel=0.01 * noise)


def test_press_that_stays_inside_is_refused_where_nothing_tells_the_bias():
    for run in (multisine(), ramp(2e-4), multisine(noise=10.0)):
        with pytest.raises(InputError, match=r"^press.csv: force_measured: found a press that never leaves"):
            fit(run, None)


def test_press_from_outside_tells_its_own_bias():
    """A bias that changed since the run at rest does no harm."""
    run = ramp(-1e-3)
    run = replace(run, force_measured=run.force_measured + 5.0)
    for noise in (rest(bias=0.0), None):
        found = fit(run, noise).posterior
        assert found.mean[found.names.index("bias")] == pytest.approx(5.0, abs=0.1)
        assert found.mean[found.names.index("plane")] == pytest.approx(0.0, abs=2e-6)


def told(runs, noise=None, plane=None):
    return known_bias(runs, Motion(MODEL, runs, TIMING, 0.022), noise, plane)


def test_bias_is_needed_only_where_the_surface_is_not_told():
    inside, outside = multisine(), ramp(-1e-3)
    mean, std = told([inside], rest(bias=2.0))
    assert mean == pytest.approx(2.0, abs=4 * std) and std > 0.04
    assert told([inside], plane=0.0) is None
    assert told([outside]) is None and told([inside, outside]) is None
    assert told([inside, replace(inside, kind="contact")]) is None
    lost = np.where(np.arange(len(inside.tick)) % 7 == 0, np.nan, inside.force_measured)
    assert told([replace(inside, force_measured=lost)], rest()) is not None
