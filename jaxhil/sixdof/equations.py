"""Linear equations and square roots of small matrices (rows, columns, *batch), for all lanes at once.

The algorithms consist of array operations, because JAX would call a linear-algebra library once per lane.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Number of Newton-Schulz steps: accurate to rounding for eigenvalues down to 1e-9 of their sum, because a
# small eigenvalue grows by 9/4 in each step.
ROOT_STEPS = 32


@jax.custom_jvp
def solve(
    matrix: Float[Array, "size size *batch"], right: Float[Array, "size columns *batch"]
) -> Float[Array, "size columns *batch"]:
    """Solve matrix @ solution = right by modified Gram-Schmidt orthogonalisation."""
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
    (matrix, right), (matrix_tangent, right_tangent) = primals, tangents
    solution = solve(matrix, right)
    return solution, solve(matrix, right_tangent - product(matrix_tangent, solution))


def product(left: Float[Array, "rows inner *batch"], right: Float[Array, "inner columns *batch"]) -> Array:
    """Return the matrix product left @ right."""
    total = left[:, 0, None] * right[None, 0]
    for k in range(1, len(right)):
        total = total + left[:, k, None] * right[None, k]
    return total


def square_root(matrix: Float[Array, "size size *batch"]) -> Float[Array, "size size *batch"]:
    """Return the symmetric square root of positive definite matrices by the Newton-Schulz iteration."""
    unit = jnp.eye(len(matrix), dtype=matrix.dtype).reshape(*matrix.shape[:2], *[1] * (matrix.ndim - 2))
    trace = jnp.sum(unit * matrix, axis=(0, 1), keepdims=True)

    def step(_, pair: tuple[Array, Array]) -> tuple[Array, Array]:
        root, inverse = pair
        factor = (3 * unit - product(inverse, root)) / 2
        return product(root, factor), product(factor, inverse)

    start = matrix / trace, jnp.broadcast_to(unit, matrix.shape)
    return lax.fori_loop(0, ROOT_STEPS, step, start)[0] * jnp.sqrt(trace)
