"""Many problems through one program: the same optima as alone, hopeless starts left, bad ones harmless."""

import numpy as np
import pytest

from jaxhil.evaluation import evaluate
from jaxhil.mechanism_file import load
from tuning import rounds
from tuning.objective import RMS, Objective, objective_value
from tuning.problems import alike, build_task
from tuning.rounds import GIVEN_UP, solve_tasks

STARTS, STEPS = 5, 14
# Stiff, soft, and one that times out at the literature's gains.
OVERRIDES = (["contact.stiffness=[1e5]"], ["contact.stiffness=[4e4]"], ["contact.stiffness=[2e5]"])


@pytest.fixture(scope="module")
def tasks():
    mechanisms = [load("rig-300kg", [*own, f"name=m{i}"]).mechanism for i, own in enumerate(OVERRIDES)]
    return [build_task(mechanism, "phase_lead", 8, 0) for mechanism in mechanisms]


@pytest.fixture(scope="module")
def solved(tasks):
    assert alike([task.loop for task in tasks], [task.scenarios for task in tasks]) == [[0, 1, 2]]
    return solve_tasks(tasks, STARTS, STEPS, 0)


def test_every_start_is_accounted_for(solved):
    for starts in solved:
        assert len(starts) == STARTS
        for start in starts:
            assert len(start.history) == start.steps <= STEPS
            assert (np.diff(start.history) <= 0).all()
            assert start.rms == start.history[-1]
        left = [start for start in starts if start.status == GIVEN_UP]
        went_on = [start for start in starts if start.steps > rounds.FIRST_ROUND]
        assert len(left) <= STARTS - rounds.PROMISING
        assert all(start.steps == rounds.FIRST_ROUND for start in left)
        for start in left:
            assert all(start.rms >= other.history[rounds.FIRST_ROUND - 1] for other in went_on)
    assert any(start.status == GIVEN_UP for starts in solved for start in starts)


def test_each_task_ends_as_it_does_alone(tasks, solved):
    for task, together in zip(tasks, solved, strict=True):
        (alone,) = solve_tasks([task], STARTS, STEPS, 0)
        best = min(start.rms for start in alone)
        assert min(start.rms for start in together) == pytest.approx(best, rel=1e-6)


def test_a_task_that_fails_harms_no_other(tasks, solved):
    broken = tasks[1].scenarios._replace(equivalent_mass=np.full(8, np.nan))
    sick = rounds.dataclasses.replace(tasks[1], scenarios=broken)
    starts = solve_tasks([tasks[0], sick, tasks[2]], STARTS, STEPS, 0)
    for i in (0, 2):
        assert [start.gains for start in starts[i]] == [start.gains for start in solved[i]]
    assert all(start.rms == pytest.approx(3.0) or not np.isfinite(start.rms) for start in starts[1])


def test_the_objective_is_what_is_lowered(tasks):
    """Where a squared divergence counts 16 times, less diverges; both objectives in one call."""
    objectives = [RMS, Objective(divergence_weight=16.0)]
    plain, cautious = (
        min(starts, key=lambda start: start.rms)
        for starts in solve_tasks([tasks[0], tasks[0]], 2, STEPS, 0, objectives)
    )
    errors = [restitution_errors_of(tasks[0], start.gains) for start in (plain, cautious)]
    for start, objective, own in zip((plain, cautious), objectives, errors, strict=True):
        # The last step, shorter than the solver's tolerance, is not in the history.
        assert start.rms == pytest.approx(objective_value(objective, own), rel=1e-4)
    assert np.maximum(errors[1], 0).sum() < np.maximum(errors[0], 0).sum()


def restitution_errors_of(task, gains):
    outcome = evaluate(task.loop, gains, task.scenarios)
    assert outcome.good[outcome.wanted].all()
    return outcome.error[outcome.wanted]
