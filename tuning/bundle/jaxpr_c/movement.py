"""Primitives that move elements: static selections, slices at computed positions, and gathers.

A static selection becomes a view of its operand if the elements have a constant stride, and a copy otherwise.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from tuning.bundle.jaxpr_c.statements import Statements, index_of, loops, strides_of
from tuning.bundle.jaxpr_c.values import Value, literal

MAX_LISTED = 24  # largest number of elements that a copy lists instead of a loop

Parameters = dict[str, Any]


def _broadcast(array: np.ndarray, p: Parameters) -> np.ndarray:
    shape = [1] * len(p["shape"])
    for axis, position in enumerate(p["broadcast_dimensions"]):
        shape[position] = array.shape[axis]
    return np.broadcast_to(array.reshape(shape), p["shape"])


def _slice(array: np.ndarray, p: Parameters) -> np.ndarray:
    steps = p["strides"] or (1,) * array.ndim
    return array[tuple(map(slice, p["start_indices"], p["limit_indices"], steps))]


# Selections of the elements of one operand, and of several operands.
UNARY: dict[str, Callable[[np.ndarray, Parameters], np.ndarray]] = {
    "reshape": lambda array, p: array.reshape(p["new_sizes"]),
    "squeeze": lambda array, p: array.squeeze(tuple(p["dimensions"])),
    "expand_dims": lambda array, p: np.expand_dims(array, tuple(p["dimensions"])),
    "transpose": lambda array, p: array.transpose(p["permutation"]),
    "rev": lambda array, p: np.flip(array, tuple(p["dimensions"])),
    "broadcast_in_dim": _broadcast,
    "slice": _slice,
    "copy": lambda array, p: array,
    "stop_gradient": lambda array, p: array,
}
JOINING: dict[str, Callable[[Sequence[np.ndarray], Parameters], np.ndarray]] = {
    "concatenate": lambda arrays, p: np.concatenate(arrays, p["dimension"]),
    "stack": lambda arrays, p: np.stack(arrays, p["axis"]),
}


def select_elements(
    statements: Statements, name: str, params: Parameters, values: Sequence[Value]
) -> list[Value] | None:
    """Select elements at constant positions; return the results, or None if the primitive does not select."""
    numbers = [np.arange(value.size).reshape(value.shape) for value in values]
    if name in UNARY:
        return [_view_or_copy(statements, values[0], UNARY[name](numbers[0], params))]
    if name == "split":
        cuts = np.cumsum(params["sizes"])[:-1]
        return [
            _view_or_copy(statements, values[0], part) for part in np.split(numbers[0], cuts, params["axis"])
        ]
    if name == "unstack":
        rows = np.moveaxis(numbers[0], params["axis"], 0)
        return [_view_or_copy(statements, values[0], row) for row in rows]
    if name in JOINING:
        starts = np.cumsum([0, *(value.size for value in values)]).tolist()
        shifted = [part + start for part, start in zip(numbers, starts, strict=False)]
        return [_join(statements, values, starts, JOINING[name](shifted, params))]
    if name == "iota":
        shape, axis = params["shape"], params["dimension"]
        counts = np.arange(shape[axis]).reshape([-1 if n == axis else 1 for n in range(len(shape))])
        return [statements.constant(np.broadcast_to(counts, shape), str(np.dtype(params["dtype"])))]
    return None


def broadcast(statements: Statements, value: Value, shape: tuple[int, ...]) -> Value:
    """Return a value whose axes of length 1 are repeated up to this shape."""
    if value.is_uniform or value.shape == shape:
        return value
    numbers = np.arange(value.size).reshape(value.shape)
    return _view_or_copy(statements, value, np.broadcast_to(numbers, shape))


def _view_or_copy(statements: Statements, value: Value, chosen: np.ndarray) -> Value:
    flat = chosen.ravel()
    step = int(flat[1] - flat[0]) if flat.size > 1 else 0
    if value.is_uniform or flat.size <= 1 or np.all(np.diff(flat) == step):
        return value.view(chosen.shape, int(flat[0]) if flat.size else 0, step)
    return _join(statements, [value], [0], chosen)


def _join(
    statements: Statements, values: Sequence[Value], starts: Sequence[int], chosen: np.ndarray
) -> Value:
    """Return elements of several operands; `chosen` contains indices into the joined list of all elements."""
    flat = chosen.ravel()
    owners = np.searchsorted(starts, flat, side="right") - 1
    parts = [
        (values[owner], int(number) - int(starts[owner])) for owner, number in zip(owners, flat, strict=True)
    ]
    elements = [value.element(number) for value, number in parts]
    shape, kind = chosen.shape, values[0].type
    if len({*elements}) == 1:
        return Value(shape, kind, elements[0], 0, None)
    result = statements.array(shape, kind)
    if flat.size <= MAX_LISTED:
        text = [f"{result.element(n)} = {element};" for n, element in enumerate(elements)]
    else:
        text = _copy_runs(statements, result, owners, values, np.array([number for _, number in parts]))
    statements.add([result], " ".join(text))
    return result


def _copy_runs(
    statements: Statements, result: Value, owners: np.ndarray, values: Sequence[Value], numbers: np.ndarray
) -> list[str]:
    """Return C loops that copy elements: one per run with a constant step, or one with an index table."""
    runs, first = [], 0
    for last in range(1, len(owners) + 1):
        step = numbers[first + 1] - numbers[first] if last > first + 1 else 0
        if (
            last == len(owners)
            or owners[last] != owners[first]
            or (last > first + 1 and numbers[last] - numbers[last - 1] != step)
        ):
            runs.append((first, last, int(step)))
            first = last
    if len(runs) > MAX_LISTED and len(values) == 1:
        table = statements.table(numbers.astype(np.int32), "int32")
        return [
            loops([len(owners)], lambda i: f"{result.element(i)} = {values[0].element(f'{table}[{i}]')};")
        ]
    text = []
    for first, last, step in runs:
        source = values[int(owners[first])].view((last - first,), int(numbers[first]), step)
        goal = result.view((last - first,), first, 1)
        text.append(
            loops(
                [last - first],
                lambda i, goal=goal, source=source: f"{goal.element(i)} = {source.element(i)};",
            )
        )
    return text


def slice_at(statements: Statements, params: Parameters, values: Sequence[Value]) -> Value:
    """Return a slice of an array; its start indices are computed in C, and clamped so that the slice fits."""
    array, starts = statements.contiguous(values[0]), values[1:]
    sizes = params["slice_sizes"]
    result = statements.variable(sizes, array.type)
    begin, names = _clamped_starts(array.shape, sizes, starts)
    strides = strides_of(array.shape)

    def move(*indices: str) -> str:
        position = index_of(strides, [*map(_shifted, names, indices)])
        return f"{result.element(index_of(strides_of(sizes), indices))} = {array.element(position)};"

    statements.add([result], f"{{ {begin} {loops(sizes, move)} }}")
    return result


def update_at(statements: Statements, values: Sequence[Value]) -> Value:
    """Return an array with one part replaced; its start indices are computed in C, and clamped to fit."""
    array, part, starts = values[0], values[1], values[2:]
    result = statements.array(array.shape, array.type)
    begin, names = _clamped_starts(array.shape, part.shape, starts)
    strides = strides_of(array.shape)

    def move(*indices: str) -> str:
        position = index_of(strides, [*map(_shifted, names, indices)])
        source = part.element(index_of(strides_of(part.shape), indices))
        return f"{result.element(position)} = {source};"

    copy = loops([array.size], lambda i: f"{result.element(i)} = {array.element(i)};")
    statements.add([result], f"{copy} {{ {begin} {loops(part.shape, move)} }}")
    return result


def _clamped_starts(
    shape: Sequence[int], sizes: Sequence[int], starts: Sequence[Value]
) -> tuple[str, list[str]]:
    """Return C code that defines the clamped start indices, and the C expression of each start index."""
    text, names = [], []
    for axis, (length, size, start) in enumerate(zip(shape, sizes, starts, strict=True)):
        if length == size:
            names.append("0")
            continue
        names.append(f"s{axis}")
        text.append(f"const int64_t s{axis} = clamp_index({start.element()}, {length - size});")
    return " ".join(text), names


def _shifted(start: str, index: str) -> str:
    """Return the C expression of `start` plus `index`, without a term that is "0"."""
    return index if start == "0" else start if index == "0" else f"({start} + {index})"


def gather(
    statements: Statements, params: Parameters, values: Sequence[Value], shape: Sequence[int]
) -> Value:
    """Return slices of an array at computed indices; see `jax.lax.gather`."""
    array, indices = values
    dimensions, sizes = params["dimension_numbers"], params["slice_sizes"]
    offsets, batching = dimensions.offset_dims, tuple(dimensions.operand_batching_dims)
    fills = params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP
    window_axes = [
        axis for axis in range(len(sizes)) if axis not in (*dimensions.collapsed_slice_dims, *batching)
    ]
    result, array = statements.variable(shape, array.type), statements.contiguous(array)
    index_strides = strides_of(indices.shape)

    def move(*loop: str) -> str:
        batch = [index for axis, index in enumerate(loop) if axis not in offsets]
        window = dict(zip(window_axes, (loop[axis] for axis in offsets), strict=True))
        begin, positions, inside = [], [], []
        for axis, (length, size) in enumerate(zip(array.shape, sizes, strict=True)):
            position = window.get(axis, "0")
            if axis in dimensions.start_index_map:
                at = index_of(index_strides, [*batch, str(dimensions.start_index_map.index(axis))])
                start, highest = f"(int64_t){indices.element(at)}", length - size
                inside.append(f"{start} >= 0 && {start} <= {highest}")
                begin.append(f"const int64_t s{axis} = clamp_index({start}, {highest});")
                position = _shifted(f"s{axis}", position)
            elif axis in batching:
                position = batch[dimensions.start_indices_batching_dims[batching.index(axis)]]
            positions.append(position)
        element = array.element(index_of(strides_of(array.shape), positions))
        if fills and inside:
            element = f"{' && '.join(inside)} ? {element} : {_fill_value(params, array.type)}"
        goal = result.element(index_of(strides_of(shape), loop))
        return f"{' '.join(begin)} {goal} = {element};"

    statements.add([result], f"{{ {loops(shape, move)} }}")
    return result


def _fill_value(params: Parameters, type_name: str) -> str:
    """Return the C literal that a gather uses for elements outside its array."""
    value = params["fill_value"]
    if value is None:
        kind = np.dtype(type_name)
        value = (
            np.nan
            if kind.kind == "f"
            else True
            if kind.kind == "b"
            else (np.iinfo(kind).min if kind.kind == "i" else np.iinfo(kind).max)
        )
    return literal(value, type_name)
