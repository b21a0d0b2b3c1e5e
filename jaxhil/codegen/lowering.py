"""Base class for the lowering of a function: output, error flag, evaluation order, facts about numbers."""

import ast
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from .printing import escape_comment
from .python_source import read_comment_before
from .subset import (
    BOOL,
    EQUALITY,
    RELATION,
    TEXT,
    CExpression,
    Locations,
    SubsetError,
    ValueType,
    implies_sign,
    refusal,
)

if TYPE_CHECKING:
    from .program import CFunction, CProgram

SIGN_IF_TRUE = {ast.Gt: "> 0", ast.GtE: ">= 0", ast.Lt: "not 0", ast.NotEq: "not 0"}  # sign of x if x OP 0
SIGN_IF_FALSE = {ast.Lt: ">= 0", ast.LtE: "> 0", ast.Eq: "not 0"}  # sign of x if x OP 0 is false


class NumberFact(NamedTuple):
    """Sign and range that a number certainly has at one position in the code."""

    sign: str
    reads: Locations = frozenset()  # locations on which the number depends
    span: tuple[Any, Any] | None = None  # least and largest value, which exclude NaN


class Lowering:
    """State of the lowering of one function: names, facts about numbers, and lines of C code."""

    def __init__(self, program: "CProgram", function: "CFunction") -> None:
        self.program, self.function = program, function
        self.names: dict[str, CExpression] = {}  # C expressions of local names
        self.facts: dict[str, NumberFact] = {}  # facts about numbers, by their C code
        self.lines: list[str] = []
        self.failures = 0  # number of emitted tests that may return from the function
        self.effects: list[Locations] = []  # locations that the code so far has changed
        self.compared: list[ast.expr] = []  # sums that are only operands of comparisons

    def refuse(self, node: ast.AST, found: str, expected: str) -> SubsetError:
        """Return the `SubsetError` for an unsupported construct at `node`."""
        line = getattr(node, "lineno", self.function.node.lineno)
        return refusal(self.function.file, line, found, expected)

    def emit(self, *lines: str) -> None:
        """Add lines of C code; `printing` indents them later."""
        self.lines += lines

    @contextmanager
    def captured(self) -> Iterator[list[str]]:
        """Context manager: collect the lines that the body of `with` emits; at its end, restore the facts."""
        before, facts, effects = self.lines, self.facts, len(self.effects)
        self.lines, self.facts = [], dict(facts)
        yield self.lines
        written = frozenset().union(*self.effects[effects:])
        self.lines, self.facts = before, {k: fact for k, fact in facts.items() if not fact.reads & written}

    def fresh(self, hint: str) -> str:
        """Return an unused local name that begins with `hint`."""
        numbers = (f"{hint}_{number}" for number in range(2, 10_000))
        name = next(candidate for candidate in (hint, *numbers) if candidate not in self.function.taken)
        self.function.taken.add(name)
        return name

    def temporary(self, value: CExpression, hint: str) -> CExpression:
        """Emit a local constant with a value; return the constant."""
        name = self.fresh(hint)
        self.emit(f"const {self.program.c_type(value.type)} {name} = {value.text};")
        self.check(value)
        return CExpression(name, value.type, sign=value.sign)

    def simple(self, value: CExpression, hint: str) -> CExpression:
        """Return the value; if its C code must not be repeated, first store it in a local constant."""
        is_simple = value.text.replace("->", "").replace(".", "").replace("_", "").isalnum()
        return value if is_simple and not value.writes else self.temporary(value, hint)

    def check(self, value: CExpression) -> None:
        """If the call that computes `value` may fail, emit a return from the function for this case."""
        if value.fails:
            self.fail_if("*error", None)

    def fail_if(self, condition: str, node: ast.AST | None, reason: str = "") -> None:
        """Emit code that sets the error flag and returns from the function if a condition holds."""
        self.emit(f"if ({condition}) {{")
        self.fail(node, reason)
        self.emit("}")

    def fail(self, node: ast.AST | None, reason: str) -> None:
        """Emit a return from the function; unless `node` is None, also emit code that sets the error flag."""
        self.failures += 1
        self.function.fails = True
        nothing = {"float": " 0.0", "int": " 0", "bool": " false"}.get(self.function.returns.kind, "")
        if node is not None:
            line = getattr(node, "lineno", 0)
            self.function.reason = self.function.reason or f"{self.function.file}:{line}: found {reason}"
            self.emit("*error = true;")
        self.emit(f"return{nothing};")

    def expression(self, node: ast.expr) -> CExpression:
        """Lower an expression, with the facts about its value."""
        if isinstance(node, ast.JoinedStr):
            return CExpression("", TEXT)
        lower = getattr(self, f"lower_{type(node).__name__.lower()}", None)
        if lower is None:
            raise self.refuse(node, type(node).__name__, "an expression of numbers, lists and attributes")
        value = lower(node)
        fact = self.facts.get(value.text)
        if fact is None:
            return value
        sign = value.sign if value.sign and implies_sign(value.sign, fact.sign) else fact.sign
        return value._replace(sign=sign, span=fact.span or value.span)

    def fit(
        self, node: ast.AST, required: ValueType, value: CExpression, use: str, expected: str = ""
    ) -> None:
        """Raise SubsetError unless a value has the required type and sign."""
        is_same = (required.kind, required.of) == (value.type.kind, value.type.of)
        if not is_same and not (required.kind == "float" and value.is_number):
            raise self.refuse(node, f"a {value.type.kind} {use}", expected or f"a {required.kind}")
        if not implies_sign(value.sign, required.sign):
            raise self.refuse(node, f"a number of unknown sign {use}", f"a number {required.sign}")

    def number(self, node: ast.expr) -> CExpression:
        """Lower an expression. Raise SubsetError if its value is not a number."""
        value = self.expression(node)
        if not value.is_number:
            raise self.refuse(node, f"a {value.type.kind} as an operand", "a number")
        return value

    def truth(self, node: ast.expr) -> CExpression:
        """Lower an expression to a C condition."""
        value = self.expression(node)
        if value.type.kind == "bool":
            return value
        if not value.is_number:
            raise self.refuse(node, f"a {value.type.kind} as a condition", "a comparison")
        zero = "0" if value.type.kind == "int" else "0.0"
        text = f"{value.at(RELATION)} != {zero}"
        return value._replace(text=text, rank=EQUALITY, type=BOOL, sign="", constant=None)

    def operands(
        self, nodes: Sequence[ast.expr], lower: Callable[..., CExpression] | None = None
    ) -> list[CExpression]:
        """Lower expressions such that C evaluates them from left to right, as Python does."""
        values: list[CExpression] = []
        for node in nodes:
            position, before = len(self.lines), len(self.effects)
            value = (lower or self.expression)(node)
            is_held = (value.writes and node is not nodes[-1]) or value.fails
            if is_held and len(nodes) > 1 and value.type.kind not in ("none", "list"):
                value = self.temporary(value, self.hint_of(node))
            written = frozenset().union(*self.effects[before:])
            for index, earlier in enumerate(values):
                if earlier.reads & written and earlier.is_number:
                    later, self.lines = self.lines[position:], self.lines[:position]
                    values[index] = self.temporary(earlier, "earlier")
                    position = len(self.lines)
                    self.lines += later
            values.append(value)
        return values

    def hint_of(self, node: ast.expr) -> str:
        """Return a hint for the name of a local constant that contains the value of `node`."""
        called = node.func if isinstance(node, ast.Call) else node
        name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "value")
        return name.lstrip("_")

    def note(self, writes: Locations) -> None:
        """Record that a statement changes the variables `writes`; drop facts that depend on them."""
        if writes:
            self.effects.append(writes)
            self.function.writes |= writes
            self.facts = {key: fact for key, fact in self.facts.items() if not fact.reads & writes}

    def explain(self, statement: ast.stmt) -> None:
        """Emit the Python comment above a statement as a C comment."""
        if text := read_comment_before(self.function.file, statement):
            self.emit(f"/* {escape_comment(text)} */")

    def facts_of(self, node: ast.expr, truth: bool) -> dict[str, NumberFact]:
        """Return the facts about numbers that are certain if a condition has the value `truth`."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return self.facts_of(node.operand, not truth)
        if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.And) == truth:
            return {key: fact for part in node.values for key, fact in self.facts_of(part, truth).items()}
        if not isinstance(node, ast.Compare) or len(node.ops) != 1:
            return {}
        operator, left = type(node.ops[0]), node.left
        sign = (SIGN_IF_TRUE if truth else SIGN_IF_FALSE).get(operator, "")
        is_below = truth and operator in (ast.Lt, ast.LtE)
        if not (sign or is_below) or not isinstance(left, (ast.Name, ast.Attribute)):
            return {}
        with self.captured():
            value, limit = self.expression(left), self.expression(node.comparators[0]).constant
        if not isinstance(limit, (int, float)) or not value.is_number:
            return {}
        if is_below and value.sign in ("> 0", ">= 0"):
            return {value.text: NumberFact(value.sign, value.reads, (0, limit))}
        is_far = sign in ("> 0", ">= 0") and limit > 0
        return (
            {value.text: NumberFact("> 0" if is_far else sign, value.reads)} if limit == 0 or is_far else {}
        )
