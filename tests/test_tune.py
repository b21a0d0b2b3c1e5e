"""Tuning with small settings: better than the literature on new scenarios."""

import dataclasses

import numpy as np
import pytest

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.gains.multistart import MAX_START_BATCHES, choose_starts
from tuning.gains.multistart_solver import solve_tasks
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import (
    DEFAULT_NOISY_SCENARIOS,
    DEFAULT_SCENARIOS,
    build_gain_bounds,
    build_task,
    list_tuned_gains,
    spread_points,
)
from tuning.gains.tune import compute_error_metrics, remove_compensation
from tuning.gains.tune_all import tune
from tuning.gains.validation import build_validation
from tuning.optimisation.solution import SOLVER_STATUSES
from tuning.optimisation.unit_box import to_coordinates, to_gains

SMALL = TuneSettings(scenarios=16, starts=2, steps=12, validation=63, scanned=64)


@pytest.fixture(scope="module")
def result():
    return tune(load().mechanism, "phase_lead", SMALL)


def test_tuned_gains_are_better_than_literature_gains_on_new_scenarios(result):
    before, literature, tuned = (result.figures[name] for name in ("before", "literature", "tuned"))
    assert before.rms > literature.rms > tuned.rms
    assert before.failed == literature.failed == tuned.failed == 0
    assert tuned.max >= tuned.p99 >= tuned.rms


def test_every_tuning_start_has_a_status_and_a_decreasing_loss_history(result):
    assert (
        0 < len(result.starts) <= MAX_START_BATCHES * SMALL.starts and len(result.starts) % SMALL.starts == 0
    )
    for start in result.starts:
        assert start.status in SOLVER_STATUSES
        assert len(start.history) == start.steps
        assert (np.diff(start.history) <= 0).all()
        assert start.history[-1] == start.rms


@pytest.mark.slow
def test_gains_tuned_with_noise_are_better_on_noisy_scenarios(result):
    """Use three times the published noise on new scenarios."""
    noisy = load("varying", ["rig.force_sensor.noise_std=8"]).mechanism
    task = build_task(noisy, "phase_lead", SMALL.scenarios, SMALL.seed)
    validation = build_validation([task], 15, SMALL.seed)
    (starts,) = solve_tasks([task], choose_starts(validation, SMALL.starts, SMALL.seed), SMALL.steps)
    tuned = min(starts, key=lambda start: start.rms).gains
    fresh = build_scenarios(noisy, draw(noisy, 255, 99), 99)
    loop = build_loop(noisy, "phase_lead", fresh)
    noiseless, ours = (compute_error_metrics(evaluate(loop, gains, fresh)) for gains in (result.gains, tuned))
    assert noiseless.failed == ours.failed == 0
    assert ours.rms < 0.9 * noiseless.rms
    assert tuned["lead_filter"] > 2 * result.gains["lead_filter"]


@pytest.mark.parametrize(
    "override, number",
    [
        ("approach.velocity=0.01", DEFAULT_SCENARIOS),
        ("rig.position_sensor.noise_std=1e-6", DEFAULT_NOISY_SCENARIOS),
        (
            "uncertainty.'rig.force_sensor.noise_std'={distribution='uniform', low=0, high=3}",
            DEFAULT_NOISY_SCENARIOS,
        ),
    ],
)
def test_noisy_mechanisms_are_tuned_on_more_scenarios(override, number):
    mechanism = load("claw-350kg", [override]).mechanism
    assert len(build_task(mechanism, "none", None, 0).scenarios.velocity) == number
    assert len(build_task(mechanism, "none", 5, 0).scenarios.velocity) == 5


def test_tuned_gains_lie_within_their_bounds(result):
    for gain in COMPENSATORS["phase_lead"].gains:
        assert gain.lower(result.mechanism) <= result.gains[gain.name] <= gain.upper(result.mechanism)


@pytest.mark.slow
def test_tuning_with_the_same_seed_gives_the_same_gains(result):
    assert tune(load().mechanism, "phase_lead", SMALL).gains == result.gains


def test_compensator_without_gains_is_only_evaluated():
    result = tune(load().mechanism, "none", SMALL)
    assert result.starts == [] and result.gains == {}
    assert result.figures["before"] == result.figures["tuned"]


def test_compensator_setting_is_evaluated_without_tuning(monkeypatch):
    law = COMPENSATORS["phase_lead"]
    monkeypatch.setattr(type(law), "settings", {"mild": {"phase_lead": 0.0015}})
    result = tune(
        load().mechanism, "phase_lead", dataclasses.replace(SMALL, setting="mild", global_search=True)
    )
    assert result.starts == [] and result.global_comparison is None
    assert result.gains["phase_lead"] == 0.0015
    assert result.figures["literature"] == result.figures["tuned"] != result.figures["before"]


@pytest.mark.slow
def test_outcome_before_tuning_is_uncompensated_for_every_compensator(monkeypatch):
    monkeypatch.setattr(type(COMPENSATORS["impulse_ledger"]), "settings", {"mild": {}})
    mechanism, quiet = load().mechanism, dataclasses.replace(SMALL, setting="mild")
    without = tune(mechanism, "none", SMALL).outcomes["tuned"]
    assert remove_compensation("impulse_ledger", {}) == ("none", {})
    assert remove_compensation("phase_lead", {"phase_lead": 1.0}) == ("phase_lead", {"phase_lead": 0.0})
    before = tune(mechanism, "impulse_ledger", quiet).outcomes["before"]
    np.testing.assert_allclose(before.error, without.error, rtol=1e-12)
    assert np.sqrt(np.nanmean(before.error**2)) > 0.1


def test_tuning_starts_begin_with_literature_gains_and_stay_within_bounds():
    task = build_task(load().mechanism, "response_error", 8, 0)
    names = list_tuned_gains([task])
    bounds = build_gain_bounds(task, names)
    first = np.array([task.literature[name] for name in names])
    points = spread_points(to_coordinates(first, bounds), 9, seed=0)
    np.testing.assert_allclose(to_gains(points[0], bounds), first, rtol=1e-12)
    assert ((points >= 0) & (points <= 1)).all()
    assert len(np.unique(points, axis=0)) == 9
