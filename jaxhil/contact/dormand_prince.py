"""One step of Dormand and Prince's pair of order 5(4) for y' = f(t, y), and the motion within a step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

__all__ = ["StepEnd", "StepResult", "along", "take_rolled_step", "take_step"]

# Dormand and Prince 1980: nodes, coefficients of the stages, the last of which is the solution of order 5,
# and the error, solution of order 5 less that of order 4.
_NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_STAGES = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)

# Of the time since the step's start [s] and y, a tree of arrays: y' and whatever else is asked for there.
Slope = Callable[[Array, Any], tuple[Any, Any]]


class StepResult(NamedTuple):
    """The end of a step."""

    end: Any  # y
    slopes: Any  # y' at each stage: of the first at the start, of the last at the end
    found: Any  # what else the slope's function returned at the end
    error: Any  # of y


def take_step(slope: Slope, start: Any, length: Array) -> StepResult:
    """Take a step of `length` [s] from y = `start`."""

    def moved(row, slopes):
        terms = [(a, one) for a, one in zip(row, slopes, strict=True) if a]
        return jax.tree.map(
            lambda *leaves: length * sum((a * leaf for (a, _), leaf in zip(terms, leaves, strict=True)), 0.0),
            *(one for _, one in terms),
        )

    end, slopes, found = start, [], None
    for node, row in zip(_NODES, _STAGES, strict=True):
        if row:
            end = jax.tree.map(lambda leaf, more: leaf + more, start, moved(row, slopes))
        one, found = slope(node * length, end)
        slopes.append(one)
    return StepResult(end, slopes, found, moved(_ERROR, slopes))


def take_rolled_step(slope: Slope, start: Any, length: Float[Array, "*batch"]) -> StepResult:
    """Take the same step with its stages in a loop, which takes a fraction of the time to compile."""
    stages, lanes = len(_NODES), [1] * length.ndim

    def moved(row: Array, slopes: Any) -> Any:
        weights = row.reshape(-1, *lanes)
        return jax.tree.map(lambda leaf: length * jnp.sum(weights * leaf, axis=0), slopes)

    def stage(carry, given):
        slopes, *_ = carry
        index, row, node = given
        at = jax.tree.map(jnp.add, start, moved(row, slopes))
        one, found = slope(node * length, at)
        slopes = jax.tree.map(lambda every, leaf: every.at[index].set(leaf), slopes, one)
        return (slopes, at, found), None

    def empty(tree: Any, *before: int) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros((*before, *leaf.shape), leaf.dtype), tree)

    rows = [(*row, *[0.0] * (stages - len(row))) for row in _STAGES]
    given = jnp.arange(stages), jnp.asarray(rows, length.dtype), jnp.asarray(_NODES, length.dtype)
    found = empty(jax.eval_shape(lambda: slope(length, start)[1]))
    (slopes, end, found), _ = lax.scan(stage, (empty(start, stages), start, found), given)
    return StepResult(end, slopes, found, moved(jnp.asarray(_ERROR, length.dtype), slopes))


class StepEnd(NamedTuple):
    """Motion of one coordinate at a step's end."""

    depth: Array  # penetration [m]
    velocity: Array  # its rate [m/s]
    first: Array  # acceleration at the step's start [m/s^2]
    last: Array  # acceleration at its end [m/s^2]


def along(
    s: Array | float, length: Array, depth: Array, velocity: Array, tried: StepEnd
) -> tuple[Array, Array]:
    """Position and velocity at the fraction s of a step, by its quintic (Hermite)."""
    speed, bend = velocity * length, tried.first * length**2 / 2
    moved = tried.depth - depth - speed - bend
    turned = tried.velocity * length - speed - 2 * bend
    curled = tried.last * length**2 - 2 * bend
    cubic = 10 * moved - 4 * turned + curled / 2
    quartic = -15 * moved + 7 * turned - curled
    quintic = 6 * moved - 3 * turned + curled / 2
    position = depth + s * (speed + s * (bend + s * (cubic + s * (quartic + s * quintic))))
    rate = speed + s * (2 * bend + s * (3 * cubic + s * (4 * quartic + s * 5 * quintic)))
    return position, jnp.where(length > 0, rate / jnp.where(length > 0, length, 1), velocity)
