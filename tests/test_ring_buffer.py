"""Delay lines compared with a list of the samples."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxhil.laws.shared.ring_buffer import depend_on, look_back, write_sample, write_samples

SAMPLES, LANES = 8, 3


@settings(max_examples=30)
@given(st.integers(0, 40), st.lists(st.integers(0, SAMPLES - 1), min_size=LANES, max_size=LANES))
def test_ring_buffer_returns_its_last_samples(extra, ticks):
    history = np.random.default_rng(extra).normal(size=(SAMPLES + extra, LANES))
    ring = jnp.zeros((SAMPLES, LANES))
    for tick, sample in enumerate(history):
        ring = write_sample(ring, jnp.array(tick, jnp.int32), jnp.asarray(sample))
    newest = len(history) - 1
    read = look_back(ring, jnp.array(newest, jnp.int32), jnp.array(ticks, jnp.int32))
    np.testing.assert_array_equal(read, history[newest - np.array(ticks), np.arange(LANES)])


@settings(max_examples=30)
@given(st.integers(0, 40), st.integers(0, SAMPLES - 1), st.integers(0, SAMPLES - 1))
def test_ring_buffer_returns_default_for_unknown_samples(newest, ticks, last):
    ring = jnp.asarray(np.random.default_rng(newest).normal(size=(SAMPLES, LANES)))
    ticks, is_known = np.array([ticks, ticks, last], np.int32), np.array([True, False, True])
    otherwise = np.arange(LANES, dtype=float)
    read = look_back(ring, jnp.array(newest, jnp.int32), jnp.asarray(ticks), jnp.asarray(is_known), otherwise)
    samples = np.asarray(ring)[(newest - ticks) % SAMPLES, np.arange(LANES)]
    np.testing.assert_array_equal(read, np.where(is_known, samples, otherwise))


def test_ring_buffer_is_the_same_if_samples_are_written_singly_or_together():
    generator = np.random.default_rng(1)
    rings = {name: jnp.asarray(generator.normal(size=(SAMPLES, LANES))) for name in "abc"}
    values = {name: jnp.asarray(generator.normal(size=LANES)) for name in "abc"}
    for tick in (jnp.array(number, jnp.int32) for number in range(2 * SAMPLES)):
        one_by_one = {name: write_sample(rings[name], tick, values[name]) for name in rings}
        jax.tree.map(np.testing.assert_array_equal, write_samples(rings, tick, values), one_by_one)


def test_added_dependency_of_a_value_changes_neither_value_nor_derivative():
    value, read = jnp.array([1.0, 2.0, 3.0]), jnp.array([4.0, -0.0, jnp.inf])
    np.testing.assert_array_equal(depend_on(value, read), value)
    tangents = jnp.ones(3), 5 * jnp.ones(3)
    np.testing.assert_array_equal(jax.jvp(depend_on, (value, read), tangents)[1], tangents[0])
    assert np.isnan(depend_on(value, read.at[1].set(jnp.nan))[1])
