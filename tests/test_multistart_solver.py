"""Many problems in one program: same optima as in separate programs, even if one problem fails."""

import numpy as np
import pytest
from lead_cases import lead_tasks

from jaxhil.simulation.one_axis import evaluate
from tuning.gains import multistart_solver
from tuning.gains.multistart_solver import GIVEN_UP, solve_tasks
from tuning.gains.objective import RMS_OBJECTIVE, Objective, evaluate_objective
from tuning.gains.tasks import build_gain_bounds, group_by_program, list_tuned_gains, spread_points
from tuning.gains.validation import build_validation
from tuning.optimisation.unit_box import to_coordinates

STARTS, STEPS = 5, 14


@pytest.fixture(scope="module")
def tasks():
    return lead_tasks()


def spread(tasks, number=STARTS):
    """Return the literature's gains and points around these gains."""
    names = list_tuned_gains(tasks)
    starts = []
    for task in tasks:
        first = np.array([task.literature[name] for name in names])
        starts.append(spread_points(to_coordinates(first, build_gain_bounds(task, names)), number, 0))
    return starts


@pytest.fixture(scope="module")
def solved(tasks):
    assert group_by_program([task.loop for task in tasks], [task.scenarios for task in tasks]) == [[0, 1, 2]]
    return solve_tasks(tasks, spread(tasks), STEPS)


@pytest.fixture(scope="module")
def validation(tasks):
    return build_validation(tasks, 15, 0)


@pytest.mark.slow
def test_every_optimisation_start_has_history_and_status(solved):
    for starts in solved:
        assert len(starts) == STARTS
        for start in starts:
            assert len(start.history) == start.steps <= STEPS
            assert (np.diff(start.history) <= 0).all()
            assert start.rms == start.history[-1]
        dropped = [start for start in starts if start.status == GIVEN_UP]
        went_on = [start for start in starts if start.steps > multistart_solver.STEPS_BEFORE_SELECTION]
        assert len(dropped) <= STARTS - multistart_solver.MAX_CONTINUED_STARTS
        assert all(start.steps == multistart_solver.STEPS_BEFORE_SELECTION for start in dropped)
        for start in dropped:
            assert all(
                start.rms >= other.history[multistart_solver.STEPS_BEFORE_SELECTION - 1] for other in went_on
            )
    assert any(start.status == GIVEN_UP for starts in solved for start in starts)


def test_every_task_of_a_batch_reaches_the_optimum_of_a_separate_run(tasks, solved):
    for task, together in zip(tasks, solved, strict=True):
        (alone,) = solve_tasks([task], spread([task]), STEPS)
        best = min(start.rms for start in alone)
        assert min(start.rms for start in together) == pytest.approx(best, rel=1e-6)


def test_failed_task_does_not_change_results_of_other_tasks(tasks, solved):
    broken = tasks[1].scenarios._replace(equivalent_mass=np.full(8, np.nan))
    sick = multistart_solver.dataclasses.replace(tasks[1], scenarios=broken)
    starts = solve_tasks([tasks[0], sick, tasks[2]], spread(tasks), STEPS)
    for i in (0, 2):
        assert [start.gains for start in starts[i]] == [start.gains for start in solved[i]]
    assert all(start.rms == pytest.approx(3.0) or not np.isfinite(start.rms) for start in starts[1])


def test_solver_reduces_the_requested_objective(tasks):
    objectives = [RMS_OBJECTIVE, Objective(divergence_weight=16.0)]
    plain, cautious = (
        min(starts, key=lambda start: start.rms)
        for starts in solve_tasks([tasks[0], tasks[0]], spread([tasks[0], tasks[0]], 2), STEPS, objectives)
    )
    errors = [restitution_errors_of(tasks[0], start.gains) for start in (plain, cautious)]
    for start, objective, own in zip((plain, cautious), objectives, errors, strict=True):
        assert start.rms == pytest.approx(evaluate_objective(objective, own), rel=1e-9)
    assert np.maximum(errors[1], 0).sum() < np.maximum(errors[0], 0).sum()


def test_global_search_uses_the_objective_of_the_solver(tasks, solved, validation):
    for index, starts in enumerate(solved):
        coordinates = np.stack([start.coordinates for start in starts])
        values = validation.losses(RMS_OBJECTIVE, [index], coordinates[None])[0]
        np.testing.assert_allclose(values, [start.rms for start in starts], rtol=1e-9)
        alone = evaluate(tasks[index].loop, starts[0].gains, tasks[index].scenarios)
        assert values[0] == pytest.approx(
            evaluate_objective(RMS_OBJECTIVE, alone.error[alone.is_scheduled]), rel=1e-9
        )


def test_global_search_evaluates_every_task_with_its_own_objective(tasks, validation):
    several = [Objective(divergence_weight=4.0), Objective(noise_weight=0.01), Objective(noise_weight=0.1)]
    points = np.random.default_rng(0).random((2, 5, 2))
    together = validation.losses(several, [2, 0], points)
    for i, task in enumerate([2, 0]):
        np.testing.assert_array_equal(
            together[i], validation.losses(several[task], [task], points[i : i + 1])[0]
        )
        assert (
            np.abs(together[i] / validation.losses(RMS_OBJECTIVE, [task], points[i : i + 1])[0] - 1) > 1e-4
        ).any()


def restitution_errors_of(task, gains):
    outcome = evaluate(task.loop, gains, task.scenarios)
    assert outcome.good[outcome.is_scheduled].all()
    return outcome.error[outcome.is_scheduled]


def test_tasks_with_long_simulations_are_spread_evenly_over_devices():
    np.testing.assert_array_equal(multistart_solver.assign_to_devices(8), [0, 2, 4, 6, 1, 3, 5, 7])
    np.testing.assert_array_equal(multistart_solver.assign_to_devices(3), [0, 1, 2])
