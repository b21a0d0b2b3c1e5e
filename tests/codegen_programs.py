"""Small Python classes for the C99 generator, and their compilation."""

import ctypes
import struct
from typing import NamedTuple

import c99_cases
import pytest

from jaxhil.codegen import CProgram

needs_compiler = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
HEADER = "#include <math.h>\n#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>\n"
STRICT = ("-O2", "-Wconversion", "-Wshadow", "-Wno-unused-function", "-shared", "-fPIC")


class Pair(NamedTuple):
    """Two numbers and a count."""

    first: float
    second: float
    count: int


class Inner:
    """Sum of numbers and their last values."""

    __slots__ = ("_last", "_sum", "calls")

    def __init__(self, start: float) -> None:
        self._sum = start
        self._last = [0.0] * 3
        self.calls = 0

    def add(self, value: float) -> float:
        """Add a value."""
        last = self._last
        last[self.calls % 3] = value
        self.calls += 1
        self._sum += value / last[2] if value > 1.0 else last[1]
        return self._sum

    def pair(self) -> Pair:
        return Pair(self._sum, self._last[-1], self.calls)


def compiled(tmp_path, program: CProgram, more: str = "") -> ctypes.CDLL:
    """Return the program as a shared library, compiled with the controller's strict flags."""
    output = program.output()
    text = f"{HEADER}#define T_DELAY_LINE_SAMPLES 4\n{output.declarations}\n{output.definitions}\n{more}"
    (tmp_path / "program.c").write_text(text)
    return ctypes.CDLL(str(c99_cases.compiled(tmp_path, "program.c", "program.so", *STRICT)))


def same(actual: float, expected: float) -> bool:
    return struct.pack("d", actual) == struct.pack("d", expected) or (
        actual != actual and expected != expected
    )
