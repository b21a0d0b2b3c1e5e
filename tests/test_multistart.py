"""Best gains of many tasks: scans, batches of starts until several agree, and the polishing search."""

import dataclasses

import numpy as np
import pytest
from lead_cases import lead_task, lead_tasks

from tuning.gains import multistart, scan
from tuning.gains.multistart import MAX_START_BATCHES, choose_starts, find_gains, polish_best_starts
from tuning.gains.multistart_solver import StartResult, solve_tasks
from tuning.gains.objective import RMS_OBJECTIVE, Objective
from tuning.gains.search_progress import SearchProgress
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import build_task, spread_points
from tuning.gains.validation import build_validation

SCANNED = TuneSettings().scanned
FEW = 32  # points of scans whose result is not checked


@pytest.fixture(scope="module")
def tasks():
    return lead_tasks()


@pytest.fixture(scope="module")
def validation(tasks):
    return build_validation(tasks, 15, 0)


def searched(starts, steps, polish, objective=RMS_OBJECTIVE):
    return TuneSettings(starts=starts, steps=steps, polish=polish, objective=objective, scanned=FEW)


def value(validation, index, start, objective=RMS_OBJECTIVE):
    return validation.losses(objective, [index], start.coordinates[None, None])[0, 0]


@pytest.mark.slow
def test_every_tuning_task_is_solved_with_its_own_objective(tasks, validation):
    several = [Objective(divergence_weight=weight) for weight in (1.0, 4.0, 16.0)]
    chosen = choose_starts(validation, 3, 0, several)
    polished = polish_best_starts(validation, solve_tasks(tasks, chosen, 2, several), 32, 0, several)
    for i, (objective, end) in enumerate(zip(several, polished, strict=True)):
        np.testing.assert_array_equal(chosen[i], choose_starts(validation, 3, 0, objective)[i])
        assert end is not None
        assert end.rms == pytest.approx(value(validation, i, end, objective), rel=1e-9)


def test_starting_gains_are_literature_gains_and_best_points_of_a_scan(tasks, validation):
    chosen = choose_starts(validation, 4, seed=3)
    for index, (task, points) in enumerate(zip(tasks, chosen, strict=True)):
        assert validation.gains(index, points[0]) == pytest.approx(task.literature)
        values = validation.losses(RMS_OBJECTIVE, [index], points[None])[0]
        looked_at = spread_points(points[0], SCANNED, 3)
        every = validation.losses(RMS_OBJECTIVE, [index], looked_at[None])[0]
        # The selected points differ clearly from the literature's gains and from each other.
        assert np.min(every) <= values[1] <= np.quantile(every, 0.05)
        assert (values[1:] < np.median(every)).all()
        assert (np.diff(values[1:]) >= 0).all()
        apart = np.linalg.norm(points[:, None] - points, axis=-1)[np.triu_indices(4, 1)]
        assert (apart >= 0.1 * np.sqrt(points.shape[1]) - 1e-12).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_scan_of_starting_gains_on_few_scenarios_chooses_same_points_as_full_scan(seed, monkeypatch):
    runs = []
    work = SearchProgress()
    monkeypatch.setattr(work, "report_runs", runs.append)
    task = build_task(lead_task().mechanism, "phase_lead", 32, 0)
    validation = build_validation([task], 15, 0, work)
    chosen = choose_starts(validation, 4, seed)[0]
    completed, runs[:] = sum(runs), []
    monkeypatch.setattr(scan, "_is_sum_of_squares", lambda *_: False)
    np.testing.assert_array_equal(chosen, choose_starts(validation, 4, seed)[0])
    assert completed < 0.8 * sum(runs)


@pytest.mark.slow
def test_best_optimisation_result_is_refined_by_polishing_search(tasks, validation):
    early = solve_tasks(tasks, choose_starts(validation, 3, 0), 1)
    early[1] = [start._replace(rms=np.nan) for start in early[1]]
    polished = polish_best_starts(validation, early, 128, seed=0)
    for index, (own, result) in enumerate(zip(early, polished, strict=True)):
        if index == 1:
            assert result is None
            continue
        assert result is not None
        best = min(own, key=lambda start: start.rms)
        assert result.rms < best.rms
        assert result.rms == pytest.approx(value(validation, index, result), rel=1e-12)
        assert result.gains == validation.gains(index, result.coordinates)
    failed = [[own[0]._replace(rms=np.nan)] for own in early]
    assert polish_best_starts(validation, failed, 64, seed=0) == [None] * 3


