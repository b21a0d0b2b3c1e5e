"""Roots of smooth functions between places at which their signs differ, and their derivatives.

Newton's method within a bracket, until every lane has its root. Forward-mode derivatives pass by the implicit
function theorem, not through the iteration.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

MOST_STEPS = 60  # as many halvings reach rounding, whatever the function
ROUNDING = 1e-9  # of a place, which is of order 1

Function = Callable[[Any, Array], Array]  # of data and of a place


def positive_part(function: Function, data: Any, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the part of [low, high] on which a function is positive, if it changes its sign at most once."""
    root, at_low, at_high = _root(function, data, low, high)
    begin = jnp.where(at_low > 0, low, jnp.where(at_high > 0, root, low))
    end = jnp.where(at_high > 0, high, jnp.where(at_low > 0, root, low))
    return begin, jnp.where(end > begin, end, begin)


def crossing(
    function: Function, data: Any, low: Array, high: Array, positive: Array, negative: Any = None
) -> Array:
    """Return where a function changes its sign in [low, high]; where it does not, `positive` or, if the
    function is negative and it is given, `negative`."""
    root, at_low, at_high = _root(function, data, low, high)
    none = positive if negative is None else jnp.where(at_low > 0, positive, negative)
    return jnp.where((at_low > 0) != (at_high > 0), root, none)


def _root(function: Function, data: Any, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Return the root of a function between places at which its signs differ, and its values there."""
    fixed, low, high = lax.stop_gradient((data, low, high))
    at_low, at_high = function(fixed, jnp.stack([low, high]))
    change = at_high - at_low
    # A step that is as short as this is followed by one below rounding.
    short = jnp.finfo(at_low.dtype).eps ** 0.6

    def at(place):
        return jax.jvp(lambda s: function(fixed, s), (place,), (jnp.ones_like(place),))

    def is_under_way(carry):
        *_, sought, steps = carry
        return jnp.any(sought) & (steps < MOST_STEPS)

    def improve(carry):
        low, high, place, _, steps = carry
        value, slope = at(place)
        above = (value > 0) == (change > 0)
        low, high = jnp.where(above, low, place), jnp.where(above, place, high)
        step = place - value / jnp.where(slope != 0, slope, 1)
        # At the root itself rounding may put the step beyond the bracket.
        inside = (slope != 0) & (step >= low - ROUNDING) & (step <= high + ROUNDING)
        nearer = jnp.where(inside, jnp.clip(step, low, high), (low + high) / 2)
        return low, high, nearer, crosses & (jnp.abs(nearer - place) > short), steps + 1

    crosses = (at_low > 0) != (at_high > 0)
    secant = jnp.clip(low - at_low * (high - low) / jnp.where(change != 0, change, 1), low, high)
    _, _, root, _, _ = lax.while_loop(is_under_way, improve, (low, high, secant, crosses, 0))
    _, slope = at(root)
    # The derivative is that of one more step of Newton's method, whose value is left out.
    step = function(data, root) / jnp.where(slope != 0, slope, 1)
    return root - (step - lax.stop_gradient(step)), at_low, at_high
