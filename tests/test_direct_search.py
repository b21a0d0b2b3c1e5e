"""Search for gains without derivatives: objective, bound of the error, starts, no compiled solver."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from lead_cases import lead_tasks

from jaxhil.laws.compensators import COMPENSATORS
from tuning.gains import multistart, multistart_solver, pareto_search
from tuning.gains.direct_search import CANDIDATES_PER_GENERATION, estimate_direct_runs
from tuning.gains.multistart import estimate_search_runs, find_gains
from tuning.gains.objective import BOUND_PENALTY, Objective, evaluate_objective
from tuning.gains.settings import TuneSettings
from tuning.gains.validation import build_validation

STEPS = 6
NOISE = Objective(noise_weight=2.0)  # with this weight, less noise is worth a larger error


@pytest.fixture(scope="module")
def validation():
    return build_validation(lead_tasks(), 15, 0)


@pytest.fixture
def direct(monkeypatch):
    """Tune phase lead without derivatives, and fail if the solver is used."""
    monkeypatch.setattr(type(COMPENSATORS["phase_lead"]), "tuned_without_derivatives", True)
    solvers = (multistart, "solve_tasks"), (multistart_solver, "lower_solver"), (pareto_search, "solve_tasks")
    for module, name in solvers:
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("the solver was called"))


def settings(objective, bounded=False):
    return TuneSettings(steps=STEPS, objective=objective, bounded=bounded)


def value(validation, index, coordinates, objective):
    return validation.losses(objective, [index], coordinates[None, None])[0, 0]


def test_direct_search_improves_literature_gains_of_every_task_without_solver(validation, direct):
    called = []
    results = find_gains(validation, settings(NOISE), meanwhile=lambda: called.append("baselines"))
    assert called == ["baselines"]
    for index, result in enumerate(results):
        (start,) = result.starts
        assert start is result.best and start.steps == STEPS
        assert result.evaluations == STEPS * CANDIDATES_PER_GENERATION
        literature = validation.coordinates(index, [validation.tasks[index].literature])[0]
        assert start.rms < value(validation, index, literature, NOISE)
        assert start.rms == start.history[-1] == value(validation, index, start.coordinates, NOISE)
        assert (np.diff(start.history) <= 0).all()
        assert start.gains == validation.gains(index, start.coordinates)
    runs = estimate_search_runs(validation.tasks, settings(NOISE))
    assert runs == estimate_direct_runs(validation.tasks, STEPS) == 3 * 8 * results[0].evaluations


def test_direct_search_also_starts_from_earlier_gains(validation, direct):
    earlier = [[{**task.literature, "phase_lead": 0.006}] for task in validation.tasks]
    for result in find_gains(validation, settings(NOISE), earlier):
        assert result.best is min(result.starts, key=lambda start: start.rms)
        assert len(result.starts) == 2 and result.evaluations == 2 * STEPS * CANDIDATES_PER_GENERATION


def test_bounded_direct_search_keeps_error_of_initial_gains(validation, direct):
    accurate = [result.best.gains for result in find_gains(validation, settings(Objective()))]
    tasks = [replace(task, literature=gains) for task, gains in zip(validation.tasks, accurate, strict=True)]
    begun = replace(validation, tasks=tasks)
    free, bounded = (find_gains(begun, settings(NOISE, is_bounded)) for is_bounded in (False, True))
    for index, gains in enumerate(accurate):
        largest = value(begun, index, begun.coordinates(index, [gains])[0], Objective())
        errors = [
            value(begun, index, results[index].best.coordinates, Objective()) for results in (free, bounded)
        ]
        assert errors[1] <= 1.001 * largest < errors[0]
        assert bounded[index].objective.error_bound == pytest.approx(largest, rel=1e-12)


def test_pareto_search_without_derivatives_improves_every_weight_without_solver(
    validation, direct, monkeypatch
):
    monkeypatch.setattr(pareto_search, "MAX_NEIGHBOUR_SEARCHES", 1)
    brief = replace(settings(Objective()), steps=2)
    searched = find_gains(validation, brief)
    tuned = [SimpleNamespace(starts=result.starts, gains=result.best.gains) for result in searched]
    ladders = pareto_search.solve_weight_ladders(validation, tuned, 3, brief)
    for index, ladder in enumerate(ladders):
        assert ladder[0][0] == 0.0
        for weight, gains in ladder[1:]:
            points = validation.coordinates(index, [tuned[index].gains, gains])
            before, after = (value(validation, index, x, Objective(noise_weight=weight)) for x in points)
            assert after <= before
        assert after < before  # at the largest weight
    runs = pareto_search.estimate_ladder_runs(validation.tasks, 3, brief)
    assert runs == 2 * 3 * estimate_direct_runs(validation.tasks, brief.steps)


def test_objective_above_its_error_bound_has_a_penalty():
    errors, excess = np.array([[0.003, -0.004], [0.03, -0.04]]), np.full((2, 2), 0.5)
    plain = Objective(command_weight=0.3)
    free, bounded = (
        evaluate_objective(objective, errors, excess)
        for objective in (plain, replace(plain, error_bound=0.02))
    )
    beyond = np.sqrt((0.03**2 + 0.04**2) / 2) - 0.02
    np.testing.assert_allclose(bounded - free, [0, BOUND_PENALTY * beyond], rtol=1e-12)
