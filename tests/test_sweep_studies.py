"""Studies of a sweep: sensitivities of the error and rare failures, compared with brute force."""

import numpy as np
import pytest
from sweep_cases import NOISY, UNCERTAIN, case, manifest

from jaxhil.mechanism.uncertainty import count_dimensions
from tuning.statistics.sobol_indices import count_evaluations
from tuning.sweeps.chunks import build_sweep, run_chunk
from tuning.sweeps.point_batches import PointRunSettings, run_points
from tuning.sweeps.studies import (
    NOISE_INPUT,
    compute_error_indices,
    estimate_rare_failure,
    group_independent_inputs,
    is_spread_beyond_formula,
)
from tuning.sweeps.tally import (
    add_to_tally,
    build_empty_tally,
    compute_error_sizes,
    estimate_failure_probability,
)

pytestmark = pytest.mark.users_options

# The error of a linear contact does not depend on its approach speed.
IDLE = {"approach.velocity": {"distribution": "uniform", "factor": [0.5, 2.0]}}


def sweep_of(document, **choices):
    return build_sweep(manifest(document, **{"scenarios": 2048, "chunk": 1024, **choices}))


@pytest.fixture(scope="module")
def complete_sweep():
    """Return a sweep with an input that has no effect, and the rows of all its scenarios."""
    sweep = sweep_of(case(uncertainty=UNCERTAIN | IDLE))
    halves = [run_chunk(sweep, first, 1024) for first in (0, 1024)]
    return sweep, {name: np.concatenate([half[name] for half in halves]) for name in halves[0]}


def test_input_without_effect_has_zero_sensitivity_index(complete_sweep):
    sweep, _ = complete_sweep
    ran = []
    result = compute_error_indices(sweep, 128, PointRunSettings(ran.append))
    assert result.evaluations == sum(ran) == count_evaluations(4, 128) == 768
    assert {one.input for one in result.inputs} == set(count_dimensions(sweep.mechanism))
    totals = [one.total for one in result.inputs]
    assert totals == sorted(totals, reverse=True)
    idle = next(one for one in result.inputs if one.input == "approach.velocity")
    assert idle.total_low <= 1e-9 and idle.total_high < 1e-6 and abs(idle.first_order) < 1e-3
    first, *_ = result.inputs
    assert first.input == "contact.stiffness" and first.total_low > 0.5
    assert first.first_order_low <= first.first_order <= first.first_order_high


def test_single_uncertain_input_has_sensitivity_index_1():
    # One input besides the phase: law of total variance by brute force, with phase means in cells.
    sweep = sweep_of(case(uncertainty={"contact.stiffness": UNCERTAIN["contact.stiffness"]}))
    result = {one.input: one for one in compute_error_indices(sweep, 256).inputs}
    cells = (np.arange(64) + 0.5) / 64
    grid = np.stack([axis.ravel() for axis in np.meshgrid(cells, cells, indexing="ij")], axis=1)
    sizes = compute_error_sizes(run_points(sweep, grid, np.zeros(len(grid)))).reshape(64, 64)
    assert np.max(sizes) < 10  # the cap
    share = np.var(np.mean(sizes, axis=1)) / np.var(sizes)
    stiffness, phase = result["contact.stiffness"], result["approach.phase"]
    assert stiffness.first_order_low < share < stiffness.first_order_high
    assert phase.total_low < 1 - share < phase.total_high


def test_correlated_inputs_have_a_joint_sensitivity_index():
    table = {"keys": ["rig.force_sensor.delay", "approach.velocity"], "matrix": [[1.0], [0.9, 1.0]]}
    apart = sweep_of(case(uncertainty=UNCERTAIN | IDLE))
    together = sweep_of(case(uncertainty=UNCERTAIN | IDLE, correlation=table))
    inputs = group_independent_inputs(together.mechanism)
    assert {name: columns.tolist() for name, columns in inputs.items()} == {
        "rig.force_sensor.delay + approach.velocity": [2, 0],
        "contact.stiffness": [1],
        "approach.phase": [3],
    }
    # The velocity has no effect in linear contact, so the correlated pair has the delay's index.
    joint, *others = sorted(
        compute_error_indices(together, 128).inputs, key=lambda one: "delay" not in one.input
    )
    assert joint.input == "rig.force_sensor.delay + approach.velocity" and len(others) == 2
    alone = next(one for one in compute_error_indices(apart, 128).inputs if "delay" in one.input)
    assert alone.total_low < joint.total < alone.total_high


