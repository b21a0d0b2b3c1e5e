"""Sensor noise: generator compared with published vectors and `jax.random`; normally distributed samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32
from lanes import QUICK
from scipy.stats import kstest

from jaxhil.simulation.sensors import threefry, white_noise

ours = jax.jit(threefry, compiler_options=QUICK)


# Vectors of the authors' library, Random123: key, counter, result.
@pytest.mark.parametrize(
    "key, counter, result",
    [
        ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
        ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
        ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
    ],
)
def test_random_generator_agrees_with_published_vectors(key, counter, result):
    assert tuple(int(word) for word in ours(*map(jnp.uint32, (*key, *counter)))) == result


def test_random_generator_gives_the_same_bits_as_jax():
    words = np.random.default_rng(0).integers(0, 1 << 32, (4, 8), dtype=np.uint32)
    result = np.stack(ours(*map(jnp.asarray, words)))
    theirs = np.stack([threefry_2x32(*(jnp.asarray(w) for w in np.split(lane, 2))) for lane in words.T])
    np.testing.assert_array_equal(result, theirs.T)


@pytest.mark.parametrize("dtype, largest", [("float32", 5.3), ("float64", 6.4)])
def test_sensor_noise_samples_are_normally_distributed(dtype, largest):
    keys = np.stack([np.full(100, 7), np.arange(100)]).astype(np.uint32)
    count = np.broadcast_to(np.arange(5000, dtype=np.int32)[:, None], (5000, 100))
    contact = np.zeros(100, np.int32)
    noise = jax.jit(white_noise, static_argnums=3, compiler_options=QUICK)
    drawn = noise(*map(jnp.asarray, (keys, contact, count)), dtype)
    assert drawn.dtype == dtype
    samples = np.asarray(drawn, float)
    assert kstest(samples.ravel(), "norm").pvalue > 0.01
    # The kurtosis shows the tails; a normal sample has the kurtosis 3 +- sqrt(96 / number).
    assert np.mean(samples**4) == pytest.approx(3, abs=4 * np.sqrt(96 / samples.size))
    assert 4 < np.abs(samples).max() < largest
