"""Correlated uncertain parameters: closed forms of the Gaussian copula, and independence of draws."""

import numpy as np
import pytest
from mechanism_table import FULL
from scipy import special, stats

from jaxhil.errors import InputError
from jaxhil.mechanism.correlation import find_correlated_groups, fix_at_nominal
from jaxhil.mechanism.file import from_plain_data, load, to_plain_data
from jaxhil.mechanism.uncertainty import (
    compute_quantiles,
    count_dimensions,
    draw,
    draw_at_points,
    draw_extremes,
    draw_quasi_random,
)

DELAY, DAMPING, SPEED = "rig.force_sensor.delay", "contact.damping", "approach.velocity"
FREQUENCY, STIFFNESS = "rig.simulator.natural_frequency", "contact.stiffness"
UNCERTAIN = {
    DELAY: {"distribution": "normal", "std": 0.0001},
    DAMPING: {"distribution": "normal", "std": 12.0},
    SPEED: {"distribution": "uniform", "factor": [0.8, 1.2]},
    FREQUENCY: {"distribution": "uniform", "factor": [0.9, 1.1]},
    STIFFNESS: {"distribution": "loguniform", "factor": [0.5, 2.0]},
}
KEYS = [DELAY, STIFFNESS, DAMPING, FREQUENCY]
MATRIX = [[1.0], [0.0, 1.0], [0.98, 0.1, 1.0], [0.0, 0.0, 0.0, 1.0]]


def mechanism(keys=KEYS, matrix=MATRIX, changes=(), unset=()):
    raw = to_plain_data(load("varying").mechanism) | {"uncertainty": UNCERTAIN}
    table = {} if keys is None else {"correlation": {"keys": keys, "matrix": matrix}}
    return from_plain_data(raw | table, "some file", changes, unset)


def normals(values, parsed):
    """Return the standard normal values that correspond to each key's draws, by SciPy's distributions."""
    m = np.ravel(parsed.contact.stiffness)[0]
    return {
        DELAY: (values[DELAY] - parsed.rig.force_sensor.delay) / 0.0001,
        DAMPING: (values[DAMPING][:, 0] - parsed.contact.damping[0]) / 12.0,
        SPEED: special.ndtri(stats.uniform(0.004, 0.002).cdf(values[SPEED])),
        FREQUENCY: special.ndtri(stats.uniform(27.0, 6.0).cdf(values[FREQUENCY])),
        STIFFNESS: special.ndtri(stats.loguniform(0.5 * m, 2 * m).cdf(values[STIFFNESS][:, 0])),
    }


@pytest.mark.parametrize("draws", [draw, draw_quasi_random])
def test_correlated_draws_keep_marginals_and_have_stated_correlation(draws):
    parsed, number = mechanism(), 4096
    behind = normals(draws(parsed, number, 5), parsed)
    for key, values in behind.items():
        assert stats.kstest(values, stats.norm.cdf).pvalue > 0.01, key
    correlations, wanted = np.corrcoef([behind[key] for key in [*KEYS, SPEED]]), np.eye(5)
    wanted[2, :2] = wanted[:2, 2] = 0.98, 0.1
    # Fisher 1915: atanh of a correlation is normal, with variance 1 / (n - 3).
    beyond = np.abs(np.arctanh(np.tril(correlations, -1)) - np.arctanh(np.tril(wanted, -1))) * np.sqrt(
        number - 3
    )
    assert np.max(beyond) < 3.5
    assert draws is draw or np.max(beyond) < 1


def test_correlated_draws_keep_small_variance_of_a_linear_combination():
    parsed = mechanism(keys=[DELAY, DAMPING], matrix=[[1.0], [0.98, 1.0]])
    values = draw(parsed, 4096, 0)
    stiffness = 120e3
    combined = values[DAMPING][:, 0] - stiffness * values[DELAY]
    variance = 12.0**2 + (stiffness * 1e-4) ** 2 - 2 * 0.98 * 12.0 * stiffness * 1e-4
    assert abs(np.std(combined) / np.sqrt(variance) - 1) < 4 / np.sqrt(2 * 4096)


