"""C99 generator: message of each construct outside the subset, with file and line."""

import inspect

import pytest

from jaxhil.codegen import CProgram, SubsetError
from jaxhil.rig.types import NonNegative, Positive

NAMES = ("a", "b")
TABLE = {"a": 1.0}


def largest_of_one_number(a: float, b: float) -> float:
    return max(a)


def rounded_to_digits(a: float, b: float) -> float:
    return round(a, 2)


def power_of_matrices(a: float, b: float) -> float:
    return a @ b


def entry_of_a_table(a: float, b: float) -> float:
    return TABLE["a"] + b


def number_that_is_none(a: float, b: float) -> float:
    return 1.0 if a is None else b


def expression_for_two_names(a: float, b: float) -> float:
    first = second = a + b
    return first + second


def number_for_two_names(a: float, b: float) -> float:
    first, second = a
    return first + second


def three_numbers_for_two_names(a: float, b: float) -> float:
    first, second = [a, b, a]
    return first + second


def loop_over_text(a: float, b: float) -> float:
    for _ in NAMES:
        a += b
    return a


def every_second_index(a: float, b: float) -> float:
    for _ in range(0, 4, 2):
        a += b
    return a


def division_within_try(a: float, b: float) -> float:
    try:
        value = a / b
    except Exception:
        value = 0.0
    return value


def slice_of_computed_length(a: float, b: float) -> float:
    values = [a, b, 1.0]
    return values[int(a) :][0]


def comprehension_with_condition(a: float, b: float) -> float:
    values = [value for value in [a, b] if value > 0.0]
    return values[0]


def unequal_lists(a: float, b: float) -> float:
    for first, second in zip([a, b], [1.0, 2.0, 3.0], strict=True):
        a += first * second
    return a


def too_few_arguments(a: float, b: float) -> float:
    return power_of_matrices(a)


def inverse(a: Positive, b: NonNegative) -> float:
    return b / a


def unknown_sign(a: float, b: float) -> float:
    return inverse(a, 1.0)


def attribute_of_a_number(a: float, b: float) -> float:
    a.b = b
    return a


MESSAGES = [
    (largest_of_one_number, 1, "max or min of other values, expected two or more numbers of one type"),
    (rounded_to_digits, 1, "round to digits, expected round to an int"),
    (power_of_matrices, 1, "MatMult, expected +, -, *, /, //, % or ** of numbers"),
    (entry_of_a_table, 1, "a non-number as an operand, expected a number"),
    (number_that_is_none, 1, "`is`, expected `is None` of a parameter `float | None`"),
    (expression_for_two_names, 1, "one expression for several targets, expected an assignment for each"),
    (number_for_two_names, 1, "a float for several names, expected a list of fixed length"),
    (three_numbers_for_two_names, 1, "2 targets for 3 values, expected as many targets as values"),
    (loop_over_text, 1, "a loop over text, or with else, expected a loop over numbers"),
    (every_second_index, 1, "this range, expected a range of ints with the step 1 or -1"),
    (division_within_try, 1, "this try, expected `name = call(...)` or `return call(...)`"),
    (slice_of_computed_length, 2, "this slice, expected constant bounds and a list of fixed length"),
    (comprehension_with_condition, 1, "this comprehension, expected a single `for` of known length"),
    (unequal_lists, 1, "zip of lists of {2, 3} elements, expected lists of the same fixed length"),
    (too_few_arguments, 1, "these arguments, expected one argument for each parameter"),
    (unknown_sign, 1, "a number of unknown sign for a, expected a number > 0"),
    (attribute_of_a_number, 1, "an attribute of a float, expected an object"),
]


@pytest.mark.parametrize(
    ("function", "line", "message"), MESSAGES, ids=lambda value: getattr(value, "__name__", "")
)
def test_message_for_rejected_c99_construct_names_file_line_and_alternative(function, line, message):
    with pytest.raises(SubsetError) as error:
        CProgram("t_").add(function)
    location = f"{__file__}:{inspect.getsourcelines(function)[1] + line}: "
    assert str(error.value).startswith(f"{location}found {message}"), error.value


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


def divide(a: float, b: float) -> float:
    return a / b


def test_c99_public_function_that_may_raise_is_rejected():
    program = CProgram("t_", public={divide: "t_divide"})
    program.add(divide)
    with pytest.raises(SubsetError, match=r"found a division whose divisor may be 0 within t_divide"):
        program.output()
