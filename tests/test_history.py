"""The rings of samples of the retrospective laws, against a list of all samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxhil.compensators import history as in_jax
from jaxhil.runtime.laws.history import LEVELS, SLOTS, History

TICKS = 5000


@pytest.fixture(scope="module")
def samples():
    """Force, whether it is shown, position, velocity, tick by tick; impulse and shown, as their definition
    has them."""
    rng = np.random.default_rng(0)
    force, position, velocity = rng.standard_normal((3, TICKS))
    shows = rng.random(TICKS) > 0.2
    both = np.append(False, shows[1:] & shows[:-1])
    impulse = np.cumsum(both * (force + np.append(0.0, force[:-1])) / 2)
    return force, shows, position, velocity, impulse, np.cumsum(both)


def kept(newest):
    """Ticks that are kept when this is the newest: the last of each block, of blocks that grow with age."""
    ticks, first = [], newest + 1
    for level in range(LEVELS):
        stride = 4**level
        oldest = max(newest - (SLOTS - 1) * stride + 1, 0)
        ticks += [tick for tick in range(oldest, first) if (tick + 1) % stride == 0]
        first = min(first, oldest)
    return ticks


def test_every_sample_that_is_kept_is_as_it_was(samples):
    force, shows, position, velocity, impulse, shown = samples
    history = History()
    for tick in range(TICKS):
        history.take(float(force[tick]), bool(shows[tick]), float(position[tick]), float(velocity[tick]))
        if tick in (0, 3, 200, 255, 256, 1021, 1022, TICKS - 1):
            for one in kept(tick):
                found = history.recall(one)
                assert found[1:] == (shown[one], position[one], velocity[one])
                assert found[0] == pytest.approx(impulse[one], abs=1e-12)
    assert history.newest == TICKS - 1
    for tick in range(TICKS - SLOTS, TICKS):
        assert history.reading(tick) == (force[tick], shows[tick])


def test_lanes_whose_runs_begin_at_different_ticks_keep_theirs(samples):
    """The slot that is written is common to all lanes; each recalls what it measured."""
    force, shows, position, velocity, impulse, shown = (jnp.asarray(each) for each in samples)
    begins, last = np.array([0, 7, 1333]), 3000

    def tick(history, now):
        age = now - jnp.asarray(begins, jnp.int32)
        at = jnp.maximum(age, 0)
        return in_jax.take(history, now, at, force[at], shows[at], position[at], velocity[at]), None

    @jax.jit
    def run():
        history = lax.scan(tick, in_jax.no_history(jnp.zeros(3)), jnp.arange(last, dtype=jnp.int32))[0]
        return jax.vmap(lambda index: in_jax.recall(history, jnp.full(3, index, jnp.int32)))(
            jnp.arange(last, dtype=jnp.int32)
        )

    found = jax.tree.map(np.asarray, run())
    for lane, began in enumerate(begins):
        ticks = kept(last - 1 - began)
        np.testing.assert_array_equal(found.position[ticks, lane], position[np.array(ticks)])
        np.testing.assert_allclose(found.impulse[ticks, lane], impulse[np.array(ticks)], atol=1e-12)
        np.testing.assert_array_equal(found.shown[ticks, lane], shown[np.array(ticks)])