@pytest.mark.slow
def test_further_batches_of_starts_run_until_several_optima_agree(tasks, validation, monkeypatch):
    asked = []

    def solve(tasks, starts, steps, objective, work):
        asked.append([len(own) for own in starts])
        ended = solve_tasks(tasks, starts, 1, objective)
        batch = len(asked)
        return [
            [s._replace(rms=0.1 if i != 1 else 0.1 * 0.9**batch * 1.2**n) for n, s in enumerate(own)]
            for i, own in enumerate(ended)
        ]

    monkeypatch.setattr(multistart, "solve_tasks", solve)
    heard, shares = [], []

    def tell(text, share, kept):
        heard.append(text)
        shares.append(share)

    validation_observed = build_validation(tasks, 15, 0, SearchProgress(tell))
    result = find_gains(validation_observed, searched(3, 9, 16))
    assert asked == [[3, 3, 3]] + [[0, 3, 0]] * (MAX_START_BATCHES - 1)
    assert [len(one.starts) for one in result] == [3, 3 * MAX_START_BATCHES, 3]
    assert len({text for text in heard if "batch" in text}) == MAX_START_BATCHES - 1
    assert all(0 <= share <= 1 for share in shares) and shares[-1] == 1
    points = np.stack([start.coordinates for start in result[1].starts])
    assert len(np.unique(points, axis=0)) == len(points)
    # Steps cost 1 + 2 evaluations; the scan runs at full cost on at most 32 scenarios; 2 gains are polished.
    assert result[0].evaluations == FEW + 3 * 3 + 32
    assert result[1].evaluations == MAX_START_BATCHES * (FEW + 3 * 3) + 32


def test_single_start_uses_literature_gains_and_polishing_search(tasks, validation):
    result = find_gains(validation, searched(1, 2, 32))
    for index, one in enumerate(result):
        (start,) = one.starts
        assert one.best is not None and one.best.rms <= start.rms
        assert one.evaluations == 3 * start.steps + 64
        assert one.best.rms == pytest.approx(value(validation, index, one.best), rel=1e-9)


def test_callback_runs_once_while_the_solver_compiles(validation, monkeypatch):
    done = []
    monkeypatch.setattr(multistart, "solve_tasks", lambda *_: done.append("round") or [[], [], []])
    monkeypatch.setattr(multistart, "lower_solver", lambda *_: lambda: None)
    monkeypatch.setattr(multistart, "program_folder", lambda: "somewhere")
    find_gains(validation, searched(1, 2, 0), meanwhile=lambda: done.append("other"))
    assert done == ["other", "round"]


@pytest.mark.slow
def test_best_start_is_selected_by_true_objective_instead_of_surrogate_norm(tasks, validation):
    objective = Objective("cvar")
    for index, one in enumerate(find_gains(validation, searched(3, 4, 16, objective))):
        assert one.best is not None
        values = [value(validation, index, start, objective) for start in one.starts]
        assert [start.rms for start in one.starts] == pytest.approx(values, rel=1e-12)
        assert one.best.rms == pytest.approx(value(validation, index, one.best, objective), rel=1e-12)
        assert one.best.rms <= min(values)


@pytest.mark.slow
def test_failed_tuning_task_does_not_affect_best_gains_of_other_tasks(tasks, validation):
    broken = tasks[1].scenarios._replace(equivalent_mass=np.full(8, np.nan))
    sick = build_validation([tasks[0], dataclasses.replace(tasks[1], scenarios=broken), tasks[2]], 15, 0)
    result, healthy = (find_gains(one, searched(3, 2, 16)) for one in (sick, validation))
    for index in (0, 2):
        mine, theirs = result[index].best, healthy[index].best
        assert mine is not None and theirs is not None
        assert mine.rms == pytest.approx(theirs.rms, rel=1e-6)


class Kinked:
    """Validation of two gains x and y, whose objective has a kink along x = y."""

    def losses(self, objective, which, points):
        x, y = points[..., 0], points[..., 1]
        return 1 + 20 * np.abs(y - x) + (x - 0.8) ** 2

    def gains(self, task, coordinates):
        return {"x": float(coordinates[0]), "y": float(coordinates[1])}


def test_only_stuck_optimisation_is_continued_by_polishing_search():
    corner, best = np.array([0.3, 0.3]), np.array([0.8, 0.8])
    starts = [
        StartResult("converged", 3, 1.0, [1.0], {"x": 0.8, "y": 0.8}, best),
        StartResult("converged", 3, 1.25, [1.25], {"x": 0.3, "y": 0.3}, corner),
        StartResult("failed", 3, np.nan, [], {}, corner),
    ]
    freed, evaluations = multistart._restart_stuck_starts(Kinked(), 0, starts, 0.02, 0, RMS_OBJECTIVE)  # pyright: ignore[reportArgumentType]
    assert freed[0] is starts[0] and freed[2] is starts[2]
    assert freed[1].rms < 1.02 and freed[1].history == [1.25, freed[1].rms]
    assert freed[1].gains == {"x": freed[1].coordinates[0], "y": freed[1].coordinates[1]}
    assert evaluations == multistart.CANDIDATES_PER_GENERATION * multistart.RESTART_GENERATIONS
    assert multistart._restart_stuck_starts(Kinked(), 0, starts[:1], 0.02, 0, RMS_OBJECTIVE) == (
        starts[:1],
        0,
    )  # pyright: ignore[reportArgumentType]
