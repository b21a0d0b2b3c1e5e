"""Sobol indices compared with closed forms: Ishigami function, linear function, inputs of several columns."""

import numpy as np
import pytest
from scipy import stats

from tuning.statistics.sobol_indices import count_evaluations, saltelli_design, sobol_indices


def ishigami(uniform):
    x, y, z = np.pi * (2.0 * uniform.T - 1.0)
    return np.sin(x) + 7.0 * np.sin(y) ** 2 + 0.1 * z**4 * np.sin(x)


_BY_X = 0.5 * (1 + 0.1 * np.pi**4 / 5) ** 2
_BY_Y = 7.0**2 / 8
_BY_XZ = 0.01 * np.pi**8 * (1 / 18 - 1 / 50)
_ISHIGAMI = _BY_X + _BY_Y + _BY_XZ
WEIGHTS = np.array([4.0, 2.0, 1.0, 0.1, 0.0])
SHARES = WEIGHTS**2 / np.sum(WEIGHTS**2)
CASES = {
    "ishigami": (
        ishigami,
        np.array([_BY_X, _BY_Y, 0.0]) / _ISHIGAMI,
        np.array([_BY_X + _BY_XZ, _BY_Y, _BY_XZ]) / _ISHIGAMI,
    ),
    "linear": (lambda uniform: 1e6 + uniform @ WEIGHTS, SHARES, SHARES),
}


def estimates(case, number, seed):
    function, first_order, _ = CASES[case]
    inputs = len(first_order)
    return sobol_indices(function(saltelli_design(inputs, number, seed)), inputs, number, seed=seed)


@pytest.mark.parametrize("case", CASES)
def test_sobol_indices_agree_with_closed_forms(case):
    _, first_order, total = CASES[case]
    indices = estimates(case, 4096, seed=0)
    np.testing.assert_allclose(indices.first_order.value, first_order, rtol=0, atol=3e-3)
    np.testing.assert_allclose(indices.total.value, total, rtol=0, atol=3e-3)
    for interval, truth in ((indices.first_order, first_order), (indices.total, total)):
        assert np.all((interval.low <= truth) & (truth <= interval.high)) and np.all(interval.width < 0.1)


def test_sobol_estimates_equal_those_of_scipy():
    values = ishigami(saltelli_design(3, 512, seed=1))
    a, b, mixed = values[None, :512], values[None, 512:1024], values[1024:].reshape(3, 1, 512)
    expected = stats.sobol_indices(func={"f_A": a, "f_B": b, "f_AB": mixed}, n=512)
    indices = sobol_indices(values, 3, 512)
    np.testing.assert_allclose(indices.first_order.value, expected.first_order, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(indices.total.value, expected.total_order, rtol=1e-9)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("number", (64, 256))
def test_sobol_index_intervals_have_stated_coverage(case, number, capsys):
    _, first_order, total = CASES[case]
    inside, widths = [], []
    for seed in range(60):
        indices = estimates(case, number, seed)
        for interval, truth in ((indices.first_order, first_order), (indices.total, total)):
            inside.append((interval.low <= truth) & (truth <= interval.high))
            widths.append(interval.width)
    with capsys.disabled():
        print(
            f"\n{case}, {number} rows: coverage {np.mean(inside):.3f}, mean width {np.mean(widths):.3f}",
            end="",
        )
    assert np.mean(inside) >= 0.935


def test_sobol_input_may_consist_of_several_columns():
    columns = (1, 3, 1)
    points = saltelli_design(columns, 2048, seed=2)
    assert points.shape == (count_evaluations(columns, 2048), 5) == (2048 * 5, 5)
    weights = np.array([2.0, 1.0, 1.0, 1.0, 0.5])
    variances = np.array([4.0, 3.0, 0.25])
    indices = sobol_indices(points @ weights, columns, 2048)
    np.testing.assert_allclose(indices.total.value, variances / np.sum(variances), atol=3e-3)
    np.testing.assert_allclose(indices.first_order.value, variances / np.sum(variances), atol=3e-3)


def test_saltelli_design_consists_of_two_sample_sets_and_their_mixtures():
    points = saltelli_design(3, 64, seed=3).reshape(5, 64, 3)
    a, b, mixed = points[0], points[1], points[2:]
    assert np.all((points >= 0) & (points < 1))
    for i in range(3):
        others = [j for j in range(3) if j != i]
        np.testing.assert_array_equal(mixed[i][:, i], b[:, i])
        np.testing.assert_array_equal(mixed[i][:, others], a[:, others])
    # One point in each of 64 equal intervals, in every column of both sets.
    for column in (*a.T, *b.T):
        np.testing.assert_array_equal(np.sort(np.floor(64 * column)), np.arange(64))
    np.testing.assert_array_equal(saltelli_design(3, 64, seed=3), points.reshape(-1, 3))
    assert not np.array_equal(saltelli_design(3, 64, seed=4), points.reshape(-1, 3))


def test_sobol_study_with_cap_replaces_larger_and_missing_results_by_the_cap():
    points = saltelli_design(2, 256, seed=5)
    values = points @ [1.0, 3.0]
    cut = sobol_indices(np.minimum(values, 3.5), 2, 256)
    blown = np.where(values > 3.7, np.nan, np.where(values > 3.6, np.inf, values))
    np.testing.assert_array_equal(sobol_indices(blown, 2, 256, cap=3.5).total, cut.total)
    assert not np.array_equal(sobol_indices(values, 2, 256).total.value, cut.total.value)


def test_sobol_indices_do_not_depend_on_scale_of_the_output():
    values = ishigami(saltelli_design(3, 128, seed=6))
    for scale in (1e-200, 1e200):
        for interval, scaled in zip(
            sobol_indices(values, 3, 128), sobol_indices(scale * values, 3, 128), strict=True
        ):
            np.testing.assert_allclose(interval, scaled, rtol=1e-9, atol=1e-12)


def test_sobol_indices_without_variance_are_unknown():
    for constant in (0.0, 7.3):
        indices = sobol_indices(np.full(5 * 16, constant), 3, 16)
        for interval in indices:
            assert np.all(np.isnan(interval.value))
            assert np.all(interval.low == 0) and np.all(interval.high == 1)


@pytest.mark.parametrize(
    "wrong, words",
    (
        (lambda: saltelli_design(3, 100, 0), "number, seed: found 100, 0"),
        (lambda: saltelli_design(3, 64, -1), "number, seed: found 64, -1"),
        (lambda: saltelli_design(0, 64, 0), "inputs: found 0"),
        (lambda: saltelli_design((1, 0), 64, 0), "inputs: found"),
        (lambda: sobol_indices(np.ones(19), 3, 4), "values: found shape"),
        (lambda: sobol_indices(np.ones(20), 3, 4, level=0.0), "level: found 0.0"),
        (lambda: sobol_indices(np.ones(20), 3, 4, cap=np.inf), "cap: found inf"),
        (lambda: sobol_indices(np.full(20, np.nan), 3, 4), "not finite"),
    ),
)
def test_saltelli_design_rejects_impossible_sizes(wrong, words):
    with pytest.raises(ValueError, match=words):
        wrong()
