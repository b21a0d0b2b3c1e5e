"""C functions of a jaxpr: calls, branches and loops, and the assembly of the file."""

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax.extend.core import Literal

from tuning.bundle.jaxpr_c.control_flow import CONTROL_FLOW
from tuning.bundle.jaxpr_c.elementwise import HELPERS, expression
from tuning.bundle.jaxpr_c.movement import (
    broadcast,
    gather,
    select_elements,
    slice_at,
    update_at,
)
from tuning.bundle.jaxpr_c.statements import Statements, loops
from tuning.bundle.jaxpr_c.sums import FOLDS, fold, multiply
from tuning.bundle.jaxpr_c.values import C_TYPES, UnsupportedProgram, Value, type_of

LINE_LENGTH = 115  # [characters]
PART = re.compile(r"\bpart_\d+\b")
# Parameters that contain the program of a call.
CALLS = {name: "jaxpr" for name in ("jit", "pjit", "closed_call", "core_call", "remat2", "checkpoint")}
CALLS |= {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr"}


class Program:
    """Functions and tables of a C file."""

    def __init__(self) -> None:
        self.tables: dict[str, str] = {}
        self._functions: dict[str, str] = {}  # name of each function by its text

    def add(self, jaxpr: Any, name: str | None = None) -> str:
        """Add a function for a closed jaxpr; return its name. Equal functions are added once."""
        statements = Statements(self.tables)
        parameters, arguments = [], []
        for n, variable in enumerate(jaxpr.jaxpr.invars):
            shape, kind = variable.aval.shape, type_of(variable.aval)
            # Only a function with a given name is called from other files; all its arguments are arrays.
            is_array = int(np.prod(shape)) != 1
            pointer = is_array or name is not None
            parameters.append(f"const {C_TYPES[kind]} {'*' if pointer else ''}a{n}")
            scalar = f"a{n}[0]" if name is not None else f"a{n}"
            arguments.append(Value(shape, kind, f"a{n}") if is_array else Value(shape, kind, scalar, 0, None))
        results = Translator(self, statements).translate(jaxpr.jaxpr, jaxpr.consts, arguments)
        parameters += [f"{value.c_type} *r{n}" for n, value in enumerate(results)]
        end = "\n".join(
            f"r{n}[0] = {value.element()};"
            if value.size == 1
            else loops([value.size], lambda i, n=n, value=value: f"r{n}[{i}] = {value.element(i)};")
            for n, value in enumerate(results)
        )
        lines = statements.text(end)
        text = "\n".join(lines)
        unused = [f"a{n}" for n in range(len(arguments)) if not re.search(rf"\ba{n}\b", text)]
        lines += [f"(void){', (void)'.join(unused)};"] if unused else []
        body = "\n".join(_wrap(f"    {line}") for line in lines)
        head = f"{'static ' if name is None else ''}void @({', '.join(parameters)}) {{"
        text = f"{_wrap(head)}\n{body}\n}}\n"
        if name is not None:
            text = text.replace("@", name, 1)
        return self._functions.setdefault(text, name or f"part_{len(self._functions) + 1}")

    def text(self, names: Sequence[str]) -> str:
        """Return the C code of functions, and of everything that they use."""
        functions = {
            function_name: text.replace("@", function_name, 1)
            for text, function_name in self._functions.items()
        }
        used, pending = {*names}, [*names]
        while pending:
            called = {*PART.findall(functions[pending.pop()].partition("{")[2])} - used
            used |= called
            pending += called
        body = "\n".join(text for function_name, text in functions.items() if function_name in used)
        helpers = [
            text for function_name, text in HELPERS.items() if re.search(rf"\b{function_name}\b", body)
        ]
        tables = [
            _wrap(f"static const {definition.replace('{}', function_name, 1)}")
            for definition, function_name in self.tables.items()
            if re.search(rf"\b{function_name}\b", body)
        ]
        return "\n".join([*tables, *([""] if tables else []), *helpers, body])


class Translator:
    """Translation of the equations of jaxprs to the statements of one C function."""

    def __init__(self, program: Program, statements: Statements) -> None:
        self._program, self._statements = program, statements

    def translate(self, jaxpr: Any, constants: Sequence[Any], arguments: Sequence[Value]) -> list[Value]:
        """Add the statements of a jaxpr; return the values of its results."""
        environment: dict[Any, Value] = dict(zip(jaxpr.invars, arguments, strict=True))
        for variable, constant in zip(jaxpr.constvars, constants, strict=True):
            environment[variable] = self._constant(constant, variable.aval)

        def read(atom: Any) -> Value:
            return self._constant(atom.val, atom.aval) if isinstance(atom, Literal) else environment[atom]

        for equation in _used_equations(jaxpr):
            values = [read(atom) for atom in equation.invars]
            results = self._apply(equation, values)
            environment |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _constant(self, array: Any, aval: Any) -> Value:
        value = self._statements.constant(np.asarray(array), type_of(aval))
        return value._replace(shape=tuple(aval.shape))

    def _apply(self, equation: Any, values: Sequence[Value]) -> Sequence[Value]:
        """Add the statements of one equation of a jaxpr; return the values of its results."""
        name, params, statements = equation.primitive.name, equation.params, self._statements
        shapes = [tuple(variable.aval.shape) for variable in equation.outvars]
        if name in CALLS:
            inner = params[CALLS[name]]
            return self.translate(getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), values)
        if name in CONTROL_FLOW:
            kinds = [type_of(variable.aval) for variable in equation.outvars]
            results = [*map(statements.variable, shapes, kinds)]
            CONTROL_FLOW[name](self._program.add, statements, params, values, results)
            return results
        if name == "optimization_barrier" or (
            name == "convert_element_type" and values[0].type == str(np.dtype(params["new_dtype"]))
        ):
            return values
        selected = select_elements(statements, name, params, values)
        if selected is not None:
            return selected
        if name == "dynamic_slice":
            return [slice_at(statements, params, values)]
        if name == "dynamic_update_slice":
            return [update_at(statements, values)]
        if name == "gather":
            return [gather(statements, params, values, shapes[0])]
        if name == "dot_general":
            return [multiply(statements, params, values)]
        if name in FOLDS:
            return [fold(statements, name, params["axes"], values[0])]
        written = expression(name, params, values)
        if written is None:
            types = ", ".join(value.type for value in values)
            raise UnsupportedProgram(f"primitive: found {name} of {types}, which has no translation to C")
        return [self._elementwise(written, values, shapes[0], type_of(equation.outvars[0].aval))]

    def _elementwise(
        self, written: Callable[..., str], values: Sequence[Value], shape: tuple[int, ...], kind: str
    ) -> Value:
        if all(value.is_uniform for value in values):
            return self._statements.define(shape, kind, written(*(value.name for value in values)))
        values = [broadcast(self._statements, value, shape) for value in values]
        result = self._statements.array(shape, kind)

        def body(index: str) -> str:
            return f"{result.element(index)} = {written(*(value.element(index) for value in values))};"

        self._statements.add([result], loops([result.size], body))
        return result


