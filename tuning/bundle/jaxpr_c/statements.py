"""Statements of a C function: variables, loops, removal of unused results, and shared memory of arrays."""

import math
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from tuning.bundle.jaxpr_c.values import C_TYPES, Value, initialiser, literal

NAME = re.compile(r"\bv\d+\b")


class Statement(NamedTuple):
    """C code of one statement, and the values that this code computes."""

    results: tuple[Value, ...]
    text: str


class Statements:
    """Statements of one C function.

    Args:
        tables: names of the C file's constant arrays by their definitions; the method `table` adds arrays.
    """

    def __init__(self, tables: dict[str, str]) -> None:
        self._tables, self._count, self._statements = tables, 0, list[Statement]()

    def scalar(self, shape: Sequence[int], type_name: str) -> Value:
        """Return a new value whose elements are all equal: a scalar in C."""
        self._count += 1
        return Value(tuple(shape), type_name, f"v{self._count}", 0, None)

    def array(self, shape: Sequence[int], type_name: str) -> Value:
        """Return a new value that is an array in C."""
        self._count += 1
        return Value(tuple(shape), type_name, f"v{self._count}")

    def variable(self, shape: Sequence[int], type_name: str) -> Value:
        """Return a new array, or a new scalar if the shape has a single element."""
        return (self.scalar if math.prod(shape) == 1 else self.array)(shape, type_name)

    def constant(self, array: np.ndarray, type_name: str) -> Value:
        """Return a constant: a literal if all elements are equal, else a table."""
        flat = np.asarray(array).ravel()
        if flat.size and all(str(number) == str(flat[0]) for number in flat):
            return Value(array.shape, type_name, literal(flat[0].item(), type_name), 0, None)
        return Value(array.shape, type_name, self.table(flat, type_name))

    def table(self, array: np.ndarray, type_name: str) -> str:
        """Return the name of a constant array in the generated C file."""
        definition = f"{C_TYPES[type_name]} {{}}[{max(1, array.size)}] = {initialiser(array, type_name)};"
        return self._tables.setdefault(definition, f"table_{len(self._tables) + 1}")

    def add(self, results: Sequence[Value], text: str) -> None:
        """Add the C statement `text`, which computes the values `results`."""
        self._statements.append(Statement(tuple(results), text))

    def define(self, shape: Sequence[int], type_name: str, expression: str) -> Value:
        """Return a new scalar with the value of a C expression."""
        value = self.scalar(shape, type_name)
        self.add([value], f"{value.name} = {expression};")
        return value

    def contiguous(self, value: Value) -> Value:
        """Return the elements as an array with a stride of 1; return a single element as it is."""
        if value.size == 1 or value.stride == 1:
            return value
        result = self.array(value.shape, value.type)
        self.add([result], loops([value.size], lambda i: f"{result.element(i)} = {value.element(i)};"))
        return result

    def text(self, end: str) -> list[str]:
        """Return the lines of the function's body: declarations, used statements, then the lines `end`."""
        used, used_statements = {*NAME.findall(end)}, []
        for statement in reversed(self._statements):
            if any(value.name in used for value in statement.results):
                used_statements.append(statement)
                used.update(NAME.findall(statement.text))
        used_statements.reverse()
        memory, declarations = _share_memory(used_statements, end)
        lines = [*declarations]
        for results, text in used_statements:
            lines += _declare_scalars(results, text)
        return [
            NAME.sub(lambda match: memory.get(match[0], match[0]), line)
            for line in [*lines, *end.splitlines()]
        ]


def _declare_scalars(results: Sequence[Value], text: str) -> list[str]:
    """Return the lines of the statement `text`, with declarations of its scalar results."""
    scalars = [value for value in results if value.is_uniform]
    if len(results) == 1 and scalars and text.startswith(f"{scalars[0].name} = ") and text.count(";") == 1:
        return [f"const {scalars[0].c_type} {text}"]
    return [*(f"{value.c_type} {value.name};" for value in scalars), text]


def _share_memory(statements: Sequence[Statement], end: str) -> tuple[dict[str, str], list[str]]:
    """Assign memory to arrays; return the memory's C name by the array's name, and the C declarations.

    Arrays of the same type and size share memory if one is no longer used when the other is first written.
    """
    last = {name: n for n, (_, text) in enumerate(statements) for name in NAME.findall(text)}
    last |= dict.fromkeys(NAME.findall(end), len(statements))
    names, free, busy, declarations = {}, {}, [], []
    for n, (results, _) in enumerate(statements):
        for key, name in [(key, name) for until, key, name in busy if until < n]:
            free.setdefault(key, []).append(name)
        busy = [entry for entry in busy if entry[0] >= n]
        for value in results:
            if value.is_uniform:
                continue
            key = value.c_type, max(1, value.size)
            if not free.get(key):
                free[key] = [f"w{len(declarations) + 1}"]
                declarations.append(f"{key[0]} {free[key][0]}[{key[1]}];")
            names[value.name] = free[key].pop()
            busy.append((last.get(value.name, n), key, names[value.name]))
    return names, declarations


def strides_of(shape: Sequence[int]) -> list[int]:
    """Return the row-major strides of an array."""
    return [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]


def index_of(strides: Sequence[int], indices: Sequence[str]) -> str:
    """Return the C expression of an element's position: the sum of stride * index over all axes."""
    terms = [
        index if stride == 1 else f"{stride} * {index}"
        for stride, index in zip(strides, indices, strict=True)
        if index != "0"
    ]
    return " + ".join(terms) or "0"


def loops(shape: Sequence[int], body: Callable[..., str]) -> str:
    """Return nested loops in C over all elements of an array.

    `body` takes an index for each axis and returns the C statement; an axis of length 1 has the index "0".
    """
    names = ["0" if length == 1 else f"i{axis}" for axis, length in enumerate(shape)]
    heads = [
        f"for (int {name} = 0; {name} < {length}; {name}++) {{"
        for name, length in zip(names, shape, strict=True)
        if name != "0"
    ]
    return " ".join([*heads, body(*names), *("}" for _ in heads)])
