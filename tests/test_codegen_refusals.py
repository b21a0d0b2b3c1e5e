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
