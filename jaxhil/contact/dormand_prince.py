"""Runge-Kutta step of order 5(4) for y' = f(t, y) (Dormand and Prince 1980), and interpolation in a step."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

__all__ = ["StepEnd", "StepResult", "interpolate_step", "take_looped_step", "take_step"]

# Nodes and stage coefficients; the last stage is the solution of order 5. The error is the difference between
# the solutions of order 5 and 4.
_NODES = (0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0)
_STAGE_COEFFICIENTS = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR_COEFFICIENTS = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)

# Function of the time since the start of the step [s] and of y, a tree of arrays. It returns y' and further
# results, which `StepResult.extra` contains for the end of the step.
SlopeFunction = Callable[[Array, Any], tuple[Any, Any]]


class StepResult(NamedTuple):
    """Result of a Runge-Kutta step."""

    end: Any  # y at the end of the step
    slopes: Any  # y' at each stage, from the start of the step (first) to its end (last)
    extra: Any  # second result of the slope function at the end of the step
    error: Any  # estimated error of `end`


def take_step(slope: SlopeFunction, start: Any, length: Array) -> StepResult:
    """Take one Runge-Kutta step of `length` [s] from the initial value y = `start`."""

    def increment(row, slopes):
        terms = [(a, stage) for a, stage in zip(row, slopes, strict=True) if a]
        return jax.tree.map(
            lambda *leaves: length * sum((a * leaf for (a, _), leaf in zip(terms, leaves, strict=True)), 0.0),
            *(stage for _, stage in terms),
        )

    end, slopes, extra = start, [], None
    for node, row in zip(_NODES, _STAGE_COEFFICIENTS, strict=True):
        if row:
            end = jax.tree.map(lambda leaf, change: leaf + change, start, increment(row, slopes))
        stage, extra = slope(node * length, end)
        slopes.append(stage)
    return StepResult(end, slopes, extra, increment(_ERROR_COEFFICIENTS, slopes))


def take_looped_step(slope: SlopeFunction, start: Any, length: Float[Array, "*batch"]) -> StepResult:
    """Take one step as `take_step` does, but in a loop over the stages, which compiles much faster."""
    stages, batch_axes = len(_NODES), [1] * length.ndim

    def increment(row: Array, slopes: Any) -> Any:
        weights = row.reshape(-1, *batch_axes)
        return jax.tree.map(lambda leaf: length * jnp.sum(weights * leaf, axis=0), slopes)

    def take_stage(carry, coefficients):
        slopes, *_ = carry
        index, row, node = coefficients
        end = jax.tree.map(jnp.add, start, increment(row, slopes))
        stage, extra = slope(node * length, end)
        slopes = jax.tree.map(lambda stack, leaf: stack.at[index].set(leaf), slopes, stage)
        return (slopes, end, extra), None

    def empty(tree: Any, *leading: int) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros((*leading, *leaf.shape), leaf.dtype), tree)

    rows = [(*row, *[0.0] * (stages - len(row))) for row in _STAGE_COEFFICIENTS]
    coefficients = jnp.arange(stages), jnp.asarray(rows, length.dtype), jnp.asarray(_NODES, length.dtype)
    extra = empty(jax.eval_shape(lambda: slope(length, start)[1]))
    (slopes, end, extra), _ = lax.scan(take_stage, (empty(start, stages), start, extra), coefficients)
    return StepResult(end, slopes, extra, increment(jnp.asarray(_ERROR_COEFFICIENTS, length.dtype), slopes))


class StepEnd(NamedTuple):
    """Position and velocity at the end of a step, and acceleration at the start and the end of the step."""

    depth: Array  # penetration [m]
    velocity: Array  # rate of the penetration [m/s]
    start_acceleration: Array  # acceleration at the start of the step [m/s^2]
    end_acceleration: Array  # acceleration at the end of the step [m/s^2]


def interpolate_step(
    s: Array | float, length: Array, depth: Array, velocity: Array, end: StepEnd
) -> tuple[Array, Array]:
    """Interpolate position [m] and velocity [m/s] at the fraction s of a step (quintic Hermite polynomial).

    `depth` and `velocity` are position and velocity at the start of the step; `length` is its duration [s].
    """
    linear, square = velocity * length, end.start_acceleration * length**2 / 2
    # Differences from uniform acceleration at the end of the step, multiplied by powers of the step length.
    position_rest = end.depth - depth - linear - square
    velocity_rest = end.velocity * length - linear - 2 * square
    acceleration_rest = end.end_acceleration * length**2 - 2 * square
    cubic = 10 * position_rest - 4 * velocity_rest + acceleration_rest / 2
    quartic = -15 * position_rest + 7 * velocity_rest - acceleration_rest
    quintic = 6 * position_rest - 3 * velocity_rest + acceleration_rest / 2
    position = depth + s * (linear + s * (square + s * (cubic + s * (quartic + s * quintic))))
    rate = linear + s * (2 * square + s * (3 * cubic + s * (4 * quartic + s * 5 * quintic)))
    return position, jnp.where(length > 0, rate / jnp.where(length > 0, length, 1), velocity)
