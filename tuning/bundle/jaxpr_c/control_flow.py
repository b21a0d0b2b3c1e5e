"""Branches and loops: their bodies become C functions, which receive pointers to their results."""

from collections.abc import Callable, Sequence
from typing import Any

from tuning.bundle.jaxpr_c.statements import Statements, loops
from tuning.bundle.jaxpr_c.values import Value

AddFunction = Callable[[Any], str]  # adds a function for a closed jaxpr, and returns its name
Values = Sequence[Value]


def add_branches(
    add: AddFunction, statements: Statements, params: dict[str, Any], values: Values, results: Values
) -> None:
    """Add C code that calls one of several functions by an index; any invalid index calls the last one."""
    index = values[0].element()
    arguments = ", ".join([*(_argument(statements, value) for value in values[1:]), *map(_target, results)])
    *first, last = [f"{{ {add(branch)}({arguments}); }}" for branch in params["branches"]]
    tests = [f"if ({index} == {n}) {call} else" for n, call in enumerate(first)]
    statements.add(results, " ".join([*tests, last]))


def add_while(
    add: AddFunction, statements: Statements, params: dict[str, Any], values: Values, results: Values
) -> None:
    """Add a C loop, which calls two functions: the condition and, while it is true, the body."""
    tested, body = add(params["cond_jaxpr"]), add(params["body_jaxpr"])
    arguments = [_argument(statements, value) for value in values]
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    following = [statements.variable(value.shape, value.type) for value in results]
    state = [_passed(value) for value in results]
    test = ", ".join([*arguments[:first], *state, "&goes_on"])
    step = ", ".join([*arguments[first:second], *state, *map(_target, following)])
    statements.add(
        [*results, *following],
        f"{_assign(results, values[second:])} for (;;) {{ bool goes_on; {tested}({test}); "
        f"if (!goes_on) {{ break; }} {body}({step}); {_assign(results, following)} }}",
    )


def add_scan(
    add: AddFunction, statements: Statements, params: dict[str, Any], values: Values, results: Values
) -> None:
    """Add a C loop that calls its body, a function, a constant number of times."""
    body, count = add(params["jaxpr"]), params["length"]
    constant_count, carry_count = params["num_consts"], params["num_carry"]
    carry, stacked = results[:carry_count], results[carry_count:]
    following = [statements.variable(value.shape, value.type) for value in carry]
    step = f"({count - 1} - n)" if params["reverse"] else "n"
    rows = [statements.contiguous(value) for value in values[constant_count + carry_count :]]
    call = ", ".join([
        *(_argument(statements, value) for value in values[:constant_count]),
        *map(_passed, carry),
        *(_row(value, count, step) for value in rows),
        *map(_target, following),
        *(_row_target(value, count, step) for value in stacked),
    ])  # fmt: skip
    start = _assign(carry, values[constant_count : constant_count + carry_count])
    statements.add(
        [*results, *following],
        f"{start} for (int n = 0; n < {count}; n++) {{ {body}({call}); {_assign(carry, following)} }}",
    )


CONTROL_FLOW = {"cond": add_branches, "while": add_while, "scan": add_scan}


def _argument(statements: Statements, value: Value) -> str:
    """Return the C argument that passes a value to a function; copy an array that is not contiguous first."""
    return _passed(statements.contiguous(value))


def _passed(value: Value) -> str:
    """Return the C argument that passes a contiguous value to a function: a number or a pointer."""
    if value.size == 1:
        return value.element()
    return f"{value.name} + {value.offset}" if value.offset else value.name


def _target(value: Value) -> str:
    """Return the C argument that tells a function where to store a result: a pointer."""
    return f"&{value.name}" if value.is_uniform else value.name


def _row(value: Value, count: int, step: str) -> str:
    """Return the C argument that passes row `step` of an input with `count` rows to the body of a loop."""
    size = value.size // count
    return value.element(step) if size == 1 else f"{_passed(value)} + {size} * {step}"


def _row_target(value: Value, count: int, step: str) -> str:
    """Return the C argument, a pointer, for row `step` of a result in which a loop stores `count` rows."""
    return f"&{value.name}" if value.is_uniform else f"{value.name} + {value.size // count} * {step}"


def _assign(results: Values, values: Values) -> str:
    """Return the C statements that copy `values` to `results`."""
    return " ".join(
        loops(
            [result.size],
            lambda index, result=result, value=value: f"{result.element(index)} = {value.element(index)};",
        )
        for result, value in zip(results, values, strict=True)
    )
