"""Lowering of expressions: arithmetic, comparisons, conditions, names."""

import ast
import operator
from typing import Any

from .lowering import Lowering, NumberFact
from .subset import (
    AND,
    ATOM,
    BITS,
    BOOL,
    CONDITIONAL,
    EQUALITY,
    FLOAT,
    INT,
    OR,
    PRODUCT,
    RELATION,
    SUM,
    UNARY,
    CExpression,
    as_float,
    implies_sign,
    sign_of,
)
from .subset import common_sign as common

ARITHMETIC = {
    ast.Add: ("+", SUM, operator.add),
    ast.Sub: ("-", SUM, operator.sub),
    ast.Mult: ("*", PRODUCT, operator.mul),
    ast.Div: ("/", PRODUCT, operator.truediv),
}
BIT_OPERATORS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}
COMPARISONS = {
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
}
HELPER_OPERATORS = {ast.FloorDiv: "floor_division", ast.Mod: "modulo", ast.Pow: "power"}
LARGEST_INT = 2**53  # largest int of the subset; a double represents all smaller ints exactly
MAX_SQUARABLE_INT = 94906265  # largest int whose square is at most LARGEST_INT
# Sums of these nodes need no test if they are only compared: terms up to LARGEST_INT cannot overflow.
TERMS = (ast.BinOp, ast.Add, ast.Sub, ast.Name, ast.Attribute, ast.Constant, ast.expr_context)
SMALL = 2**10  # with this increment every millisecond, a counter needs 278 years to reach LARGEST_INT


def is_small(value: CExpression) -> bool:
    """Return whether an int is so small that a counter with this increment cannot reach LARGEST_INT."""
    has_bound = value.type.is_index or bool(value.below) or value.type.c_int != "int64_t"
    return has_bound or (value.span is not None and max(map(abs, value.span)) <= SMALL)


