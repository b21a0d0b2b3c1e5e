"""C99 generator on small programs: the same bits as Python, or an error with file and line."""

import ctypes
import itertools
import math
from math import exp, floor, inf, isfinite, log, nan, sqrt
from typing import Annotated, NamedTuple

import pytest
from codegen_programs import Inner, Pair, compiled, needs_compiler, same

from jaxhil.codegen import CProgram
from jaxhil.rig.filters import DelayLine
from jaxhil.rig.types import Positive

NUMBERS = (0.0, -0.0, 0.5, 1.0, -1.0, 1.5, -2.5, 2.5, 7.0, -7.3, 1e-320, 1e300, -1e300, inf, -inf, nan)
FAILED = 12345.0
WEIGHTS = (0.5, -2.0, 3.0)  # weights of readings in a sum


def divide(a: float, b: float) -> float:
    return (a - 1.0) / (b - 1.0) + a / 3.0


def root(a: float, b: float) -> float:
    return sqrt(a) + sqrt(a * a + b * b) + (sqrt(b) if b > 0.0 else 0.0)


def powers(a: float, b: float) -> float:
    return exp(a) + log(b) + a**2 + b**a


def extremes(a: float, b: float) -> float:
    return max(a, b, 1.0) - min(b, a) + abs(min(a, 0.5))


def whole(a: float, b: float) -> float:
    return int(a) * 1000.0 + round(b) + floor(a)


def product_of_ints(a: float, b: float) -> float:
    return float(int(a) * int(b))


def sums_of_ints(a: float, b: float) -> float:
    """Double, subtract and multiply integers."""
    total, more = int(a), int(b)
    for _ in range(100):
        total = total + total
    return float(total - more * 3000000) + float(more - int(b + 1.0))


def remainders(a: float, b: float) -> float:
    return a // b + a % b


def remainders_of_ints(a: float, b: float) -> float:
    first, second = int(a), int(b)
    return float(first // second + 100 * (first % second))


def early_return(a: float, b: float) -> float:
    """Return from within loops and branches."""
    total = 0.0
    for index, weight in enumerate(WEIGHTS):
        if weight * a > 10.0:
            return total
        elif not a <= b:
            continue
        total += weight * (a + index)
    passes = 0
    while total > 1.0:
        total = 0.5 * total - b
        passes += 1
        if total < -3.0 or passes > 20:
            break
    return total


def conditions(a: float, b: float) -> float:
    between = 0.0 <= a < b or (a != b and not b)
    first = a if between else (b if a == 1.0 else -a)
    return first / a if between and b / a > 1.0 else first


class Outer:
    """Objects, lists of lists, and a delay line whose length is known at run time."""

    inner: Inner
    matrix: Annotated[list[list[float]], 3, 2]

    def __init__(self, scale: float, period: Positive) -> None:
        self.inner = Inner(scale)
        self._line = DelayLine(2.5 * period, period)
        self.matrix = [[scale, 1.0 + scale] for _ in range(3)]
        self.pair = Pair(0.0, 0.0, 0)

    def step(self, a: float, b: float) -> float:
        before = self.inner.calls + self.inner.add(a) + self.inner.calls
        self._turn(b)
        self.pair = self.inner.pair()
        rows = [list(row) for row in self.matrix]
        rows[1][0] = self._line.step(b)
        sums = [dot(row, self.matrix[0]) for row in rows]
        return before + self.pair.second + sums[0] * sums[-1] + self.pair.count

    def _turn(self, b: float) -> None:
        for j, row in enumerate(self.matrix):
            row[:] = [row[1 - k] * 0.5 + b + j for k in range(2)]


def dot(left: list[float], right: list[float]) -> float:
    total = 0.0
    for first, second in zip(left, right, strict=True):
        total += first * second
    return total


def caught(function):
    """Return a function that returns `FAILED` if `function` raises."""

    def guarded(a: float, b: float) -> float:
        try:
            value = function(a, b)
        except Exception:
            value = FAILED
        return value

    return guarded


FUNCTIONS = (
    divide,
    root,
    powers,
    extremes,
    whole,
    product_of_ints,
    sums_of_ints,
    remainders,
    remainders_of_ints,
    early_return,
    conditions,
)
OF_INTS = (whole, product_of_ints, sums_of_ints, remainders_of_ints)


@needs_compiler
@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda function: function.__name__)
def test_c99_function_equals_python_and_fails_where_python_raises(function, tmp_path):
    guarded = caught(function)
    program = CProgram("t_", public={guarded: "t_guarded"})
    program.add(guarded)
    in_c = compiled(tmp_path, program).t_guarded
    in_c.restype, in_c.argtypes = ctypes.c_double, (ctypes.c_double, ctypes.c_double)
    results = set()
    for a, b in itertools.product(NUMBERS, repeat=2):
        expected = guarded(a, b)
        # Integers of the C99 subset are limited to 2^53, and powers are real.
        is_beyond = function in OF_INTS and max(abs(a), abs(b)) > 2.0**53
        is_beyond |= function is sums_of_ints and isfinite(a) and abs(a) >= 1.0
        assert same(in_c(a, b), FAILED if is_beyond or isinstance(expected, complex) else expected), (a, b)
        results.add(str(expected))
    assert len(results) > 5


