"""Operations on lanes: selection between pytrees, and a square root with finite derivative at 0."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.lanes import safe_sqrt, select_lanes, update_lanes


def test_safe_sqrt_and_derivative_are_zero_for_arguments_up_to_zero():
    squares = jnp.array([-1.0, 0.0, 4.0])
    np.testing.assert_array_equal(safe_sqrt(squares), [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(jax.vmap(jax.grad(safe_sqrt))(squares), [0.0, 0.0, 0.25])


def test_lanes_of_arrays_of_any_rank_are_selected():
    new = {"scalar": jnp.array([1.0, 2.0]), "vector": jnp.array([[1.0, 2.0], [3.0, 4.0]])}
    old = jax.tree.map(jnp.zeros_like, new)
    chosen = select_lanes(jnp.array([True, False]), new, old)
    np.testing.assert_array_equal(chosen["scalar"], [1.0, 0.0])
    np.testing.assert_array_equal(chosen["vector"], [[1.0, 0.0], [3.0, 0.0]])


def test_update_of_no_lane_returns_old_values_and_computes_nothing():
    computed = []

    def compute():
        jax.debug.callback(lambda: computed.append(1))
        return jnp.ones(2)

    update = jax.jit(lambda condition: update_lanes(condition, compute, jnp.zeros(2)))
    assert update(jnp.array([False, False])).tolist() == [0, 0]
    jax.effects_barrier()
    assert not computed
    assert update(jnp.array([False, True])).tolist() == [0, 1]
    jax.effects_barrier()
    assert computed
