"""Linear equations and square roots of small matrices, for all lanes at once.

Matrices are (rows, columns, *batch). A library would be called separately for each lane.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

ROOT_STEPS = 32  # rounding accuracy for eigenvalues down to 1e-9 of their sum; small ones grow by 9/4 a step


@jax.custom_jvp
def solve(
    matrix: Float[Array, "size size *batch"], right: Float[Array, "size columns *batch"]
) -> Float[Array, "size columns *batch"]:
    """Return matrix^-1 right, by the modified Gram-Schmidt process on the columns of both."""
    size = len(matrix)

    def project(k: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        table, triangle = carry
        column = lax.dynamic_index_in_dim(table, k, 1)
        square = product(jnp.swapaxes(column, 0, 1), column)
        unit = column * lax.rsqrt(square)
        along = product(jnp.swapaxes(unit, 0, 1), table)
        return table - unit * along, lax.dynamic_update_slice_in_dim(triangle, along, k, 0)

    table = jnp.concatenate([matrix, right], axis=1)
    _, triangle = lax.fori_loop(0, size, project, (table, jnp.zeros_like(table)))

    def substitute(step: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        rest, solution = carry
        k = size - 1 - step
        column = lax.dynamic_index_in_dim(triangle, k, 1)
        row = lax.dynamic_index_in_dim(rest, k, 0) / lax.dynamic_index_in_dim(column, k, 0)
        return rest - column * row, lax.dynamic_update_slice_in_dim(solution, row, k, 0)

    return lax.fori_loop(0, size, substitute, (triangle[:, size:], jnp.zeros_like(right)))[1]


@solve.defjvp
def _solve_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the solution and its derivative."""
    (matrix, right), (slope, right_slope) = primals, tangents
    solution = solve(matrix, right)
    return solution, solve(matrix, right_slope - product(slope, solution))


def product(left: Float[Array, "rows inner *batch"], right: Float[Array, "inner columns *batch"]) -> Array:
    """Return the matrix product left @ right."""
    total = left[:, 0, None] * right[None, 0]
    for k in range(1, len(right)):
        total = total + left[:, k, None] * right[None, k]
    return total


def square_root(matrix: Float[Array, "size size *batch"]) -> Float[Array, "size size *batch"]:
    """Return the symmetric square root of symmetric positive definite matrices.

    The Newton-Schulz iteration consists of matrix products only.
    """
    unit = jnp.eye(len(matrix), dtype=matrix.dtype).reshape(*matrix.shape[:2], *[1] * (matrix.ndim - 2))
    size = jnp.sum(unit * matrix, axis=(0, 1), keepdims=True)

    def step(_, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        root, inverse = pair
        share = (3 * unit - product(inverse, root)) / 2
        return product(root, share), product(share, inverse)

    start = matrix / size, jnp.broadcast_to(unit, matrix.shape)
    return lax.fori_loop(0, ROOT_STEPS, step, start)[0] * jnp.sqrt(size)
