"""Bracketed root finding for batches of smooth functions, differentiable in forward mode.

A bracket [low, high] contains a root if the function has different signs at its ends. Newton's method with
bisection iterates until it has converged in every lane of the batch. Derivatives follow from the implicit
function theorem, not from the iteration.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

MAX_BISECTIONS = 60  # maximum number of bisections: any bracket is then shorter than the rounding error
# Maximum amount by which a Newton step may leave the bracket, for arguments of order 1 [1].
ARGUMENT_TOLERANCE = 1e-9

RootFunction = Callable[[Any, Array], Array]  # maps (data, argument) to the function value


def find_positive_part(function: RootFunction, data: Any, low: Array, high: Array) -> tuple[Array, Array]:
    """Return the subinterval of [low, high] in which a function with at most one sign change is positive."""
    root, at_low, at_high = _find_root(function, data, low, high)
    begin = jnp.where(at_low > 0, low, jnp.where(at_high > 0, root, low))
    end = jnp.where(at_high > 0, high, jnp.where(at_low > 0, root, low))
    return begin, jnp.where(end > begin, end, begin)


def find_sign_change(
    function: RootFunction, data: Any, low: Array, high: Array, positive: Array, negative: Any = None
) -> Array:
    """Return the argument in [low, high] at which a function changes sign.

    If the function is positive at both ends, return `positive`. If the function is negative at both ends,
    return `negative` or, if that is None, `positive`.
    """
    root, at_low, at_high = _find_root(function, data, low, high)
    none = positive if negative is None else jnp.where(at_low > 0, positive, negative)
    return jnp.where((at_low > 0) != (at_high > 0), root, none)


def _find_root(function: RootFunction, data: Any, low: Array, high: Array) -> tuple[Array, Array, Array]:
    """Return the root of a function in [low, high], and the function's values at `low` and `high`."""
    fixed, low, high = lax.stop_gradient((data, low, high))
    at_low, at_high = function(fixed, jnp.stack([low, high]))
    change = at_high - at_low
    # Newton's method converges quadratically: after a step as short as this, the next is below rounding.
    short = jnp.finfo(at_low.dtype).eps ** 0.6

    def value_and_slope(s):
        return jax.jvp(lambda s: function(fixed, s), (s,), (jnp.ones_like(s),))

    def is_unfinished(carry):
        *_, unconverged, steps = carry
        return jnp.any(unconverged) & (steps < MAX_BISECTIONS)

    def improve(carry):
        low, high, guess, _, steps = carry
        value, slope = value_and_slope(guess)
        above = (value > 0) == (change > 0)
        low, high = jnp.where(above, low, guess), jnp.where(above, guess, high)
        step = guess - value / jnp.where(slope != 0, slope, 1)
        # Near the root, rounding errors may move the step slightly out of the bracket.
        inside = (slope != 0) & (step >= low - ARGUMENT_TOLERANCE) & (step <= high + ARGUMENT_TOLERANCE)
        nearer = jnp.where(inside, jnp.clip(step, low, high), (low + high) / 2)
        return low, high, nearer, crosses & (jnp.abs(nearer - guess) > short), steps + 1

    crosses = (at_low > 0) != (at_high > 0)
    secant = jnp.clip(low - at_low * (high - low) / jnp.where(change != 0, change, 1), low, high)
    _, _, root, _, _ = lax.while_loop(is_unfinished, improve, (low, high, secant, crosses, 0))
    _, slope = value_and_slope(root)
    # One more step of Newton's method contributes its derivative (implicit function theorem), not its value.
    step = function(data, root) / jnp.where(slope != 0, slope, 1)
    return root - (step - lax.stop_gradient(step)), at_low, at_high
