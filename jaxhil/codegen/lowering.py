"""Lowering of expressions of one function: arithmetic, comparisons, conditions, names.

The module also has what all parts of the lowering share: output, error flag, evaluation order, and known
signs and ranges of numbers.
"""

import ast
import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from .subset import BOOL, FLOAT, INT, SIGN_TEXTS, Locations, Sign, SubsetError, ValueType
from .values import ZEROS, CExpression, Rank, as_float, combine, constant, sign_of

if TYPE_CHECKING:
    from .program import CFunction, CProgram

# C operators, and functions that compute their values at export.
OPERATORS: dict[Any, tuple[str, Callable[..., Any]]] = {
    **{ast.Add: ("+", operator.add), ast.Sub: ("-", operator.sub), ast.Mult: ("*", operator.mul)},
    **{ast.Div: ("/", operator.truediv), ast.Eq: ("==", operator.eq), ast.NotEq: ("!=", operator.ne)},
    **{ast.Lt: ("<", operator.lt), ast.LtE: ("<=", operator.le)},
    **{ast.Gt: (">", operator.gt), ast.GtE: (">=", operator.ge)},
}
BIT_MARKS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
HELPERS = {ast.FloorDiv: "floor_division", ast.Mod: "modulo", ast.Pow: "power"}
LARGEST_INT = 2**53  # largest int of the subset; a double represents all smaller ints exactly
MAX_SQUARABLE_INT = 94906265  # largest int whose square is at most LARGEST_INT
MAX_INCREMENT = 2**10  # with this increment every millisecond, a counter needs 278 years to reach LARGEST_INT
# Sums of these nodes need no test if they are only compared: terms up to LARGEST_INT cannot overflow.
TERMS = (ast.BinOp, ast.Add, ast.Sub, ast.Name, ast.Attribute, ast.Constant, ast.expr_context)
# Sign of x if the comparison `x OP 0` is true, and if it is false.
SIGN_IF_TRUE: dict[Any, int] = {
    **{ast.Gt: Sign.POSITIVE, ast.GtE: Sign.NONNEGATIVE, ast.LtE: 0},
    **dict.fromkeys((ast.Lt, ast.NotEq), Sign.NONZERO),
}
SIGN_IF_FALSE: dict[Any, int] = {ast.Lt: Sign.NONNEGATIVE, ast.LtE: Sign.POSITIVE, ast.Eq: Sign.NONZERO}


def is_small(value: CExpression) -> bool:
    """Return whether an int is so small that a counter that it increments cannot reach LARGEST_INT."""
    has_bound = value.type.is_index or bool(value.below) or value.type.c_int != "int64_t"
    return has_bound or (value.span is not None and max(map(abs, value.span)) <= MAX_INCREMENT)


