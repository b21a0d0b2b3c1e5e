"""C99 generator on small programs: the same bits as Python, or an error with file and line."""

import ctypes
import inspect
import itertools
import math
import struct
from math import exp, floor, inf, isfinite, log, nan, sqrt
from typing import Annotated, NamedTuple

import c99_cases
import pytest

from jaxhil.codegen import CProgram, SubsetError
from jaxhil.rig.filters import DelayLine
from jaxhil.rig.types import Positive

needs_compiler = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
NUMBERS = (0.0, -0.0, 0.5, 1.0, -1.0, 1.5, -2.5, 2.5, 7.0, -7.3, 1e-320, 1e300, -1e300, inf, -inf, nan)
FAILED = 12345.0
WEIGHTS = (0.5, -2.0, 3.0)  # weights of readings in a sum
HEADER = "#include <math.h>\n#include <stdbool.h>\n#include <stddef.h>\n#include <stdint.h>\n"
STRICT = ("-O2", "-Wconversion", "-Wshadow", "-Wno-unused-function", "-shared", "-fPIC")


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


def uses_sum(a: float, b: float) -> float:
    return sum([a, b])


def has_two_types(a: float, b: float) -> float:
    value = 1
    value = a + b
    return value


def shares_a_list(a: float, b: float) -> float:
    shared = Sharing(a)
    return shared.first[0] + b


def has_no_annotation(a, b):
    return a + b


def uses_text(a: float, b: float) -> float:
    return a + len("ab") + b


def calls_itself(a: float, b: float) -> float:
    return a if b > 0.0 else calls_itself(a, b + 1.0)


def has_a_dictionary(a: float, b: float) -> float:
    return {1: a}[1] + b


def hides_a_branch(a: float, b: float) -> float:
    with open("file") as file:
        return a + b + len(file.name)


class Aliasing:
    """Local name for a list that is then replaced in its attribute."""

    rows: Annotated[list[list[float]], 2, 2]

    def __init__(self, start: float) -> None:
        self.last = [start] * 2
        self.rows = [[start, 1.0] for _ in range(2)]
        self.inner = Inner(start)

    def replace(self) -> None:
        self.last = [1.0, 2.0]

    def then_read(self, a: float, b: float) -> float:
        last = self.last
        self.last = [a, b]
        return last[0]

    def replaced_by_a_call(self, a: float, b: float) -> float:
        last = self.last
        self.replace()
        return last[0]

    def replace_and_read(self, values: Annotated[list[float], 2]) -> float:
        self.replace()
        return values[0]

    def replaced_by_the_called(self, a: float, b: float) -> float:
        return self.replace_and_read(self.last) + a + b

    def read_in_the_next_pass(self, a: float, b: float) -> float:
        last, total = self.last, 0.0
        for _ in range(3):
            total += last[0]
            self.last = [total, b]
        return total

    def replaced_while_looped_through(self, a: float, b: float) -> float:
        total = 0.0
        for value in self.last:
            total += value
            self.last = [a, total]
        return total

    def object_replaced(self, a: float, b: float) -> float:
        inner = self.inner
        self.inner = Inner(a)
        return inner.add(b)

    def row_replaced(self, a: float, b: float) -> float:
        row = self.rows[0]
        self.rows[0] = [a, b]
        return row[0]

    def changed_in_place(self, a: float, b: float) -> float:
        last, rows = self.last, self.rows
        row = rows[1]
        last[:] = [last[1] + a, b]
        row[:] = [b, a]
        rows[0] = [row[0] - 1.0, last[1]]
        total = 0.0
        for value in last:
            total += value + self.rows[0][0] + self.rows[1][1]
        self.last = [total, last[0]]
        return total + self.last[1] + rows[0][0]


class Sharing:
    """Two attributes that share one list, which is modified in place."""

    def __init__(self, start: float) -> None:
        self.first = [start] * 2
        self.second = self.first
        self.first[0] = 0.0


class Defaulting:
    """Class with an attribute that has a default and that only a method assigns, not `__init__`."""

    count: int = 3

    def __init__(self, start: float) -> None:
        self.total = start

    def step(self, a: float, b: float) -> float:
        self.total += a * self.count
        self.count = 2
        return self.total + b


