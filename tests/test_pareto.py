"""Pareto front of accuracy and noise amplification: weights, undominated points, one program.

Every metric is compared with a separate evaluation.
"""

import dataclasses
import math

import numpy as np
import pytest
from scipy.signal import bilinear, lfilter

from jaxhil.laws.compensators import COMPENSATORS, literature_gains
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation import cached_programs
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.gains import pareto_search
from tuning.gains.objective import Objective, evaluate_objective
from tuning.gains.pareto import compute_fronts, find_dominated
from tuning.gains.pareto_search import (
    LADDER_ENDS,
    build_weight_ladder,
    compute_noise_amplification,
    has_noise_trade_off,
)
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import build_task
from tuning.gains.tune_all import tune_all
from tuning.gains.validation import VALIDATION_SEED_OFFSET, build_validation

POINTS = 5
SETTINGS = TuneSettings(
    scenarios=8,
    starts=2,
    steps=10,
    validation=16,
    objective=Objective(noise_weight=2e-3),
    polish=0,
    scanned=32,
)
MECHANISMS = [
    load("varying", [f"contact.stiffness=[{k}]", "approach.contacts=1", f"name='{k}'"]).mechanism
    for k in ("5e4", "9e4")
]


@pytest.fixture(scope="module")
def results():
    every = dict(tune_all(MECHANISMS, "phase_lead", SETTINGS))
    return [every[index] for index in range(len(MECHANISMS))]


@pytest.fixture(scope="module")
def made(results):
    """Return Pareto fronts, and the number of compiled programs."""
    cached_programs._programs.clear()
    every = dict(compute_fronts(results, POINTS))
    count = sum(key[0].__name__ == "_solve_call" for key in cached_programs._programs)
    return [every[index] for index in range(len(MECHANISMS))], count


def errors_of(loop, scenarios, gains):
    outcome = evaluate(loop, gains, scenarios)
    assert outcome.good[outcome.is_scheduled].all()
    return outcome.error[outcome.is_scheduled]


def test_pareto_weights_are_in_units_of_the_objective():
    light, heavy = LADDER_ENDS
    weights = build_weight_ladder(8, error=0.012, excess=3.0)
    assert weights[0] == 0
    assert 3.0 * weights[1] == pytest.approx(light * 0.012)
    assert 3.0 * weights[-1] == pytest.approx(heavy * 0.012)
    np.testing.assert_allclose(np.diff(np.log(weights[1:])), math.log(heavy / light) / 6, rtol=1e-12)
    assert build_weight_ladder(2, 0.012, 3.0) == pytest.approx([0, heavy * 0.004])
    # With almost no noise, weights still exist and are finite.
    assert np.isfinite(build_weight_ladder(8, 0.012, 0.0)).all()


def test_pareto_point_is_dominated_if_another_is_better_and_none_worse():
    places = [(0.01, 3.0), (0.02, 2.0), (0.02, 2.5), (0.03, 1.0), (0.03, 1.0), (0.04, 1.0)]
    assert find_dominated(places) == [False, False, True, False, False, True]
    generator = np.random.default_rng(0)
    places = [tuple(place) for place in generator.integers(0, 6, (60, 2)).astype(float)]
    beaten = find_dominated(places)
    for place, lost in zip(places, beaten, strict=True):
        others = [other for other, beat in zip(places, beaten, strict=True) if not beat]
        better = [o for o in others if o != place and o[0] <= place[0] and o[1] <= place[1]]
        assert bool(better) == lost


@pytest.mark.parametrize("compensator", ["phase_lead", "response_error"])
def test_pareto_noise_amplification_equals_amplification_by_lead_filter(compensator):
    mechanism = load("varying", ["rig.control_period=0.002"]).mechanism
    gains = {**literature_gains(mechanism, compensator), "phase_lead": 0.006, "lead_filter": 0.0017}
    impulse = np.zeros(3000)
    impulse[0] = 1
    response = lfilter(*bilinear([0.0077, 1], [0.0017, 1], 1 / 0.002), impulse)
    expected = np.sqrt(np.sum(response**2))
    assert compute_noise_amplification(mechanism, compensator, gains) == pytest.approx(expected, rel=1e-10)


# These compensators return the measured force unchanged.
NO_TRADE_OFF = ["none", "position_lead", "virtual_contact", "passivity", "impulse_ledger"]


def test_only_compensators_that_amplify_noise_have_a_pareto_front():
    assert {name for name in COMPENSATORS if not has_noise_trade_off(name)} == set(NO_TRADE_OFF)
    assert compute_noise_amplification(load().mechanism, "none", {}) == 1


# Fronts


