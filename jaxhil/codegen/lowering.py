"""Base of the lowering of one function: output, error flag, order of evaluation, facts about numbers."""

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
SIGN_IF_FALSE = {ast.Lt: ">= 0", ast.LtE: "> 0", ast.Eq: "not 0"}


class NumberFact(NamedTuple):
    """Fact about a number at one position in the code."""

    sign: str
    reads: Locations = frozenset()  # on which it depends
    span: tuple[Any, Any] | None = None  # least and largest value; the number is not NaN


class Lowering:
    """State of the lowering of one function."""

    def __init__(self, program: "CProgram", function: "CFunction") -> None:
        self.program, self.function = program, function
        self.names: dict[str, CExpression] = {}  # local names
        self.facts: dict[str, NumberFact] = {}  # by the C text of a number
        self.lines: list[str] = []
        self.failures = 0  # number of tests so far that may leave the function
        self.effects: list[Locations] = []  # what calls have changed so far
        self.compared: list[ast.expr] = []  # sums whose value is only compared

    def refuse(self, node: ast.AST, found: str, expected: str) -> SubsetError:
        """Return the error for a construct outside the subset."""
        line = getattr(node, "lineno", self.function.node.lineno)
        return refusal(self.function.file, line, found, expected)

    def emit(self, *lines: str) -> None:
        """Add lines; `printing` indents them."""
        self.lines += lines

    @contextmanager
    def captured(self) -> Iterator[list[str]]:
        """Collect the lines emitted in the context in a new list; drop its facts afterwards."""
        before, facts, effects = self.lines, self.facts, len(self.effects)
        self.lines, self.facts = [], dict(facts)
        yield self.lines
        written = frozenset().union(*self.effects[effects:])
        self.lines, self.facts = before, {k: fact for k, fact in facts.items() if not fact.reads & written}

    def fresh(self, hint: str) -> str:
        """Return an unused local name."""
        numbers = (f"{hint}_{number}" for number in range(2, 10_000))
        name = next(candidate for candidate in (hint, *numbers) if candidate not in self.function.taken)
        self.function.taken.add(name)
        return name

    def temporary(self, value: CExpression, hint: str) -> CExpression:
        """Store a value in a local constant."""
        name = self.fresh(hint)
        self.emit(f"const {self.program.c_type(value.type)} {name} = {value.text};")
        self.check(value)
        return CExpression(name, value.type, sign=value.sign)

    def simple(self, value: CExpression, hint: str) -> CExpression:
        """Return a value whose text may be repeated."""
        is_simple = value.text.replace("->", "").replace(".", "").replace("_", "").isalnum()
        return value if is_simple and not value.writes else self.temporary(value, hint)

    def check(self, value: CExpression) -> None:
        """Leave the function if the call that gave a value failed."""
        if value.fails:
            self.fail_if("*error", None)

    def fail_if(self, condition: str, node: ast.AST | None, reason: str = "") -> None:
        """Set the error flag and leave the function if a condition holds."""
        self.emit(f"if ({condition}) {{")
        self.fail(node, reason)
        self.emit("}")

    def fail(self, node: ast.AST | None, reason: str) -> None:
        """Leave the function; set the error flag, which is set already if `node` is None."""
        self.failures += 1
        self.function.fails = True
        nothing = {"float": " 0.0", "int": " 0", "bool": " false"}.get(self.function.returns.kind, "")
        if node is not None:
            line = getattr(node, "lineno", 0)
            self.function.reason = self.function.reason or f"{self.function.file}:{line}: found {reason}"
            self.emit("*error = true;")
        self.emit(f"return{nothing};")

    def expression(self, node: ast.expr) -> CExpression:
        """Lower an expression."""
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

    def fit(self, node: ast.AST, wanted: ValueType, value: CExpression, use: str, expected: str = "") -> None:
        """Raise SubsetError unless a value has the wanted type and sign."""
        is_same = (wanted.kind, wanted.of) == (value.type.kind, value.type.of)
        if not is_same and not (wanted.kind == "float" and value.is_number):
            raise self.refuse(node, f"a {value.type.kind} {use}", expected or f"a {wanted.kind}")
        if not implies_sign(value.sign, wanted.sign):
            raise self.refuse(node, f"a number of unknown sign {use}", f"one that is {wanted.sign}")

    def number(self, node: ast.expr) -> CExpression:
        """Lower an expression that has to be a number."""
        value = self.expression(node)
        if not value.is_number:
            raise self.refuse(node, f"a {value.type.kind} as an operand", "a number")
        return value

    def truth(self, node: ast.expr) -> CExpression:
        """Lower an expression as a condition."""
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
        """Lower expressions that Python evaluates from left to right."""
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
        """Return a name for the value of a call."""
        called = node.func if isinstance(node, ast.Call) else node
        name = called.attr if isinstance(called, ast.Attribute) else getattr(called, "id", "value")
        return name.lstrip("_")

    def note(self, writes: Locations) -> None:
        """Record what an assignment or a call changes."""
        if writes:
            self.effects.append(writes)
            self.function.writes |= writes
            self.facts = {key: fact for key, fact in self.facts.items() if not fact.reads & writes}

    def explain(self, statement: ast.stmt) -> None:
        """Print the comment above a statement."""
        if text := read_comment_before(self.function.file, statement):
            self.emit(f"/* {escape_comment(text)} */")

    def facts_of(self, node: ast.expr, truth: bool) -> dict[str, NumberFact]:
        """Return the facts about numbers that follow if a condition is true, or false."""
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