class ExpressionLowering(Lowering):
    """Lowering of expressions; emits the C statements that must precede an expression."""

    def lower_constant(self, node: ast.Constant) -> CExpression:
        return self.program.constant(node.value) or self.unknown(node, repr(node.value))

    def unknown(self, node: ast.AST, found: str) -> CExpression:
        """Raise SubsetError for a name or constant that has no equivalent in C."""
        expected = "a number, a bool, a list of numbers, or a class or function with source code"
        raise self.refuse(node, found, expected)

    def lower_name(self, node: ast.Name) -> CExpression:
        if node.id in self.names:
            self.function.reads |= self.names[node.id].reads
            return self.names[node.id]
        if node.id in self.function.occurrences or node.id not in self.function.namespace:
            raise self.refuse(node, f"the name {node.id}", "a name that is assigned earlier")
        return self.program.named_constant(node.id, self.function.namespace) or self.unknown(node, node.id)

    def lower_binop(self, node: ast.BinOp) -> CExpression:
        if isinstance(node.left, (ast.List, ast.Tuple)):
            return self.expression(ast.copy_location(ast.Call(ast.Name("list"), [node], []), node))
        left, right = self.operands([node.left, node.right], self.number)
        kind, reads, op = "int", left.reads | right.reads, type(node.op)
        if op in BIT_OPERATORS and left.type.kind == right.type.kind == "int":
            mark = f" {BIT_OPERATORS[op]} "
            first = left.text if left.rank == BITS and left.text.count(mark) else left.at(UNARY)
            writes = left.writes | right.writes
            return CExpression(f"{first}{mark}{right.at(UNARY)}", INT, BITS, reads, writes)
        if "float" in (left.type.kind, right.type.kind) or op in (ast.Div, ast.Pow):
            left, right, kind = as_float(left), as_float(right), "float"
        if op in HELPER_OPERATORS:
            return self._call_helper(node, left, right, kind)
        if op not in ARITHMETIC:
            raise self.refuse(node, op.__name__, "+, -, *, /, //, % or ** of numbers, &, | or ^ of ints")
        mark, rank, compute = ARITHMETIC[op]
        if op is ast.Div:
            right = self._divisor(node, right)
        if op is ast.Mult and kind == "int" and not (left.span and right.span):
            left, right = self.simple(left, "factor"), self.simple(right, "factor")
            for factor, other in ((left, right), (right, left)):
                if factor.constant is None:
                    limit = LARGEST_INT // max(abs(other.constant), 1) if other.span else MAX_SQUARABLE_INT
                    self._limit(node, factor, limit, "a product of ints that may be beyond 2^53")
        is_free = node in self.compared or is_small(left) or is_small(right)
        if op in (ast.Add, ast.Sub) and kind == "int" and not is_free:
            left, right = self.simple(left, "term"), self.simple(right, "term")
            total = self.temporary(CExpression(f"{left.text} {mark} {right.text}", INT, SUM, reads), "total")
            self._limit(node, total, LARGEST_INT, "a sum of ints that may be beyond 2^53")
            return total
        constants, span, constant = (left.constant, right.constant), None, None
        if op is not ast.Div and all(isinstance(constant, (int, float)) for constant in constants):
            constant = compute(*constants)
            span = (constant, constant)
        elif op is not ast.Div and left.span and right.span:
            ends = [compute(first, second) for first in left.span for second in right.span]
            span = (min(ends), max(ends))
        sign = sign_of(constant) or self._sign(node.op, left, right)
        text = f"{left.at(rank)} {mark} {right.at(rank + 1)}"
        type_ = FLOAT if kind == "float" else INT
        return CExpression(
            text, type_, rank, reads, left.writes | right.writes, False, sign, span, "", constant
        )

    def _limit(self, node: ast.AST, value: CExpression, limit: int, reason: str) -> None:
        """Emit a test that the absolute value of an int is at most `limit`."""
        self.fail_if(f"{value.text} > {limit} || {value.text} < -{limit}", node, reason)

    def _sign(self, op: ast.operator, left: CExpression, right: CExpression) -> str:
        if not {left.sign, right.sign} <= {"> 0", ">= 0"}:
            return ">= 0" if isinstance(op, ast.Mult) and left.text == right.text else ""
        is_one_positive = "> 0" in (left.sign, right.sign)
        # A product of positive floats may underflow to 0, but not if a factor is at least 1.
        is_large = any(factor.constant is not None and factor.constant >= 1 for factor in (left, right))
        if isinstance(op, ast.Mult) and left.sign == right.sign == "> 0" and is_large:
            return "> 0"
        if isinstance(op, ast.Add):
            return "> 0" if is_one_positive else ">= 0"
        return ">= 0" if isinstance(op, (ast.Mult, ast.Div)) else ""

    def _divisor(self, node: ast.AST, value: CExpression) -> CExpression:
        """Emit a test of a divisor that may be 0; return the divisor."""
        if value.sign and implies_sign(value.sign, "not 0"):
            return value
        value = self.simple(value, "divisor")
        zero = "0.0" if value.type.kind == "float" else "0"
        self.fail_if(f"{value.text} == {zero}", node, "a division whose divisor may be 0")
        self.facts[value.text] = NumberFact("> 0" if value.sign else "not 0", value.reads)
        return value

    def _call_helper(self, node: ast.BinOp, left: CExpression, right: CExpression, kind: str) -> CExpression:
        """Lower a floor division, a remainder or a power to a call of a helper function."""
        name = HELPER_OPERATORS[type(node.op)] + ("_int" if kind == "int" else "")
        if name != "power":
            right = self._divisor(node, right)
            sign = right.sign if name.startswith("modulo") and right.sign in ("> 0", ">= 0") else ""
            text = self.program.helper(name, left.text, right.text)
            type_, reads = left.type._replace(sign=""), left.reads | right.reads
            return CExpression(text, type_, reads=reads, sign=sign and ">= 0")
        left, right = self.simple(left, "base"), self.simple(right, "exponent")
        value = self.temporary(CExpression(self.program.helper(name, left.text, right.text), FLOAT), "power")
        base, exponent = left.text, right.text
        tests = [f"(isinf({value.text}) && isfinite({base}) && isfinite({exponent}))"]
        if not (isinstance(right.constant, float) and right.constant.is_integer() and right.constant > 0.0):
            is_whole = f"isfinite({exponent}) && floor({exponent}) == {exponent}"
            tests += [f"({base} == 0.0 && {exponent} < 0.0)", f"({base} < 0.0 && !({is_whole}))"]
        self.fail_if(" || ".join(tests), node, "a power that may raise")
        return value

    def lower_unaryop(self, node: ast.UnaryOp) -> CExpression:
        if isinstance(node.op, ast.Not):
            value = self.truth(node.operand)
            if value.constant is not None:
                return self.program.literal(not value.constant)
            if value.rank == EQUALITY and value.text.endswith(" != 0"):
                return value._replace(text=value.text.removesuffix("!= 0") + "== 0")
            return value._replace(text=f"!{value.at(UNARY)}", rank=UNARY)
        value = self.number(node.operand)
        if isinstance(node.op, ast.UAdd):
            return value
        if isinstance(node.op, ast.Invert):
            wide = f"~(int64_t){value.text}" if value.constant is not None else f"~{value.at(UNARY)}"
            return CExpression(wide, INT, UNARY, value.reads, value.writes)
        constant = None if value.constant is None else -value.constant
        span = value.span and (-value.span[1], -value.span[0])
        sign = "not 0" if value.sign and implies_sign(value.sign, "not 0") else ""
        text = f"-{value.at(UNARY + 1)}"
        return value._replace(text=text, rank=UNARY, sign=sign, span=span, constant=constant)

    def lower_compare(self, node: ast.Compare) -> CExpression:
        op, comparator = type(node.ops[0]), node.comparators[0]
        if len(node.ops) == 1 and op in (ast.Is, ast.IsNot):
            return self._identity(node, op is ast.Is, comparator)
        if len(node.ops) == 1 and op in (ast.In, ast.NotIn) and isinstance(comparator, (ast.Tuple, ast.List)):
            value = self.simple(self.number(node.left), "value")
            kind, joint = (ast.Eq, ast.Or) if op is ast.In else (ast.NotEq, ast.And)
            self.names["in"] = value
            name = ast.Name("in")
            parts: list[ast.expr] = [ast.Compare(name, [kind()], [item]) for item in comparator.elts]
            return self.expression(ast.fix_missing_locations(ast.BoolOp(joint(), parts)))
        for operand in (node.left, *node.comparators):
            if all(isinstance(part, TERMS) for part in ast.walk(operand)):
                self.compared += [part for part in ast.walk(operand) if isinstance(part, ast.BinOp)]
        values = self.operands([node.left, *node.comparators])
        if len(values) > 2:
            values[1:-1] = [self.simple(middle, "middle") for middle in values[1:-1]]
        parts_: list[CExpression] = []
        for mark, left, right in zip(node.ops, values, values[1:], strict=False):
            kinds = {left.type.kind, right.type.kind}
            if type(mark) not in COMPARISONS or not (kinds == {"bool"} or kinds <= {"int", "float"}):
                found = f"{type(mark).__name__} of {left.type.kind}"
                raise self.refuse(node, found, "a comparison of numbers")
            text, compare = COMPARISONS[type(mark)]
            if left.constant is not None and right.constant is not None:
                parts_.append(self.program.literal(compare(left.constant, right.constant)))
                continue
            if len(kinds) > 1:
                left, right = as_float(left), as_float(right)
            rank = EQUALITY if text in ("==", "!=") else RELATION
            writes = left.writes | right.writes
            text = f"{left.at(SUM)} {text} {right.at(SUM)}"
            parts_.append(CExpression(text, BOOL, rank, left.reads | right.reads, writes))
        return self._join_conditions(parts_, True)

    def _identity(self, node: ast.Compare, is_same: bool, comparator: ast.expr) -> CExpression:
        value = node.left
        if isinstance(value, ast.Call) and getattr(value.func, "id", "") == "type":
            # In Python, `type(x) is float` avoids a conversion. In C the type is known: the test is a
            # constant.
            kind = self.expression(value.args[0]).type.kind
            return self.program.literal((kind == getattr(comparator, "id", "")) == is_same)
        parameter = self.names.get(getattr(value, "id", ""))
        if parameter is None or parameter.length != "optional" or getattr(comparator, "value", 0) is not None:
            raise self.refuse(node, "`is`", "`is None` of a parameter `float | None`")
        return CExpression(f"{parameter.text.lstrip('*')} {'==' if is_same else '!='} NULL", BOOL, EQUALITY)

    def _join_conditions(self, parts: list[CExpression], is_and: bool) -> CExpression:
        """Join conditions with C's `&&` or `||`; evaluate constant conditions."""
        decided = [i for i, part in enumerate(parts) if part.constant is not None and part.constant != is_and]
        if decided:
            is_kept = any(part.writes for part in parts[: decided[0]])
            parts = parts[0 if is_kept else decided[0] : decided[0] + 1]
        parts = [part for part in parts if part.constant is None or len(parts) == 1]
        if len(parts) < 2:
            return parts[0] if parts else self.program.literal(is_and)
        mark, rank = ("&&", AND) if is_and else ("||", OR)
        text = f" {mark} ".join(part.at(rank if part.rank != AND else AND + 1 - is_and) for part in parts)
        reads: Any = frozenset().union(*(part.reads for part in parts))
        return CExpression(text, BOOL, rank, reads, frozenset().union(*(part.writes for part in parts)))

    def lower_boolop(self, node: ast.BoolOp) -> CExpression:
        is_and, parts, facts = isinstance(node.op, ast.And), [], {}
        for operand in node.values:
            with self.captured() as lines:
                self.facts |= facts
                value = self.truth(operand)
            if lines and parts:
                flag = self.fresh("holds")
                self.emit(f"bool {flag} = {self._join_conditions(parts, is_and).text};")
                self.emit(f"if ({flag if is_and else f'!{flag}'}) {{", *lines, f"{flag} = {value.text};", "}")
                parts = [CExpression(flag, BOOL)]
            else:
                self.emit(*lines)
                parts.append(value)
            facts |= self.facts_of(operand, is_and)
        return self._join_conditions(parts, is_and)

    def lower_ifexp(self, node: ast.IfExp) -> CExpression:
        test = self.truth(node.test)
        if test.constant is not None:
            return self.expression(node.body if test.constant else node.orelse)
        branches = []
        for branch, truth in ((node.body, True), (node.orelse, False)):
            facts = self.facts_of(node.test, truth)
            with self.captured() as lines:
                self.facts |= facts
                branches.append((self.expression(branch), lines))
        (body, first), (orelse, second) = branches
        if body.type.kind == "text":
            return body
        if {body.type.kind, orelse.type.kind} == {"int", "float"}:
            body, orelse = as_float(body), as_float(orelse)
        if body.type.kind != orelse.type.kind or body.type.kind not in ("int", "float", "bool"):
            raise self.refuse(node, f"{body.type.kind} or {orelse.type.kind}", "two numbers of one type")
        sign = common([body.sign, orelse.sign])
        type_ = body.type._replace(sign="", c_int="int64_t", is_index=False)
        if not (first or second or body.fails or orelse.fails):
            reads = test.reads | body.reads | orelse.reads
            text = f"{test.at(OR)} ? {body.at(CONDITIONAL + 1)} : {orelse.at(CONDITIONAL)}"
            return CExpression(
                text, type_, CONDITIONAL, reads, test.writes | body.writes | orelse.writes, sign=sign
            )
        name = self.fresh("choice")
        self.emit(f"{self.program.c_type(type_)} {name};", f"if ({test.text}) {{")
        for value, lines, last in ((body, first, "} else {"), (orelse, second, "}")):
            self.emit(*lines, f"{name} = {value.text};")
            self.check(value)
            self.emit(last)
        return CExpression(name, type_, ATOM, sign=sign)
