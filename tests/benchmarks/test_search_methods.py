"""Tuning compared with other optimisers, on the same loss with the same time for each start.

Every method tunes the same mechanisms of the family from the same starts. A start succeeds if it ends within
1 % of the best loss of all methods. The success rates, rollouts and times until success are compared. The
times exclude compilation. Run with `pytest -m benchmark -s tests/benchmarks/test_search_methods.py`, for a
few mechanisms with `-k "03 or 48 or fewer"`.
"""

import os

import jax
import numpy as np
import pytest
from family import family
from lanes import QUICK
from search_case import CAPACITY, Case, build_cases, several
from search_methods import OTHERS, Recorder, TimeIsUp, Trace, record
from search_ours import ours, warm_up
from search_table import Results, medians, rate_methods, ratios, table

from tuning.gains.objective import RESIDUAL_SCALE, RMS_OBJECTIVE, compute_residuals, join_terms

pytestmark = pytest.mark.benchmark

# Contact frequencies from 1.4 to 6.2 Hz, every contact law, fast and slow simulators, one undamped (19).
MEMBERS = 3, 8, 9, 18, 19, 20, 37, 48
STARTS = 8
SEED = 0  # seed of the starts
BUDGET = 1.0  # time limit of other optimisers, divided by the time of tuning
# limits: smallest share of successful starts; largest cost relative to the best other method
SHARE, COST = 0.9, 0.5

NAMES = [mechanism.name for i, mechanism in enumerate(family()) if i in MEMBERS]


@pytest.fixture(scope="module")
def cases() -> dict[str, Case]:
    # Build all cases, so that a mechanism's program does not depend on the selection.
    every = family()
    return {case.name: case for case in build_cases([every[i] for i in MEMBERS])}


@pytest.fixture(scope="module")
def compared() -> dict[str, Results]:
    return {}


@pytest.mark.parametrize("name", NAMES)
def test_success_and_cost_of_optimisers_are_compared_on_one_mechanism(name, cases, compared, capsys):
    case = cases[name]
    starts = case.starts(STARTS, SEED)
    case.warm_up()
    warm_up(case, starts)
    traces = {"ours": ours(case, starts)} | {method: [] for method in OTHERS}
    seconds = BUDGET * traces["ours"][0].seconds[-1]
    for seed, start in enumerate(starts):
        # Run the optimisers alternately, so that other load on the machine affects all of them.
        for method, function in OTHERS.items():
            traces[method].append(record(function, case.losses, start, seed, seconds))
    best, compared[name] = rate_methods(traces)
    with capsys.disabled():
        print(
            f"\n\n{name}: {len(case.names)} gains, {STARTS} starts, {seconds:.2f} s for each;"
            f" best rms error {RESIDUAL_SCALE * np.sqrt(2 * best):.3g}; {os.getloadavg()[0]:.1f} processes on"
            f" {os.cpu_count()} cores\n{table(compared[name])}"
        )


def test_tuning_needs_fewer_rollouts_than_other_optimisers(compared, capsys):
    if not compared:
        pytest.skip("no mechanism has been compared")
    middle = medians(list(compared.values()))
    share = float(np.median([one["ours"].share for one in compared.values()]))
    rollouts, seconds = ratios(middle["ours"], [middle[method] for method in OTHERS])
    with capsys.disabled():
        print(
            f"\n\nmedians over {len(compared)} mechanisms\n{table(middle)}\n"
            f"ours succeeds from {share:.0%} of its starts, in the median (bar: {SHARE:.0%}), with"
            f" {rollouts:.2f} of the rollouts and {seconds:.2f} of the seconds of the best of the others"
            f" (bar: {COST})"
        )
    assert share >= SHARE
    assert rollouts <= COST
    assert seconds <= COST


def test_compared_optimisers_and_tuning_minimise_the_same_loss(cases):
    for case in {(case.loop, case.names): case for case in cases.values()}.values():
        points = case.starts(5, 1)
        together = case.losses(points)
        np.testing.assert_allclose([case.losses(point[None])[0] for point in points], together, rtol=1e-9)
        gains, static = case.gains_of(points), (case.loop, case.names, join_terms([RMS_OBJECTIVE]))
        problems = several(case.problem, len(points))
        rows = jax.jit(compute_residuals, static_argnums=0, compiler_options=QUICK)(static, gains, problems)
        np.testing.assert_allclose(together, np.sum(np.asarray(rows) ** 2, axis=1) / 2, rtol=1e-9)
        np.testing.assert_allclose(case.shares_of(gains), points, atol=1e-12)
        many = np.resize(points, (CAPACITY + 3, points.shape[1]))
        np.testing.assert_allclose(case.losses(many), np.resize(together, len(many)), rtol=1e-9)


def bowl(points):
    """Return a quadratic with minimum 1 at a coordinate of 0.3 for every gain."""
    assert (points >= 0).all() and (points <= 1).all()
    return 1 + np.sum((points - 0.3) ** 2, axis=-1)


@pytest.mark.parametrize("method", OTHERS)
def test_every_optimiser_minimises_a_quadratic_from_its_starting_point(method):
    start = np.full(4, 0.31)
    trace = record(OTHERS[method], bowl, start, 0, 0.5)
    assert trace.loss[0] <= bowl(start) + (0.35 if method == "Nelder-Mead" else 0)
    assert trace.loss[-1] < 1.0005
    assert (np.diff(trace.loss) <= 0).all() and (np.diff(trace.seconds) > 0).all()
    assert (np.diff(trace.rollouts) >= 1).all()
    # The last call that counts begins before the time limit.
    assert trace.seconds[-2] < 0.5 and trace.seconds[-1] > 0.4


def test_recorder_counts_rollouts_and_stops_optimiser_at_time_limit():
    recorder = Recorder(bowl, 1e3)
    recorder(np.full((3, 2), 0.5))
    recorder(np.array([[0.3, 0.3]]))
    recorder(np.full((4, 2), 0.9))
    trace = recorder.trace
    np.testing.assert_array_equal(trace.rollouts, [3, 4, 8])
    np.testing.assert_allclose(trace.loss, [1.08, 1, 1])
    with pytest.raises(TimeIsUp):
        Recorder(bowl, 0.0)(np.full((1, 2), 0.5))


def test_expected_cost_is_median_cost_divided_by_success_rate():
    def trace(*losses):
        calls = np.arange(1, 1 + len(losses))
        return Trace(10.0 * calls, 0.5 * calls, np.array(losses))

    best, success = rate_methods(
        {
            "ours": [trace(5, 2.01, 2), trace(2.02, 2.02, 2.02), trace(9, 9, 9), trace(3, 2.03, 2.021)],
            "theirs": [trace(3, 3)],
        }
    )
    assert best == 2
    # Two starts come within 1 % of the best, after 20 and after 10 rollouts.
    assert success["ours"].share == 0.5
    assert success["ours"].rollouts == 30 and success["ours"].seconds == 1.5
    assert success["theirs"].share == 0 and success["theirs"].rollouts == np.inf
    assert success["theirs"].best == success["theirs"].median == 1.5
    assert ratios(success["ours"], [success["theirs"]]) == (0, 0)
    assert ratios(success["theirs"], [success["ours"]]) == (np.inf, np.inf)