def test_correlation_changes_only_draws_of_the_correlated_key():
    apart, together = draw(mechanism(keys=None), 500, 3), draw(mechanism(), 500, 3)
    assert together.keys() == apart.keys()
    for key in set(apart) - {DAMPING}:
        np.testing.assert_array_equal(together[key], apart[key])
    assert not np.any(together[DAMPING] == apart[DAMPING])
    identity = draw(mechanism(matrix=[[1.0], [0, 1], [0, 0, 1], [0, 0, 0, 1]]), 500, 3)
    for key in apart:
        np.testing.assert_array_equal(identity[key], apart[key])


def test_correlated_draw_depends_only_on_its_group_and_index():
    parsed = mechanism()
    whole = draw(parsed, 1500, 7)
    changed = mechanism(
        keys=KEYS[:3], matrix=MATRIX[:3], changes=[f"uncertainty.'{FREQUENCY}'.factor=[0.5, 2]"]
    )
    for key, values in draw(parsed, 3, 7, first=1022).items():
        np.testing.assert_array_equal(values, whole[key][1022:1025])
        if key != FREQUENCY:
            np.testing.assert_array_equal(draw(changed, 3, 7, first=1022)[key], values)
    assert all(len(values) == 0 for values in draw(parsed, 0, 7).values())


def test_correlation_leaves_quantiles_and_extremes_unchanged():
    opposed = mechanism(keys=[DELAY, DAMPING], matrix=[[1.0], [-0.98, 1.0]])
    apart = mechanism(keys=None)
    for key, ends in draw_extremes(opposed).items():
        np.testing.assert_array_equal(ends, draw_extremes(apart)[key])
    points = np.repeat([[0.001], [0.5], [0.999]], sum(count_dimensions(apart).values()), axis=1)
    for key, values in compute_quantiles(opposed, points).items():
        np.testing.assert_array_equal(values, draw_at_points(apart, points)[key])
    damping = draw_at_points(opposed, points)[DAMPING][:, 0]
    np.testing.assert_allclose(
        (damping - apart.contact.damping[0]) / 12.0,
        special.ndtri(points[:, 0]) * (np.sqrt(1 - 0.98**2) - 0.98),
        atol=1e-9,
    )
    # Include a coordinate at a bound of the unit cube.
    box = draw_at_points(
        mechanism(), np.array([np.zeros(points.shape[1]), np.full(points.shape[1], 1 - 2**-53)])
    )
    assert all(np.all(np.isfinite(values)) for values in box.values())


def test_correlation_matrix_applies_to_each_independent_list_entry():
    apart = {key: UNCERTAIN[key] | {"independent": True} for key in (STIFFNESS, DAMPING)}
    raw = to_plain_data(load("varying", {"contact.damping": [260.0, 390.0]}).mechanism)
    table = {"keys": [STIFFNESS, DELAY, DAMPING], "matrix": [[1.0], [0.6, 1.0], [0.5, -0.3, 1.0]]}
    parsed = from_plain_data(raw | {"uncertainty": UNCERTAIN | apart, "correlation": table}, "some file")
    number = 4096
    values = draw(parsed, number, 0)
    stiffness, damping = np.log(values[STIFFNESS] / parsed.contact.stiffness), values[DAMPING]
    spread = special.ndtri(stats.uniform(np.log(0.5), np.log(4.0)).cdf(stiffness))
    correlations = np.corrcoef([*spread.T, values[DELAY], *damping.T])
    # Two contacts are correlated through the delay.
    other = 0.6 * -0.3
    wanted = np.array(
        [
            [1.0, 0.36, 0.36, 0.6, 0.5, other],
            [0.36, 1.0, 0.36, 0.6, other, 0.5],
            [0.36, 0.36, 1.0, 0.6, other, other],
            [0.6, 0.6, 0.6, 1.0, -0.3, -0.3],
            [0.5, other, other, -0.3, 1.0, 0.09],
            [other, 0.5, other, -0.3, 0.09, 1.0],
        ]
    )
    beyond = np.abs(np.arctanh(np.tril(correlations, -1)) - np.arctanh(np.tril(wanted, -1))) * np.sqrt(
        number - 3
    )
    assert np.max(beyond) < 3.5
    np.testing.assert_array_equal(values[DELAY], draw(mechanism(keys=None), number, 0)[DELAY])
    for column in ((damping - parsed.contact.damping) / 12.0).T:
        assert stats.kstest(column, stats.norm.cdf).pvalue > 0.01