@pytest.mark.slow
def test_metrics_of_every_pareto_point_equal_metrics_of_an_evaluation(results, made):
    for mechanism, result, front in zip(MECHANISMS, results, made[0], strict=True):
        seed = SETTINGS.seed + VALIDATION_SEED_OFFSET
        scenarios = build_scenarios(mechanism, draw(mechanism, SETTINGS.validation, seed), seed)
        loop = build_loop(mechanism, "phase_lead", scenarios)
        for point in (*front.points, front.literature, front.tuned):
            rms = np.sqrt(np.mean(errors_of(loop, scenarios, point.gains) ** 2))
            assert point.error == pytest.approx(rms, rel=1e-9)
            assert point.figures.rms == pytest.approx(rms, rel=1e-9)
            low, high = point.intervals.rms
            assert low < rms < high
            assert point.cost == compute_noise_amplification(mechanism, "phase_lead", point.gains)
        assert front.literature.gains == result.literature and front.tuned.gains == result.gains
        assert front.literature.figures == result.figures["literature"]
        assert front.tuned.figures == result.figures["tuned"]
        assert [point.on_front for point in front.points] == [
            not lost for lost in find_dominated([point.place for point in front.points])
        ]


@pytest.mark.slow
def test_each_pareto_point_is_best_for_its_own_noise_weight(results, made):
    for mechanism, front in zip(MECHANISMS, made[0], strict=True):
        task = build_task(mechanism, "phase_lead", SETTINGS.scenarios, SETTINGS.seed)
        every = [*front.points, front.tuned, front.literature]
        errors = [errors_of(task.loop, task.scenarios, point.gains) for point in every]
        for own, point in zip(errors[:POINTS], front.points, strict=True):
            objective = Objective(noise_weight=point.weight)
            values = [
                evaluate_objective(objective, error, None, other.cost)
                for error, other in zip(errors, every, strict=True)
            ]
            # The last step of a start is not in its history, so its value is compared exactly.
            assert evaluate_objective(objective, own, None, point.cost) <= min(values) * (1 + 2e-4)
        weights = [point.weight for point in front.points]
        assert weights[0] == 0 and weights == sorted(weights) and len(weights) == POINTS
        noise = [point.cost for point in front.points]
        assert (np.diff(noise) <= 1e-9).all() and noise[0] > 1.1 * noise[-1]
        rms = [np.sqrt(np.mean(error**2)) for error in errors[:POINTS]]
        assert (np.diff(rms) >= -2e-4 * rms[0]).all() and rms[-1] > 1.2 * rms[0]


@pytest.mark.slow
def test_pareto_searches_of_all_weights_and_mechanisms_share_one_program(made):
    assert made[1] == 1


def test_pareto_search_starts_at_gains_of_neighbouring_weights():
    result = [pareto_search._LadderCandidate({"gain": float(n)}, 0.1, 1.0) for n in (1, 2, 2, 4)]
    assert [[gains["gain"] for gains in own] for own in pareto_search._collect_neighbour_gains(result)] == [
        [1, 2],
        [2, 1],
        [2, 4],
        [4, 2],
    ]


def test_pareto_point_error_excludes_the_weighted_noise_term():
    task = build_task(MECHANISMS[0], "phase_lead", 8, 0)
    excess = compute_noise_amplification(task.mechanism, "phase_lead", task.literature) - 1
    start = pareto_search.StartResult("converged", 1, math.hypot(0.02, 0.003 * excess), [], task.literature)
    broken = start._replace(rms=math.nan)
    (one,) = pareto_search._collect_noise_candidates(task, 0.003, [broken, start])
    assert one.excess == pytest.approx(excess) and one.error == pytest.approx(0.02, rel=1e-12)
    assert one.value(0.003) == pytest.approx(start.rms, rel=1e-12)
    # If no result is usable, the literature's gains remain.
    assert pareto_search._collect_noise_candidates(task, 0.003, [broken])[0].gains == task.literature


@pytest.mark.slow
def test_pareto_search_keeps_all_objective_settings_except_noise_weight(results, monkeypatch):
    seen = []

    def solve(tasks, starts, steps, objectives, work):
        seen.append(objectives)
        return [[pareto_search.StartResult("made up", 1, 0.1, [0.1], task.literature)] for task in tasks]

    monkeypatch.setattr(pareto_search, "solve_tasks", solve)
    objective = Objective("cvar", 3.0, 0.1, 0.5, 0.2)
    settings = dataclasses.replace(SETTINGS, objective=objective)
    validation = build_validation(
        [build_task(MECHANISMS[0], "phase_lead", 8, 0)], settings.validation, settings.seed
    )
    pareto_search.solve_weight_ladders(validation, results[:1], 3, settings)
    for objectives in seen:
        assert [dataclasses.replace(one, noise_weight=0.5) for one in objectives] == [objective] * 3
    assert len(seen) == 2  # the second search has found no better gains
