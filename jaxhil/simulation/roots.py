"""Roots of smooth functions within brackets at whose ends the signs differ, and their derivatives.

Newton's method within the bracket iterates until every lane has its root. Forward-mode derivatives use the
implicit function theorem, not the iteration.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

MAX_BISECTIONS = 60  # bisections that give rounding accuracy for any function
ARGUMENT_TOLERANCE = 1e-9  # tolerance of the argument, which is of order 1

RootFunction = Callable[[Any, Array], Array]  # function of data and an argument


def find_positive_part(function: RootFunction, data: Any, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the part of [low, high] on which a function is positive, if it changes sign at most once."""
    root, at_low, at_high = _find_root(function, data, low, high)
    begin = jnp.where(at_low > 0, low, jnp.where(at_high > 0, root, low))
    end = jnp.where(at_high > 0, high, jnp.where(at_low > 0, root, low))
    return begin, jnp.where(end > begin, end, begin)


def find_sign_change(
    function: RootFunction, data: Any, low: Array, high: Array, positive: Array, negative: Any = None
) -> Array:
    """Return the argument in [low, high] at which a function changes sign.

    Without a change of sign, return `positive`, or `negative` if this is given and the function is negative.
    """
    root, at_low, at_high = _find_root(function, data, low, high)
    none = positive if negative is None else jnp.where(at_low > 0, positive, negative)
    return jnp.where((at_low > 0) != (at_high > 0), root, none)


def _find_root(function: RootFunction, data: Any, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Return the root of a function in a bracket, and the function's values at both ends."""
    fixed, low, high = lax.stop_gradient((data, low, high))
    at_low, at_high = function(fixed, jnp.stack([low, high]))
    change = at_high - at_low
    # After a step as short as this, the next one is below rounding.
    short = jnp.finfo(at_low.dtype).eps ** 0.6

    def value_and_slope(s):
        return jax.jvp(lambda s: function(fixed, s), (s,), (jnp.ones_like(s),))

    def is_under_way(carry):
        *_, sought, steps = carry
        return jnp.any(sought) & (steps < MAX_BISECTIONS)

    def improve(carry):
        low, high, guess, _, steps = carry
        value, slope = value_and_slope(guess)
        above = (value > 0) == (change > 0)
        low, high = jnp.where(above, low, guess), jnp.where(above, guess, high)
        step = guess - value / jnp.where(slope != 0, slope, 1)
        # At the root, rounding may place the step outside the bracket.
        inside = (slope != 0) & (step >= low - ARGUMENT_TOLERANCE) & (step <= high + ARGUMENT_TOLERANCE)
        nearer = jnp.where(inside, jnp.clip(step, low, high), (low + high) / 2)
        return low, high, nearer, crosses & (jnp.abs(nearer - guess) > short), steps + 1

    crosses = (at_low > 0) != (at_high > 0)
    secant = jnp.clip(low - at_low * (high - low) / jnp.where(change != 0, change, 1), low, high)
    _, _, root, _, _ = lax.while_loop(is_under_way, improve, (low, high, secant, crosses, 0))
    _, slope = value_and_slope(root)
    # One more step of Newton's method adds the derivative, but not its value.
    step = function(data, root) / jnp.where(slope != 0, slope, 1)
    return root - (step - lax.stop_gradient(step)), at_low, at_high