STATEFUL = f"""
static t_outer outer;
bool begin(double scale) {{
    bool error = false;
    t_outer_init(&outer, scale, 0.5, &error);
    return !error;
}}
double step(double a, double b) {{
    bool error = false;
    const double result = t_outer_step(&outer, a, b, &error);
    return error ? {FAILED} : result;
}}
"""


@needs_compiler
def test_c99_classes_records_and_lists_equal_python_bit_for_bit(tmp_path):
    program = CProgram("t_")
    program.add(Outer.__init__, Outer)
    program.add(Outer.step, Outer)
    library = compiled(tmp_path, program, f"bool begin(double);\ndouble step(double, double);\n{STATEFUL}")
    library.begin.argtypes, library.step.argtypes = [ctypes.c_double], [ctypes.c_double] * 2
    library.begin.restype, library.step.restype = ctypes.c_bool, ctypes.c_double
    assert library.begin(0.25)
    outer, failures = Outer(0.25, 0.5), 0
    for a, b in [
        *itertools.product((3.0, 0.5, 1.7), (0.0, -0.3, 2.0)),
        *itertools.product((3.0, nan), (1.0,)),
    ]:
        try:
            expected = outer.step(a, b)
        except ZeroDivisionError:
            expected, failures = FAILED, failures + 1
        assert same(library.step(a, b), expected), (a, b)
    assert 0 < failures < 9


def test_c99_code_omits_zero_check_for_nonzero_constant_divisors():
    def safe(a: float, b: float) -> float:
        if not b > 0.0:
            return a / 3.0
        return a / b + a / (1.0 + b * b) + sqrt(a * a) / sqrt(b)

    program = CProgram("t_", public={safe: "t_safe"})
    program.add(safe)
    assert "error" not in program.output().definitions


def test_c99_output_is_deterministic():
    def text() -> tuple[str, str]:
        program = CProgram("t_")
        program.add(Outer.__init__, Outer)
        program.add(Outer.step, Outer)
        return tuple(program.output())

    assert text() == text() and math.isfinite(len(text()[1]))


class Constants(NamedTuple):
    """Record with a field that a function does not use; the function uses the others in another order."""

    first: float
    rows: Annotated[list[list[float]], 2, 3]
    last: Annotated[list[float], 3]


def weighed(constants: Constants, a: float) -> float:
    _, middle, _ = constants.last
    return a * middle + constants.rows[1][2]


@needs_compiler
def test_c99_record_has_all_fields_in_order_and_unused_names_are_left_out(tmp_path):
    program = CProgram("test_", public={weighed: "test_weighed"})
    program.add(weighed)
    code = program.output()
    fields = "double first;\n    double rows[2][3];\n    double last[3];"
    assert fields in code.declarations and "double _" not in code.definitions
    library = compiled(tmp_path, program)

    class Struct(ctypes.Structure):
        _fields_ = (
            ("first", ctypes.c_double),
            ("rows", ctypes.c_double * 3 * 2),
            ("last", ctypes.c_double * 3),
        )

    values = Constants(1.0, [[2.0, 3.0, 4.0], [5.0, 6.0, 7.0]], [8.0, 9.0, 10.0])
    rows = (ctypes.c_double * 3 * 2)(*((ctypes.c_double * 3)(*row) for row in values.rows))
    library.test_weighed.restype = ctypes.c_double
    library.test_weighed.argtypes = (Struct, ctypes.c_double)
    packed = Struct(values.first, rows, (ctypes.c_double * 3)(*values.last))
    assert library.test_weighed(packed, 0.3) == weighed(values, 0.3)