def _used_equations(jaxpr: Any) -> list[Any]:
    """Return the equations of a jaxpr whose results are used, in the jaxpr's order."""
    used, used_equations = {id(atom) for atom in jaxpr.outvars}, []
    for equation in reversed(jaxpr.eqns):
        if any(id(variable) in used for variable in equation.outvars):
            used_equations.append(equation)
            used |= {id(atom) for atom in equation.invars}
    return used_equations[::-1]


def _wrap(line: str) -> str:
    """Return a line of C as lines of a limited length."""
    if len(line) <= LINE_LENGTH:
        return line
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(
        line.strip(),
        LINE_LENGTH,
        initial_indent=indent,
        subsequent_indent=f"{indent}    ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def to_c(functions: Mapping[str, Any]) -> str:
    """Return C99 code, without `#include` lines, of functions that compute closed jaxprs.

    A function takes pointers to the row-major arrays of all arguments, then to those of all results.

    Args:
        functions: closed jaxprs by the function's name, traced with float64 enabled.

    Returns:
        The code: tables, auxiliary functions, and the functions.

    Raises:
        UnsupportedProgram: If a jaxpr has a primitive or a type that the generator cannot print.

    Example:
        >>> import jax, numpy
        >>> double = jax.make_jaxpr(lambda number: number + number)(numpy.float64(1))
        >>> print(to_c({"twice": double}).splitlines()[1].strip())
        const double v1 = a0[0] + a0[0];
    """
    program = Program()
    for name, jaxpr in functions.items():
        program.add(jaxpr, name)
    return program.text([*functions])