@pytest.mark.parametrize(
    ("function", "line", "message"),
    [
        (uses_sum, 1, "found sum(...), expected a loop"),
        (has_two_types, 2, "found a float for a int, expected one type for each name"),
        (shares_a_list, 1, "found Sharing(...) here, expected `self.name = Class(...)`"),
        (has_no_annotation, 0, "found no type in C for a of has_no_annotation, expected an annotation"),
        (uses_text, 1, "found len of a non-number, expected len of a list"),
        (calls_itself, 0, "found calls_itself calling itself, expected a loop"),
        (has_a_dictionary, 1, "found Dict, expected an expression of numbers"),
        (hides_a_branch, 1, "found With, expected assignments, if, for"),
        (Sharing.__init__, 2, "found a list that is shared and changed in place, expected a copy"),
        (
            Defaulting.step,
            2,
            "found the first assignment to count, which has a default, expected an assignment",
        ),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_python_construct_outside_c99_subset_is_rejected_with_file_and_line(function, line, message):
    program = CProgram("t_")
    owner = {Sharing.__init__: Sharing, Defaulting.step: Defaulting}.get(function)
    with pytest.raises(SubsetError) as error:
        if owner is not None:
            program.add(owner.__init__, owner)
        program.add(function, owner)
        program.output()
    location = f"{inspect.getsourcefile(function)}:{inspect.getsourcelines(function)[1] + line}: "
    assert str(error.value).startswith(location + message), error.value


@pytest.mark.parametrize(
    ("method", "line", "name"),
    [
        (Aliasing.then_read, 2, "last"),
        (Aliasing.replaced_by_a_call, 2, "last"),
        (Aliasing.read_in_the_next_pass, 4, "last"),
        (Aliasing.replaced_while_looped_through, 4, "the loop"),
        (Aliasing.row_replaced, 2, "row"),
        (Aliasing.object_replaced, 2, "inner"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_c99_access_to_replaced_list_through_old_alias_is_rejected(method, line, name):
    program = CProgram("t_")
    program.add(Aliasing.__init__, Aliasing)
    with pytest.raises(SubsetError) as error:
        program.add(method, Aliasing)
    location = f"{__file__}:{inspect.getsourcelines(method)[1] + line}: "
    assert str(error.value).startswith(
        f"{location}found a new list or object while {name} uses the old one, expected"
    )


def test_c99_list_alias_is_rejected_if_called_method_replaces_the_list():
    program = CProgram("t_")
    program.add(Aliasing.__init__, Aliasing)
    with pytest.raises(SubsetError, match="found values as an argument of replace_and_read, which"):
        program.add(Aliasing.replaced_by_the_called, Aliasing)


@needs_compiler
def test_c99_list_with_two_names_is_modified_in_place_as_in_python(tmp_path):
    program = CProgram("t_")
    program.add(Aliasing.__init__, Aliasing)
    program.add(Aliasing.changed_in_place, Aliasing)
    more = """
static t_aliasing aliasing;
void begin(double start) { t_aliasing_init(&aliasing, start); }
double step(double a, double b) { return t_aliasing_changed_in_place(&aliasing, a, b); }
"""
    library = compiled(tmp_path, program, f"void begin(double);\ndouble step(double, double);\n{more}")
    library.begin.argtypes, library.step.argtypes = [ctypes.c_double], [ctypes.c_double] * 2
    library.step.restype = ctypes.c_double
    library.begin(0.5)
    aliasing = Aliasing(0.5)
    for a, b in itertools.product((0.1, -3.0, 7.5), repeat=2):
        assert same(library.step(a, b), aliasing.changed_in_place(a, b))


def test_c99_public_function_that_may_raise_is_rejected():
    program = CProgram("t_", public={divide: "t_divide"})
    program.add(divide)
    with pytest.raises(SubsetError, match=r"found a division whose divisor may be 0 within t_divide"):
        program.output()


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
    """Record of which a function uses some fields, in another order."""

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
