"""C99 generator: local names of lists and objects that are later replaced or modified."""

import ctypes
import inspect
import itertools
from typing import Annotated

import pytest
from codegen_programs import Inner, compiled, needs_compiler, same

from jaxhil.codegen import CProgram, SubsetError


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
