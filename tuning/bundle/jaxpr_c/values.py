"""Values of a jaxpr in C: scalar expressions, arrays, and views of arrays that need no copy."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tuning.bundle.c99_tables import format_double

C_TYPES = {
    "float64": "double",
    "int32": "int32_t",
    "uint32": "uint32_t",
    "int64": "int64_t",
    "uint64": "uint64_t",
    "bool": "bool",
}


class UnsupportedProgram(Exception):
    """JAX program with a part that the generator cannot print."""


class Value(NamedTuple):
    """Value of a jaxpr's variable: element n of its row-major array is `name[offset + stride * n]`.

    Without a stride, all elements are equal to the scalar expression `name`.
    """

    shape: tuple[int, ...]
    type: str  # name of the type in NumPy
    name: str
    offset: int = 0
    stride: int | None = 1

    @property
    def size(self) -> int:
        """Return the number of elements."""
        return math.prod(self.shape)

    @property
    def c_type(self) -> str:
        """Return the type of an element in C."""
        return C_TYPES[self.type]

    @property
    def is_uniform(self) -> bool:
        """Return whether one scalar C expression is the value of all elements."""
        return self.stride is None

    def element(self, index: int | str = 0) -> str:
        """Return the C expression of the element at an index, which is a number or a C expression."""
        if self.stride is None:
            return self.name
        if isinstance(index, int):
            return f"{self.name}[{self.offset + self.stride * index}]"
        scaled = index if self.stride == 1 else f"{self.stride} * ({index})"
        return f"{self.name}[{self.offset} + {scaled}]" if self.offset else f"{self.name}[{scaled}]"

    def view(self, shape: Sequence[int], first: int, step: int) -> "Value":
        """Return the value with the elements `first`, `first + step`, ... of this value."""
        if self.stride is None:
            return self._replace(shape=tuple(shape))
        if step == 0 or math.prod(shape) == 1:
            return Value(tuple(shape), self.type, self.element(first), 0, None)
        return Value(
            tuple(shape), self.type, self.name, self.offset + self.stride * first, self.stride * step
        )


def type_of(aval: Any) -> str:
    """Return the name of a variable's type; raise `UnsupportedProgram` if it is not one of `C_TYPES`."""
    name = str(getattr(aval, "dtype", aval))
    if name not in C_TYPES:
        raise UnsupportedProgram(f"type: found {name}, expected one of {', '.join(C_TYPES)}")
    return name


def literal(number: Any, type_name: str) -> str:
    """Return the C literal of a number, in parentheses if it begins with a minus sign."""
    if type_name == "bool":
        return "true" if number else "false"
    if type_name == "float64":
        text = "NAN" if math.isnan(number) else format_double(float(number))
    elif type_name == "int32":
        text = "(-2147483647 - 1)" if number == -(2**31) else str(int(number))
    elif type_name == "int64":
        text = "INT64_MIN" if number == -(2**63) else f"INT64_C({int(number)})"
    else:
        text = f"{int(number)}u" if type_name == "uint32" else f"UINT64_C({int(number)})"
    return f"({text})" if text.startswith("-") else text


def initialiser(array: np.ndarray, type_name: str) -> str:
    """Return the C initialiser of an array."""
    return f"{{{', '.join(literal(number, type_name) for number in array.ravel().tolist())}}}"
