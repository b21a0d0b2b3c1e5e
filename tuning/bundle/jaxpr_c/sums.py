"""Reductions along axes, and products of arrays."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tuning.bundle.jaxpr_c.statements import Statements, index_of, loops, strides_of
from tuning.bundle.jaxpr_c.values import UnsupportedProgram, Value, literal

# Start value, and C statement for a result {0} and an element {1}; the extreme values are those of float64.
FOLDS: dict[str, tuple[Any, str]] = {
    "reduce_sum": (0, "{0} += {1};"),
    "reduce_prod": (1, "{0} *= {1};"),
    "reduce_max": (-np.inf, "{0} = larger_of({0}, {1});"),
    "reduce_min": (np.inf, "{0} = smaller_of({0}, {1});"),
    "reduce_and": (True, "{0} = {0} && {1};"),
    "reduce_or": (False, "{0} = {0} || {1};"),
}


def fold(statements: Statements, name: str, axes: Sequence[int], value: Value) -> Value:
    """Reduce an array along `axes` by the primitive `name`, a key of `FOLDS`; return the result."""
    first_value, step = FOLDS[name]
    if value.type not in (("bool",) if isinstance(first_value, bool) else ("float64",)):
        raise UnsupportedProgram(f"{name}: found {value.type}, expected float64, or bool for `and` and `or`")
    start = literal(first_value, value.type)
    free_axes = [n for n in range(len(value.shape)) if n not in axes]
    shape = [value.shape[n] for n in free_axes]
    result = statements.variable(shape, value.type)

    def combine(*indices: str) -> str:
        position = index_of(strides_of(shape), [indices[n] for n in free_axes])
        return step.format(
            result.element(position), value.element(index_of(strides_of(value.shape), indices))
        )

    first = loops([math.prod(shape)], lambda i: f"{result.element(i)} = {start};")
    statements.add([result], f"{first} {loops(value.shape, combine)}")
    return result


def multiply(statements: Statements, params: dict[str, Any], values: Sequence[Value]) -> Value:
    """Return a product of arrays that is summed over the contracted axes; see `jax.lax.dot_general`."""
    left, right = values
    (left_sum, right_sum), (left_batch, right_batch) = params["dimension_numbers"]
    left_free = [n for n in range(len(left.shape)) if n not in (*left_sum, *left_batch)]
    right_free = [n for n in range(len(right.shape)) if n not in (*right_sum, *right_batch)]
    shape = [left.shape[n] for n in (*left_batch, *left_free)] + [right.shape[n] for n in right_free]
    result = statements.variable(shape, left.type)

    def add(*indices: str) -> str:
        outer, inner = indices[: len(shape)], indices[len(shape) :]
        batch, free = outer[: len(left_batch)], outer[len(left_batch) :]
        cut = len(left_free)
        factors = [
            _element(left, (*left_batch, *left_free, *left_sum), (*batch, *free[:cut], *inner)),
            _element(right, (*right_batch, *right_free, *right_sum), (*batch, *free[cut:], *inner)),
        ]
        goal = result.element(index_of(strides_of(shape), outer))
        return f"{goal} += {' * '.join(factors)};"

    zero = literal(0, left.type)
    first = loops([math.prod(shape)], lambda i: f"{result.element(i)} = {zero};")
    summed = [left.shape[n] for n in left_sum]
    statements.add([result], f"{first} {loops([*shape, *summed], add)}")
    return result


def _element(value: Value, axes: Sequence[int], indices: Sequence[str]) -> str:
    """Return the C expression of an element; `indices[n]` is its index along `axes[n]`."""
    index = dict(zip(axes, indices, strict=True))
    return value.element(index_of(strides_of(value.shape), [index[n] for n in range(len(value.shape))]))
