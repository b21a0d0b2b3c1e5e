"""Operations on batches, lane by lane.

A lane is one element of a batch, such as one scenario. The last axes of every array are the lanes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float


def select_lanes(condition: Bool[Array, "*batch"], when_true: Any, when_false: Any) -> Any:
    """Select the leaves of `when_true` in lanes that satisfy the condition, else the leaves of `when_false`.

    Args:
        condition: Whether each lane takes its values from `when_true`.
        when_true: Pytree of arrays whose last axes are the lanes.
        when_false: Pytree of the same structure and shapes.
    """

    def select(new: Array, old: Array) -> Array:
        return jnp.where(jnp.expand_dims(condition, range(jnp.ndim(new) - condition.ndim)), new, old)

    return jax.tree.map(select, when_true, when_false)


def update_lanes(condition: Bool[Array, "*batch"], compute: Callable[[], Any], old: Any) -> Any:
    """Return `compute()` in lanes that satisfy the condition, else `old`; if no lane does, skip `compute`.

    Args:
        condition: Whether each lane takes its new values.
        compute: Function without arguments that returns the new values of all lanes.
        old: Pytree of the same structure and shapes as the new values; its last axes are the lanes.
    """
    return lax.cond(
        jnp.any(condition), lambda old: select_lanes(condition, compute(), old), lambda old: old, old
    )


def safe_sqrt(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root. Where `square` is not positive, the root and its derivative are 0."""
    positive = square > 0
    # JAX also differentiates the branch that is not selected: with sqrt(0) this would give 0 times infinity.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)


def as_complex(value: Array) -> Array:
    """Return real values as complex ones, because JAX's strict type promotion does not mix both."""
    return lax.complex(value, jnp.zeros_like(value))
