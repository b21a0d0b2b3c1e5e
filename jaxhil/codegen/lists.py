"""Lowering of lists and loops: arrays of fixed or run-time length, slices, indices, iterations."""

import ast
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from .expressions import ExpressionLowering
from .lowering import NumberFact
from .subset import ATOM, FLOAT, INT, SUM, TEXT, CExpression, ValueType, implies_sign


class LoopRange(NamedTuple):
    """Index range of a C loop, and the values of the Python loop's targets."""

    start: str  # C code of the first index
    stop: str  # C code of the index after the last
    values: Callable[[str], list[CExpression]]  # function from the index to the values of the targets
    count: int | None = None  # number of iterations, if known at export
    step: int = 1  # increment of the index, 1 or -1
    constants: tuple[Any, ...] = ()  # value of the target in each iteration, if known at export


def has_text(values: tuple[Any, ...]) -> bool:
    """Return whether any of the values is not a number."""
    return not all(isinstance(value, (int, float)) for value in values)


class ListLowering(ExpressionLowering):
    """Lowering of lists and loops."""

    def lower_list(self, node: ast.expr) -> CExpression:
        return self.array(node, None)

    lower_listcomp = lower_list
    lower_tuple = lower_list

    def is_display(self, node: ast.expr) -> bool:
        """Return whether an expression creates a new list."""
        called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
        is_product = isinstance(node, ast.BinOp) and isinstance(node.left, ast.List)
        return isinstance(node, (ast.List, ast.Tuple, ast.ListComp)) or is_product or called == "list"

    def array(self, node: ast.expr, target: CExpression | None, named: str = "") -> CExpression:
        """Lower a list into the array `target`, or into a new local array if `target` is None."""
        if target is not None and target.type.length is None:
            self._fill(target.text, node, target.type)
            return target
        name, reads_before, failures = named or self.fresh("list"), self.function.reads, self.failures
        self.function.reads = frozenset()
        with self.captured() as lines:
            type_ = self._fill(name, node, target and target.type)
        reads, self.function.reads = self.function.reads, self.function.reads | reads_before
        if target is not None and target.type.length != type_.length:
            raise self.refuse(node, f"a list of {type_.length} elements", f"{target.type.length} elements")
        if target is not None and self.failures == failures and not target.reads & reads:
            # Write to the target directly: no element reads the old list, and no failure leaves it
            # incomplete.
            self.emit(*(re.sub(rf"\b{name}\b", target.text, line) for line in lines))
            self.function.taken.discard(name)
            return target
        self.emit(f"{self.program.declaration(type_, name)};", *lines)
        result = CExpression(name, type_, reads=frozenset({("local", name)}))
        if target is not None:
            self.copy(target, result, node)
        return result

    def copy(self, target: CExpression, source: CExpression, node: ast.AST) -> None:
        """Emit code that copies the elements of `source` to `target`."""
        length = source.type.length
        if length is None or target.type.length != length:
            found = f"a list of {length or 'any number of'} elements"
            raise self.refuse(node, found, f"{target.type.length} elements")
        with self._each(str(length)) as index:
            left, right = (CExpression(f"{value.text}[{index}]", value.type.of) for value in (target, source))
            if left.type.kind == "list":
                self.copy(left, right, node)
            else:
                self.emit(f"{left.text} = {self.program.stored(left.type, right)};")

    @contextmanager
    def _each(self, stop: str) -> Iterator[str]:
        """Context manager: emit a loop around the lines that the `with` body emits; yield its index."""
        index = self.fresh("i")
        self.emit(f"for (int64_t {index} = 0; {index} < {stop}; {index}++) {{")
        with self.captured() as lines:
            self.facts = {}
            yield index
        self.emit(*lines, "}")
        self.function.taken.discard(index)

    def _fill(self, target: str, node: ast.expr, required: ValueType | None) -> ValueType:
        """Emit code that fills the array `target` with the elements of a list; return the list's type."""
        if isinstance(node, (ast.List, ast.Tuple)):
            element, length = required and required.of, 0
            for item in node.elts:
                if isinstance(item, ast.Starred):
                    part = self.expression(item.value)
                    self.copy(CExpression(f"({target} + {length})", part.type), part, item)
                    element, length = part.type.of, length + (part.type.length or 0)
                else:
                    element, length = self._put(f"{target}[{length}]", item, element), length + 1
            return ValueType("list", element or FLOAT, length)
        if isinstance(node, ast.ListComp):
            return self._comprehension(target, node, required)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "list" and len(node.args) == 1:
            return self._fill(target, node.args[0], required)
        if isinstance(node, ast.BinOp) and isinstance(node.left, ast.List) and len(node.left.elts) == 1:
            count = self.number(node.right)
            stop = count.text if count.constant is not None else self.program.length_of(self, target, node)
            with self._each(stop) as index:
                element = self._put(f"{target}[{index}]", node.left.elts[0], required and required.of)
            return ValueType("list", element, count.constant)
        value = self.expression(node)
        if value.type.kind != "list":
            raise self.refuse(node, f"a {value.type.kind}", "a list")
        self.copy(CExpression(target, value.type), value, node)
        return value.type

    def _put(self, target: str, node: ast.expr, required: ValueType | None) -> ValueType:
        """Emit code that assigns one element of an array; return the element's type."""
        if self.is_display(node) or (required is not None and required.kind == "list"):
            return self._fill(target, node, required)
        value = self.expression(node)
        element = required or value.type._replace(sign="", is_index=False, c_int="int64_t")
        self.emit(f"{target} = {self.program.stored(element, value)};")
        self.check(value)
        return element

    def _comprehension(self, target: str, node: ast.ListComp, required: ValueType | None) -> ValueType:
        generator, loop = node.generators[0], self.loop(node.generators[0].iter)
        if len(node.generators) > 1 or generator.ifs or loop.count is None:
            raise self.refuse(node, "this comprehension", "a single `for` of known length without `if`")
        element, hidden = required and required.of, dict(self.names)
        if has_text(loop.constants):
            for index, value in enumerate(loop.constants):
                self.names[getattr(generator.target, "id", "")] = self.program.literal(value)
                element = self._put(f"{target}[{index}]", node.elt, element)
        else:
            with self._each(str(loop.count)) as index:
                values = loop.values(index if loop.start == "0" else f"{index} + {loop.start}")
                self.names |= dict(zip(self.targets(generator.target, len(values)), values, strict=True))
                element = self._put(f"{target}[{index}]", node.elt, element)
        self.names = hidden
        return ValueType("list", element or FLOAT, loop.count)

    def targets(self, node: ast.expr, count: int) -> list[str]:
        """Return the names of a loop's targets. Raise SubsetError unless there are `count` names."""
        targets = node.elts if isinstance(node, ast.Tuple) else [node]
        if len(targets) != count or not all(isinstance(target, ast.Name) for target in targets):
            raise self.refuse(node, "this target", f"{count} names")
        return [target.id for target in targets if isinstance(target, ast.Name)]

    def loop(self, node: ast.expr) -> LoopRange:
        """Return the index range of a `for` loop over the expression `node`, and its targets' values."""
        called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
        if called == "range" and isinstance(node, ast.Call):
            return self._range(node)
        if called in ("zip", "enumerate") and isinstance(node, ast.Call):
            loops = [self.loop(argument) for argument in node.args]
            counts = {loop.count for loop in loops}
            strict = any(k.arg == "strict" and getattr(k.value, "value", 0) for k in node.keywords)
            if None in counts or (strict and len(counts) > 1):
                found = f"{called} of lists of {counts} elements"
                raise self.refuse(node, found, "lists of the same fixed length")
            count = min(number for number in counts if number is not None)
            parts = [loop.values for loop in loops]
            if called == "enumerate":
                parts.insert(0, lambda index: [CExpression(index, INT, sign=">= 0", span=(0, count - 1))])
            return LoopRange("0", str(count), lambda i: [value for part in parts for value in part(i)], count)
        if isinstance(node, ast.Tuple) and all(isinstance(item, ast.Constant) for item in node.elts):
            value = CExpression("", TEXT, constant=ast.literal_eval(node))
        else:
            value = self.expression(node)
        constants = value.constant if isinstance(value.constant, tuple) else ()
        if has_text(constants):
            return LoopRange("0", "", lambda index: [], len(constants), constants=constants)
        if value.type.kind != "list":
            raise self.refuse(node, f"a loop over a {value.type.kind}", "a list, range, zip or enumerate")
        count = value.type.length
        stop = str(count or value.length)
        return LoopRange("0", stop, lambda i: [self.at(value, i)], count, constants=constants)

    def _range(self, node: ast.Call) -> LoopRange:
        bounds = self.operands(node.args, self.number)
        start = bounds[0] if len(bounds) > 1 else self.program.literal(0)
        stop, step = bounds[min(1, len(bounds) - 1)], bounds[2].constant if len(bounds) > 2 else 1
        if step not in (1, -1) or any(bound.type.kind != "int" for bound in bounds):
            raise self.refuse(node, "this range", "a range of ints with the step 1 or -1")
        span, count = None, None
        if start.span and stop.span:
            span = (start.span[0], stop.span[1] - 1) if step == 1 else (stop.span[0] + 1, start.span[1])
        if start.constant is not None and stop.constant is not None:
            count = max(0, (stop.constant - start.constant) * step)
        is_up = step == 1 and start.sign in ("> 0", ">= 0")
        sign = ">= 0" if is_up or (span and span[0] >= 0) else ""

        def values(index: str) -> list[CExpression]:
            return [
                CExpression(index, INT, SUM if " " in index else ATOM, sign=sign, span=span, below=stop.text)
            ]

        return LoopRange(start.text, stop.text, values, count, step)

    def at(self, value: CExpression, index: str) -> CExpression:
        """Return the C expression for the element of a list at an index that needs no test."""
        of, constant = value.type.of, value.constant
        span = (min(constant), max(constant)) if isinstance(constant, tuple) and of.kind == "int" else None
        sign = ">= 0" if span and span[0] >= 0 else of.sign
        return CExpression(f"{value.text}[{index}]", of, reads=value.reads, sign=sign, span=span)

    def lower_subscript(self, node: ast.Subscript) -> CExpression:
        value = self.expression(node.value)
        if value.type.kind == "struct":
            return self._field(node, value)
        if value.type.kind == "list" and isinstance(node.slice, ast.Slice):
            return self._slice(node, value, node.slice)
        index = self.number(node.slice)
        if isinstance(value.constant, tuple) and index.constant is not None:
            return self.program.literal(value.constant[index.constant])
        if value.type.kind != "list" or index.type.kind != "int":
            raise self.refuse(node, f"[...] of a {value.type.kind}", "an int index into a list")
        return self.at(value, self._index(node, value, index))

    def _index(self, node: ast.AST, value: CExpression, index: CExpression) -> str:
        """Return the C code of an index; emit a test if the index may be outside the list."""
        size, is_above = value.type.length, implies_sign(index.sign, ">= 0") and index.sign != ""
        length = str(size or value.length)
        if index.constant is not None and size and -size <= index.constant < size:
            return str(index.constant % size) if index.constant < 0 else index.text
        is_inside = index.span and size and index.span[0] >= 0 and index.span[1] < size
        if is_inside or (is_above and (index.below == length or index.type.is_index)):
            return index.text
        trusted, index = index.type.is_index, self.simple(index, "index")
        if not trusted:
            low = "" if is_above else f"{index.text} < -{length} || "
            self.fail_if(f"{low}{index.text} >= {length}", node, "an index that may be outside its list")
            if is_above and size:
                self.facts[index.text] = NumberFact(index.sign, index.reads, (0, size - 1))
        return index.text if is_above else f"{index.text} < 0 ? {index.text} + {length} : {index.text}"

    def _field(self, node: ast.Subscript, value: CExpression) -> CExpression:
        texts = {name: value.constant for name, value in self.names.items() if value.type.kind == "text"}
        try:
            code = compile(ast.Expression(node.slice), self.function.file, "eval")
            key = eval(code, {"__builtins__": {}}, texts)
            sign = self.program.struct_signs[value.type.of][key]
        except Exception:
            raise self.refuse(node, f"{ast.unparse(node)}", "the name of a gain or limit") from None
        return CExpression(f"{value.text}->{key}", FLOAT, sign=sign)

    def _slice(self, node: ast.Subscript, value: CExpression, part: ast.Slice) -> CExpression:
        length, ends = value.type.length, (part.lower, part.upper)
        bounds = [None if end is None else self.number(end).constant for end in ends]
        is_known = all(end is None or bound is not None for end, bound in zip(ends, bounds, strict=True))
        if length is None or part.step is not None or not is_known:
            raise self.refuse(node, "this slice", "constant bounds and a list of fixed length")
        start, stop, _ = slice(*bounds).indices(length)
        text = value.text if start == 0 else f"({value.text} + {start})"
        return value._replace(text=text, type=value.type._replace(length=stop - start), constant=None)