def test_correlated_keys_are_grouped_by_connected_components():
    assert find_correlated_groups(mechanism()) == [(DELAY, STIFFNESS, DAMPING), (FREQUENCY,)]
    assert find_correlated_groups(mechanism(keys=None)) == []


def test_unset_removes_keys_from_correlation_table():
    changed = mechanism(unset=[f"uncertainty.'{STIFFNESS}'"])
    assert changed.correlation.keys == [DELAY, DAMPING, FREQUENCY]
    assert changed.correlation.matrix == [[1.0], [0.98, 1.0], [0.0, 0.0, 1.0]]
    assert to_plain_data(changed) == to_plain_data(fix_at_nominal(mechanism(), [STIFFNESS]))
    assert mechanism(unset=["contact.damping"]).correlation.keys == [DELAY, STIFFNESS, FREQUENCY]
    for none in (
        mechanism(unset=["uncertainty"]),
        mechanism(unset=["correlation"]),
        fix_at_nominal(mechanism(), KEYS),
    ):
        assert none.correlation is None
    assert from_plain_data(to_plain_data(changed), "again") == changed


@pytest.mark.parametrize(
    ("keys", "matrix", "reason"),
    [
        (
            [DELAY, "contact.dampin"],
            [[1], [0, 1]],
            "keys[1]: found 'contact.dampin', expected a key of [uncert",
        ),
        (
            [DELAY, "rig.simulator.delay"],
            [[1], [0, 1]],
            "keys[1]: found 'rig.simulator.delay', expected a key",
        ),
        ([DELAY, DELAY], [[1], [0, 1]], f"keys[1]: found '{DELAY}' twice, expected each key once"),
        ([], [], "correlation.keys: found a list of 0 entries"),
        ("a", [[1]], "correlation.keys: found 'a'"),
        ([DELAY, SPEED], [[1]], "matrix: found 1 rows, expected 2, one for each key"),
        (
            [DELAY, SPEED],
            [[1], [0.1]],
            "matrix[1]: found 1 entries, expected 2, up to the diagonal",
        ),
        ([DELAY, SPEED], [[1, 0], [0, 1]], "matrix[0]: found 2 entries, expected 1"),
        ([DELAY, SPEED], [[1], [0, 0.9]], "matrix[1][1]: found 0.9, expected 1 on the diagonal"),
        ([DELAY, SPEED], [[1], [1.5, 1]], "matrix[1][0]: found 1.5, expected a number from -1 to 1"),
        ([DELAY, SPEED], [[1], [float("nan"), 1]], "matrix[1][0]: found nan"),
        ([DELAY, SPEED], [[1], [1, 1]], "matrix: found a smallest eigenvalue of"),
        ([DELAY, SPEED, DAMPING], [[1], [0.9, 1], [0.9, -0.9, 1]], "expected a positive definite matrix"),
    ],
)
def test_unusable_correlation_table_is_rejected(keys, matrix, reason):
    raw = FULL | {"uncertainty": UNCERTAIN, "correlation": {"keys": keys, "matrix": matrix}}
    with pytest.raises(InputError) as caught:
        from_plain_data(raw, "some file")
    assert str(caught.value).startswith("some file: correlation.") and reason in str(caught.value)
    assert str(caught.value).isprintable()
