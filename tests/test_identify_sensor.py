"""Identification of a filter or a cut dead zone of the force sensor that the prior states."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import jaxhil
from jaxhil.mechanism.sensor_filter import find_modes
from tuning.identification.cut_zone import estimate_bias_before_contact, find_largest_size
from tuning.identification.identify import IdentificationOptions, identify
from tuning.identification.logs.campaign import read_campaign
from tuning.identification.nearby_rows import Onsets
from tuning.identification.records import LoggedRun
from tuning.identification.sensor_filter import apply_filter

FILTERS = [(kind, order) for kind in ("butterworth", "bessel") for order in (1, 2, 3, 4)]
CAMPAIGNS = 8
DAMPING = 600.0  # N s/m
FINE = 400  # points per control period of the numerical oracle


@pytest.mark.parametrize(("kind", "order"), FILTERS)
def test_filter_of_contact_fit_equals_the_numerical_response_to_an_onset_within_a_period(kind, order):
    """The force jumps between two rows, and increases linearly afterwards."""
    rate, rows, onset = 0.6, 40, 10.3
    time = np.arange(rows * FINE) / FINE
    force = np.where(time > onset, 2.0 + 0.5 * (time - onset), 0.0)
    poles = rate * (signal.buttap(order) if kind == "butterworth" else signal.besselap(order, norm="mag"))[1]
    system = signal.ZerosPolesGain([], poles, np.prod(-poles).real)
    exact = signal.lsim(system, force, time)[1]
    now, half = (
        np.where(at > onset, 2.0 + 0.5 * (at - onset), 0.0) for at in np.arange(rows) - [[0.0], [0.5]]
    )
    first = np.array([11])
    onsets = Onsets(np.array([0]), first, np.ones((1, 1)), first - onset)
    modes = find_modes(kind, order)
    tables = [values[None, None] for values in (now, half)]
    response = apply_filter(modes, rate, tables, (1.0,), onsets, np.full((1, 1), 2.0))
    np.testing.assert_allclose(response[0, 0], exact[::FINE], rtol=0.0, atol=2e-3)


def simulated_logs(folder, sensor, seed):
    """Write logs of nine simulated contacts at three speeds and return their paths."""
    paths = []
    for index, speed in enumerate((0.003, 0.006, 0.012) * 3):
        changes = {"approach.velocity": speed, "contact.damping": [DAMPING], **sensor}
        paths.append(folder / f"touch_{index}.csv")
        jaxhil.simulate(jaxhil.load("rig-300kg", changes), "response_error", seed=9 * seed + index).to_csv(
            paths[-1]
        )
    return paths


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "order", "cutoff"), [("butterworth", 2, 120.0), ("bessel", 3, 80.0)])
def test_intervals_cover_cutoff_of_stated_filter_in_logs_of_simulate(tmp_path, kind, order, cutoff):
    sensor = {"rig.force_sensor.noise_std": 0.5}
    low_pass = {"kind": kind, "order": order, "cutoff": cutoff}
    truth = jaxhil.load("rig-300kg", {**sensor, "rig.force_sensor.filter": low_pass})
    delay = truth.rig.force_sensor.delay + find_modes(kind, order).delay / (2.0 * np.pi * cutoff)
    true = {
        "rig.force_sensor.filter.cutoff": cutoff,
        "delay and lag of force": delay,
        "contact.damping.0": DAMPING,
        "contact.stiffness.0": truth.contact.stiffness[0],
    }
    stated = {**sensor, "rig.force_sensor.filter": {**low_pass, "cutoff": 1.3 * cutoff}}
    prior = jaxhil.load("rig-300kg", {**stated, "contact.stiffness": [9e4]})
    covered, errors = [], []
    for seed in range(CAMPAIGNS):
        logs = simulated_logs(tmp_path, {**sensor, "rig.force_sensor.filter": low_pass}, seed)
        result = identify(read_campaign(logs, None, prior), prior, IdentificationOptions(seed=seed))
        covered += [result[key].low <= value <= result[key].high for key, value in true.items()]
        errors.append(result["rig.force_sensor.filter.cutoff"].value / cutoff - 1.0)
        assert result.mechanism is not None
        written = result.mechanism["rig"]["force_sensor"]["filter"]
        assert written["cutoff"] == result["rig.force_sensor.filter.cutoff"].value
        assert (written["kind"], written["order"]) == (kind, order)
        assert not [line for line in result.lines if line.name == "filter of the force sensor"]
    print(
        kind,
        order,
        "covered",
        np.mean(covered),
        "rms error of the cutoff",
        np.sqrt(np.mean(np.square(errors))),
    )
    # If 95 % of the intervals cover, 32 intervals miss more than five values in 0.5 % of all studies.
    assert np.sum(~np.array(covered)) <= 5


def runs_at_rest(values, count=4):
    """Return runs of 500 readings before a large force."""
    parts = np.split(values, count)
    rows = np.arange(len(parts[0]) + 500)
    blank = np.zeros(len(rows))
    force = [np.append(part, np.full(500, 100.0)) for part in parts]
    return [
        LoggedRun("contact", "", rows, 0.0, blank, blank, one, None, None, blank == 0.0, None, 0.005)
        for one in force
    ]


def test_hidden_bias_and_largest_size_of_cut_zone_are_estimated_from_noise():
    readings = 0.2 + 0.5 * np.random.default_rng(0).standard_normal(8000)
    runs = runs_at_rest(np.where(np.abs(readings) > 0.9, readings, 0.0))
    assert 0.9 < find_largest_size(runs) < 0.91
    bias = estimate_bias_before_contact(runs, 0.9)
    assert abs(bias[0] - 0.2) < 3.0 * bias[1] < 0.06
    continuous = np.sign(readings) * np.maximum(np.abs(readings) - 0.9, 0.0)
    same = estimate_bias_before_contact(runs_at_rest(continuous), 0.9, True)
    assert same[0] == pytest.approx(bias[0], abs=1e-5) and same[1] == pytest.approx(bias[1], rel=0.1)
    assert estimate_bias_before_contact(runs_at_rest(np.zeros(8000)), 0.9) == (0.0, pytest.approx(0.18))


@pytest.mark.slow
def test_intervals_cover_stated_cut_zone_in_logs_of_simulate(tmp_path):
    sensor = {"rig.force_sensor.noise_std": 0.5, "rig.force_sensor.dead_zone_kind": "cut"}
    true = {
        "rig.force_sensor.dead_zone": 4.0,
        "rig.force_sensor.delay": jaxhil.load("rig-300kg").rig.force_sensor.delay,
        "contact.damping.0": DAMPING,
        "contact.stiffness.0": jaxhil.load("rig-300kg").contact.stiffness[0],
    }
    prior = jaxhil.load(
        "rig-300kg", {**sensor, "rig.force_sensor.dead_zone": 6.0, "contact.stiffness": [9e4]}
    )
    (rest,) = runs_at_rest(np.zeros(2000), 1)
    rest = replace(rest, kind="rest", valid=rest.force_measured == 0.0)
    covered = []
    for seed in range(CAMPAIGNS):
        logs = simulated_logs(tmp_path, {**sensor, "rig.force_sensor.dead_zone": 4.0}, seed)
        campaign = read_campaign(logs, None, prior)
        campaign = replace(campaign, runs=(*campaign.runs, rest))
        result = identify(campaign, prior, IdentificationOptions(seed=seed))
        covered += [result[key].low <= value <= result[key].high for key, value in true.items()]
        assert result.mechanism is not None
        assert result.mechanism["rig"]["force_sensor"]["dead_zone_kind"] == "cut"
        assert not [line for line in result.lines if line.name == "dead zone of the force sensor"]
    print("covered", np.mean(covered))
    assert np.sum(~np.array(covered)) <= 5