class ExpressionLowering:
    """Lowering (translation) of Python expressions to C; emits C statements that must precede them."""

    array: Callable[[Any, None], CExpression]
    call_helper: Callable[..., CExpression]

    def __init__(self, program: "CProgram", function: "CFunction") -> None:
        self.program, self.function = program, function
        self.names: dict[str, CExpression] = {}  # C expressions of local names
        self.facts: dict[str, CExpression] = {}  # expressions with a known sign or span, by their C code
        self.lines: list[str] = []
        self.failures = 0  # number of emitted tests that may return from the function
        self.effects: list[Locations] = []  # locations that the code so far has changed
        self.compared: list[ast.AST] = []  # sums that are only operands of comparisons

    def reject(self, node: ast.AST, found: str, expected: str) -> SubsetError:
        line = getattr(node, "lineno", self.function.node.lineno)
        return SubsetError(self.function.file, line, found, expected)

    def require(self, condition: Any, node: ast.AST, found: str, expected: str) -> None:
        if not condition:
            raise self.reject(node, found, expected)

    def emit(self, *lines: str) -> None:
        self.lines += lines

    @contextmanager
    def captured(self) -> Iterator[list[str]]:
        """Context manager: collect the C lines that the `with` body emits, instead of appending them.

        At its end, restore what was known about numbers before, except what the body invalidates.
        """
        before, facts, effects = self.lines, self.facts, len(self.effects)
        self.lines, self.facts = [], dict(facts)
        yield self.lines
        written = frozenset().union(*self.effects[effects:])
        self.lines, self.facts = before, {k: fact for k, fact in facts.items() if not fact.reads & written}

    def fresh(self, hint: str) -> str:
        """Return an unused local name that begins with `hint`."""
        name, number = hint, 1
        while name in self.function.taken:
            number += 1
            name = f"{hint}_{number}"
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
        return value if is_simple else self.temporary(value, hint)

    def check(self, value: CExpression) -> None:
        """If the call that computes `value` may fail, emit C code that returns early if it has failed."""
        if value.fails:
            self.fail_if("*error", None)

    def fail_if(self, condition: str, node: Any, reason: str = "") -> None:
        """Emit C code that, if a condition holds, returns from the C function with the error flag set."""
        self.emit(f"if ({condition}) {{")
        self.fail(node, reason)
        self.emit("}")

    def fail(self, node: Any, reason: str) -> None:
        """Emit a return from the C function. Unless `node` is None, the C code also sets the error flag."""
        self.failures += 1
        self.function.fails = True
        if node is not None:
            location = self.function.file, getattr(node, "lineno", 0)
            self.function.reason = self.function.reason or (*location, reason)
            self.emit("*error = true;")
        self.emit(f"return {ZEROS.get(self.function.returns.kind, '')}".rstrip() + ";")

    def expression(self, node: Any) -> CExpression:
        """Lower an expression to C; add what is known about the sign and range of its value."""
        lower = getattr(self, f"lower_{type(node).__name__.lower()}", None)
        if lower is None:
            raise self.reject(node, type(node).__name__, "an expression of numbers, lists and attributes")
        value = lower(node)
        fact = self.facts.get(value.text)
        return value._replace(sign=value.sign | fact.sign, span=fact.span or value.span) if fact else value

    def fit(self, node: Any, required: ValueType, value: CExpression, use: str, expected: str = "") -> None:
        """Raise SubsetError unless a value has the required type and sign."""
        is_same = (required.kind, required.of) == (value.type.kind, value.type.of)
        is_same |= required.kind == "float" and value.is_number
        self.require(is_same, node, f"a {value.type.kind} {use}", expected or f"a {required.kind}")
        expected = f"a number {SIGN_TEXTS.get(required.sign)}"
        self.require(not required.sign & ~value.sign, node, f"a number of unknown sign {use}", expected)

    def number(self, node: Any) -> CExpression:
        value = self.expression(node)
        self.require(value.is_number, node, f"a {value.type.kind} as an operand", "a number")
        return value

    def truth(self, node: Any) -> CExpression:
        value = self.expression(node)
        self.require(value.type.kind in ZEROS, node, f"a {value.type.kind} as a condition", "a comparison")
        if value.type.kind == "bool":
            return value
        text = f"{value.at(Rank.RELATION)} != {ZEROS[value.type.kind]}"
        return value._replace(text=text, rank=Rank.EQUALITY, type=BOOL, sign=0, constant=None)

    def operands(self, nodes: Sequence[Any], lower: Any = None) -> list[CExpression]:
        """Lower expressions such that C evaluates them from left to right, as Python does."""
        values: list[CExpression] = []
        for node in nodes:
            position, before = len(self.lines), len(self.effects)
            value = (lower or self.expression)(node)
            must_store = (value.writes and node is not nodes[-1]) or value.fails
            if must_store and len(nodes) > 1 and value.type.kind not in ("none", "list"):
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

    def hint_of(self, node: Any) -> str:
        called = node.func if isinstance(node, ast.Call) else node
        return getattr(called, "attr", getattr(called, "id", "value")).lstrip("_")

    def note(self, writes: Locations) -> None:
        """Record that a statement changes the variables `writes`; forget signs and ranges based on them."""
        self.effects.append(writes)
        self.function.writes |= writes
        self.facts = {key: fact for key, fact in self.facts.items() if not fact.reads & writes}

    def facts_of(self, node: Any, truth: bool) -> dict[str, CExpression]:
        """Return what a condition with the value `truth` implies about the signs and ranges of numbers."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return self.facts_of(node.operand, not truth)
        if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.And) == truth:
            return {key: fact for part in node.values for key, fact in self.facts_of(part, truth).items()}
        if not isinstance(node, ast.Compare) or not isinstance(node.left, (ast.Name, ast.Attribute)):
            return {}
        sign, span = (SIGN_IF_TRUE if truth else SIGN_IF_FALSE).get(type(node.ops[0])), None
        if sign is None or len(node.ops) > 1:
            return {}
        with self.captured():
            value, limit = self.expression(node.left), self.expression(node.comparators[0]).constant
        if not isinstance(limit, (int, float)) or not value.is_number:
            return {}
        if limit != 0:
            sign = Sign.POSITIVE * (limit > 0 and sign & Sign.NONNEGATIVE)
        if truth and isinstance(node.ops[0], (ast.Lt, ast.LtE)) and value.sign & Sign.NONNEGATIVE:
            sign, span = value.sign, (0, limit)
        return {value.text: value._replace(sign=sign, span=span)} if sign else {}

    def lower_constant(self, node: Any) -> CExpression:
        return constant(getattr(node, "value", ""))

    lower_joinedstr = lower_constant

    def lower_name(self, node: Any) -> CExpression:
        if node.id in self.names:
            self.function.reads |= self.names[node.id].reads
            return self.names[node.id]
        is_global = node.id in self.function.namespace and node.id not in self.function.occurrences
        self.require(is_global, node, f"the name {node.id}", "a name that is assigned earlier")
        return self.program.named_constant(node.id, self.function.namespace)

    def lower_binop(self, node: Any) -> CExpression:
        if isinstance(node.left, (ast.List, ast.Tuple)):
            return self.array(node, None)
        left, right = self.operands([node.left, node.right], self.number)
        op, is_int = type(node.op), left.type.kind == right.type.kind == "int"
        if op in BIT_MARKS and is_int:
            text = f"{left.at(Rank.UNARY)} {BIT_MARKS[op]} {right.at(Rank.UNARY)}"
            return combine(text, INT, Rank.BITS, left, right)
        if not is_int or op in (ast.Div, ast.Pow):
            left, right, is_int = as_float(left), as_float(right), False
        if op in HELPERS:
            return self.call_helper(node, left, right, HELPERS[op] + "_int" * is_int)
        expected = "+, -, *, /, //, % or ** of numbers, &, | or ^ of ints"
        self.require(op in OPERATORS, node, op.__name__, expected)
        (mark, compute), rank = OPERATORS[op], Rank.SUM if op in (ast.Add, ast.Sub) else Rank.PRODUCT
        if op is ast.Div:
            right = self.divisor(node, right)
        elif is_int and op is ast.Mult and not (left.span and right.span):
            left, right = self.simple(left, "factor"), self.simple(right, "factor")
            for factor, other in ((left, right), (right, left)):
                if factor.constant is None:
                    limit = LARGEST_INT // max(abs(other.constant), 1) if other.span else MAX_SQUARABLE_INT
                    self._limit(node, factor, limit, "product")
        elif is_int and op is not ast.Mult and not (is_small(left) or is_small(right)):
            if node not in self.compared:
                left, right = self.simple(left, "term"), self.simple(right, "term")
                total = combine(f"{left.text} {mark} {right.text}", INT, rank, left, right)
                return self._limit(node, self.temporary(total, "total"), LARGEST_INT, "sum")
        value, span, sign = None, None, self._sign(op, left, right)
        if op is not ast.Div and left.span and right.span:
            ends = [compute(first, second) for first in left.span for second in right.span]
            span = (min(ends), max(ends))
            if left.constant is not None and right.constant is not None:
                value, sign = ends[0], sign_of(ends[0])
        text, type_ = f"{left.at(rank)} {mark} {right.at(rank + 1)}", INT if is_int else FLOAT
        return combine(text, type_, rank, left, right, sign=sign, span=span, constant=value)

    def _limit(self, node: ast.AST, value: CExpression, limit: int, kind: str) -> CExpression:
        """Emit a test that the absolute value of an int is at most `limit`; return the int."""
        reason = f"a {kind} of ints that may be beyond 2^53"
        self.fail_if(f"{value.text} > {limit} || {value.text} < -{limit}", node, reason)
        return value

    def _sign(self, op: type[ast.operator], left: CExpression, right: CExpression) -> int:
        if not left.sign & right.sign & Sign.NONNEGATIVE:
            return Sign.NONNEGATIVE * (op is ast.Mult and left.text == right.text)
        # A product of positive floats may underflow to 0, but not if a factor is at least 1.
        if op is ast.Mult and any(factor.span and factor.span[0] >= 1 for factor in (left, right)):
            return left.sign & right.sign
        return left.sign | right.sign if op is ast.Add else Sign.NONNEGATIVE * (op is not ast.Sub)

    def divisor(self, node: ast.AST, value: CExpression) -> CExpression:
        """Emit a test of a divisor that may be 0; return the divisor."""
        if value.sign & Sign.NONZERO:
            return value
        value = self.simple(value, "divisor")
        self.fail_if(f"{value.text} == {ZEROS[value.type.kind]}", node, "a division whose divisor may be 0")
        self.facts[value.text] = value._replace(sign=value.sign | Sign.NONZERO)
        return value

    def lower_unaryop(self, node: Any) -> CExpression:
        if isinstance(node.op, ast.Not):
            value = self.truth(node.operand)
            if value.constant is not None:
                return constant(not value.constant)
            if value.rank == Rank.EQUALITY and value.text.endswith(" != 0"):
                return value._replace(text=value.text.removesuffix("!= 0") + "== 0")
            return value._replace(text=f"!{value.at(Rank.UNARY)}", rank=Rank.UNARY)
        value = self.number(node.operand)
        if isinstance(node.op, ast.Invert):
            return combine(f"~(int64_t){value.at(Rank.UNARY)}", INT, Rank.UNARY, value)
        self.require(isinstance(node.op, ast.USub), node, "+ without effect", "- or ~")
        number = None if value.constant is None else -value.constant
        span = value.span and (-value.span[1], -value.span[0])
        text, sign = f"-{value.at(Rank.ATOM)}", value.sign & Sign.NONZERO
        return value._replace(text=text, rank=Rank.UNARY, sign=sign, span=span, constant=number)

    def lower_compare(self, node: Any) -> CExpression:
        op, comparator = type(node.ops[0]), node.comparators[0]
        if op in (ast.Is, ast.IsNot):
            return self._identity(node, op is ast.Is, comparator)
        if op in (ast.In, ast.NotIn) and isinstance(comparator, (ast.Tuple, ast.List)):
            kind, joint = (ast.Eq, ast.Or) if op is ast.In else (ast.NotEq, ast.And)
            self.names["in"] = self.simple(self.number(node.left), "value")
            parts: Any = [ast.Compare(ast.Name("in"), [kind()], [item]) for item in comparator.elts]
            return self.expression(ast.BoolOp(joint(), parts))
        for operand in (node.left, *node.comparators):
            if all(isinstance(part, TERMS) for part in ast.walk(operand)):
                self.compared += ast.walk(operand)
        values, conditions = self.operands([node.left, *node.comparators]), []
        values[1:-1] = [self.simple(middle, "middle") for middle in values[1:-1]]
        for mark, left, right in zip(map(type, node.ops), values, values[1:], strict=False):
            kinds = {left.type.kind, right.type.kind}
            is_defined = mark in OPERATORS and (kinds == {"bool"} or kinds <= {"int", "float"})
            self.require(is_defined, node, f"{mark.__name__} of {left.type.kind}", "a comparison of numbers")
            if left.constant is not None and right.constant is not None:
                conditions.append(constant(OPERATORS[mark][1](left.constant, right.constant)))
                continue
            if len(kinds) > 1:
                left, right = as_float(left), as_float(right)
            rank = Rank.EQUALITY if mark in (ast.Eq, ast.NotEq) else Rank.RELATION
            text = f"{left.at(Rank.SUM)} {OPERATORS[mark][0]} {right.at(Rank.SUM)}"
            conditions.append(combine(text, BOOL, rank, left, right))
        return self._join_conditions(conditions, True)

    def _identity(self, node: Any, is_same: bool, comparator: Any) -> CExpression:
        """Lower `is` or `is not`: in `type(x) is float`, known at export, or in `parameter is None`."""
        if isinstance(node.left, ast.Call) and getattr(node.left.func, "id", "") == "type":
            kind = self.expression(node.left.args[0]).type.kind
            return constant((kind == getattr(comparator, "id", "")) == is_same)
        parameter = self.names.get(getattr(node.left, "id", ""))
        if parameter is None or parameter.length != "optional" or getattr(comparator, "value", 0) is not None:
            raise self.reject(node, "`is`", "`is None` of a parameter `float | None`")
        text = f"{parameter.text.lstrip('*')} {'==' if is_same else '!='} NULL"
        return CExpression(text, BOOL, Rank.EQUALITY)

    def _join_conditions(self, parts: list[CExpression], is_and: bool) -> CExpression:
        """Join conditions with C's `&&` or `||`; evaluate constant conditions."""
        decided = [i for i, part in enumerate(parts) if part.constant is not None and part.constant != is_and]
        if decided:
            has_effect = any(part.writes for part in parts[: decided[0]])
            parts = parts[0 if has_effect else decided[0] : decided[0] + 1]
        parts = [part for part in parts if part.constant is None or len(parts) == 1]
        if len(parts) < 2:
            return parts[0] if parts else constant(is_and)
        mark, rank = ("&&", Rank.AND) if is_and else ("||", Rank.OR)
        # Compilers warn about `&&` within `||` without parentheses.
        least = [Rank.BITS if part.rank == Rank.AND and not is_and else rank for part in parts]
        text = f" {mark} ".join(map(CExpression.at, parts, least))
        return combine(text, BOOL, rank, *parts)

    def lower_boolop(self, node: Any) -> CExpression:
        is_and, parts, facts = isinstance(node.op, ast.And), [], {}
        for operand in node.values:
            with self.captured() as lines:
                self.facts |= facts
                value = self.truth(operand)
            if lines and parts:
                flag = self.fresh("holds")
                self.emit(f"bool {flag} = {self._join_conditions(parts, is_and).text};")
                self.emit(f"if ({'' if is_and else '!'}{flag}) {{", *lines, f"{flag} = {value.text};", "}")
                parts = [CExpression(flag, BOOL)]
            else:
                self.emit(*lines)
                parts.append(value)
            facts |= self.facts_of(operand, is_and)
        return self._join_conditions(parts, is_and)

    def lower_ifexp(self, node: Any) -> CExpression:
        test, branches = self.truth(node.test), []
        if test.constant is not None:
            return self.expression(node.body if test.constant else node.orelse)
        for branch, truth in ((node.body, True), (node.orelse, False)):
            facts = self.facts_of(node.test, truth)
            with self.captured() as lines:
                self.facts |= facts
                branches.append((self.expression(branch), lines))
        (body, first), (orelse, second) = branches
        if {body.type.kind, orelse.type.kind} == {"int", "float"}:
            body, orelse = as_float(body), as_float(orelse)
        is_value = body.type.kind == orelse.type.kind and body.type.kind in ZEROS
        found = f"{body.type.kind} or {orelse.type.kind}"
        self.require(is_value, node, found, "two numbers of one type")
        sign, type_ = body.sign & orelse.sign, body.type.plain
        if not (first or second or body.fails or orelse.fails):
            text = f"{test.at(Rank.OR)} ? {body.at(Rank.OR)} : {orelse.at(Rank.CONDITIONAL)}"
            return combine(text, type_, Rank.CONDITIONAL, test, body, orelse, sign=sign)
        name = self.fresh("choice")
        self.emit(f"{self.program.c_type(type_)} {name};", f"if ({test.text}) {{")
        for value, lines, last in ((body, first, "} else {"), (orelse, second, "}")):
            self.emit(*lines, f"{name} = {value.text};")
            self.check(value)
            self.emit(last)
        return CExpression(name, type_, sign=sign)
