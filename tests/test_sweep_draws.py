"""Draws of a sweep: scenario i depends only on the seed and on i."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxhil.mechanism.file import load
from tuning.sweeps import SAMPLINGS
from tuning.sweeps.draws import SOBOL_REPLICATES, draw_scenarios, draw_sobol_points

MECHANISM = load("varying").mechanism
WHOLE = {sampling: draw_scenarios(MECHANISM, sampling, 3, 0, 3000) for sampling in SAMPLINGS}


def leaves(found, part=slice(None)):
    draws, scenarios = found
    return [*(values[part] for values in draws.values())], [
        np.asarray(leaf)[..., part] for leaf in jax.tree.leaves(scenarios)
    ]


@pytest.mark.parametrize("sampling", SAMPLINGS)
@given(first=st.integers(0, 2990), number=st.integers(0, 1500))
@settings(max_examples=25)
def test_draws_of_a_chunk_equal_corresponding_draws_of_the_whole_sweep(sampling, first, number):
    number = min(number, 3000 - first)
    result = leaves(draw_scenarios(MECHANISM, sampling, 3, first, number))
    expected = leaves(WHOLE[sampling], slice(first, first + number))
    jax.tree.map(np.testing.assert_array_equal, result, expected)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_sweep_draws_of_different_seeds_differ(sampling):
    other, _ = draw_scenarios(MECHANISM, sampling, 4, 0, 100)
    for path, values in WHOLE[sampling][0].items():
        assert not np.any(values[:100] == other[path])


def test_sensor_noise_keys_consist_of_seed_and_scenario_index():
    _, scenarios = draw_scenarios(MECHANISM, "sobol", 9, 70_000, 3)
    np.testing.assert_array_equal(scenarios.key, [[9, 9, 9], [70_000, 70_001, 70_002]])


def test_sweep_replicates_are_distinct_sobol_sequences():
    points = draw_sobol_points(5, 1, 0, 64 * SOBOL_REPLICATES)
    replicates = points.reshape(64, SOBOL_REPLICATES, 5)
    for replicate in range(SOBOL_REPLICATES):
        for column in replicates[:, replicate].T:
            # One point in each of 64 equal cells: scrambling preserves this property of the sequence.
            np.testing.assert_array_equal(np.sort(np.floor(column * 64)), np.arange(64))
    assert len(np.unique(points[:SOBOL_REPLICATES, 0])) == SOBOL_REPLICATES
    assert np.all((points > 0) & (points < 1))


def test_sobol_replicate_means_scatter_less_than_random_means():
    points = draw_sobol_points(3, 2, 0, 256 * SOBOL_REPLICATES).reshape(256, SOBOL_REPLICATES, 3)
    deviation = np.std(np.mean(np.prod(points, axis=2), axis=0), ddof=1)
    assert deviation < 0.2 * np.std(np.prod(points, axis=2)) / np.sqrt(256)
