"""Linear equations and square roots of small matrices in lanes, compared with NumPy; derivatives."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxhil.sixdof.equations import product, solve, square_root

SEEDED = np.random.default_rng(11)
MATRIX = SEEDED.normal(size=(6, 6, 30))
RIGHT = SEEDED.normal(size=(6, 2, 30))


def by_lane(array):
    return np.moveaxis(np.asarray(array), -1, 0)


def test_linear_solve_matches_numpy_for_matrices_with_zero_pivots():
    matrix = MATRIX.copy()
    matrix[0, 0], matrix[:2, :2, 3] = 0.0, [[0.0, 1.0], [1.0, 0.0]]
    result = by_lane(jax.jit(solve)(matrix, RIGHT))
    expected = np.linalg.solve(by_lane(matrix), by_lane(RIGHT))
    scale = np.linalg.cond(by_lane(matrix)) * np.max(np.abs(expected), axis=(1, 2))
    assert np.max(np.abs(result - expected).max(axis=(1, 2)) / scale) < 1e-15


def test_linear_solve_derivative_includes_matrix_and_right_hand_side():
    """The derivative X' satisfies A X' = B' - A' X."""
    slopes = jnp.asarray(SEEDED.normal(size=MATRIX.shape)), jnp.asarray(SEEDED.normal(size=RIGHT.shape))
    result, slope = jax.jit(lambda: jax.jvp(solve, (jnp.asarray(MATRIX), jnp.asarray(RIGHT)), slopes))()
    both = product(jnp.asarray(MATRIX), slope) + product(slopes[0], result)
    np.testing.assert_allclose(both, slopes[1], atol=1e-11)


def test_matrix_square_root_is_accurate_for_widely_spread_eigenvalues():
    turns = np.linalg.qr(by_lane(MATRIX))[0]
    for ratio in (1.0, 1e-3, 1e-8):
        values = np.geomspace(1.0, ratio, 6) * 700.0
        roots = turns * np.sqrt(values) @ turns.transpose(0, 2, 1)
        result = by_lane(jax.jit(square_root)(np.moveaxis(turns * values @ turns.transpose(0, 2, 1), 0, -1)))
        np.testing.assert_allclose(result, roots, atol=1e-12 * np.sqrt(700 / ratio))