def test_sensor_noise_is_an_input_of_the_sensitivity_study():
    document = case(force_sensor=NOISY, uncertainty={"bodies.equivalent_mass": TIGHT})
    result = compute_error_indices(sweep_of(document), 64)
    shares = {one.input: one for one in result.inputs}
    assert result.evaluations == 64 * 5 and shares.keys() == {
        "bodies.equivalent_mass",
        "approach.phase",
        NOISE_INPUT,
    }
    assert shares[NOISE_INPUT].total_low > 0.1 and result.inputs[0].input != "bodies.equivalent_mass"
    assert shares["bodies.equivalent_mass"].total_high < 1e-3
    # Without sensor noise, the noise is not among the inputs.
    quiet = compute_error_indices(sweep_of(case(uncertainty={"bodies.equivalent_mass": TIGHT})), 64)
    assert NOISE_INPUT not in {one.input for one in quiet.inputs}


TIGHT = {"distribution": "uniform", "factor": [0.99999, 1.00001]}


def test_sensitivity_study_replaces_errors_above_the_cap_by_the_cap(complete_sweep):
    _, rows = complete_sweep
    limit = float(np.quantile(np.abs(rows["worst_error"]), 0.5)) / 10
    limited = sweep_of(case(uncertainty=UNCERTAIN | IDLE), limit=limit)
    result = compute_error_indices(limited, 128)
    assert result.cap == 10 * limit
    assert 0.4 < result.capped / result.evaluations < 0.6


@pytest.mark.parametrize("share", [0.2, 0.05])
def test_rare_failure_probability_agrees_with_sweep(complete_sweep, share):
    sweep, rows = complete_sweep
    limit = float(np.quantile(np.abs(rows["worst_error"]), 1 - share))
    rows = {**rows, "outcome": (np.abs(rows["worst_error"]) > limit).astype(np.int8)}
    counted = add_to_tally(build_empty_tally(1), {**rows, "failed": rows["outcome"] > 0})
    brute = estimate_failure_probability(counted)
    result = estimate_rare_failure(sweep, limit, samples=200, replicates=6)
    assert brute.value == pytest.approx(share, abs=1e-3)
    assert result.low < brute.high and brute.low < result.high
    assert result.low < result.probability < result.high
    assert not is_spread_beyond_formula(result)
    assert is_spread_beyond_formula(result._replace(coefficient_of_variation=0.9))


def test_rare_failure_estimate_is_reproducible(complete_sweep):
    sweep, rows = complete_sweep
    limit = float(np.quantile(np.abs(rows["worst_error"]), 0.97))
    first, again = (estimate_rare_failure(sweep, limit, samples=50, replicates=2) for _ in range(2))
    np.testing.assert_array_equal(first.estimates, again.estimates)


def test_saturated_runs_count_as_failures_for_any_error_limit():
    # The force sensor reads only a small part of the force.
    sweep = sweep_of(case(force_sensor={"range": 1e-3}), chunk=64)
    assert estimate_rare_failure(sweep, 1e9, samples=20, replicates=2).probability == 1


def test_study_point_results_do_not_depend_on_the_chunk(complete_sweep):
    sweep, _ = complete_sweep
    points = np.random.default_rng(1).random((40, 4))
    one = run_points(sweep, points, np.arange(40))
    other = run_points(sweep_of(case(uncertainty=UNCERTAIN | IDLE), chunk=16), points, np.arange(40))
    np.testing.assert_array_equal(one["worst_error"], other["worst_error"])
