"""Operations on batches of scenarios, lane by lane; the last axes of every array are the lanes."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def select_lanes(condition: Bool[Array, "*batch"], when_true: Any, when_false: Any) -> Any:
    """Return the leaves of `when_true` on the lanes where the condition holds, else those of `when_false`.

    Args:
        condition: Condition of each lane.
        when_true: Pytree of arrays whose last axes are the lanes.
        when_false: Pytree of the same structure and shapes.
    """

    def select(new: Array, old: Array) -> Array:
        return jnp.where(jnp.expand_dims(condition, range(jnp.ndim(new) - condition.ndim)), new, old)

    return jax.tree.map(select, when_true, when_false)


def safe_sqrt(square: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root; it and its derivative are 0 where the number is not positive."""
    positive = square > 0
    # The branch that is not selected must not be sqrt(0): its derivative would be 0 times infinity.
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
