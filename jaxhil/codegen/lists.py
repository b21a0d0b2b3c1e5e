"""Lowering of lists and loops: arrays of fixed or run-time length, slices, indices, iterations."""

import ast
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from .lowering import ExpressionLowering
from .subset import FLOAT, INT, Sign, ValueType
from .values import CExpression, Rank, constant, sign_of


class LoopRange(NamedTuple):
    """Index range of a C loop, and the values of the Python loop's targets."""

    start: str  # C code of the first index
    stop: str  # C code of the index after the last
    values: Callable[[str], list[CExpression]]  # function from the index to the values of the targets
    count: int | None  # number of iterations, if known at export
    step: int = 1  # increment of the index, 1 or -1
    texts: tuple[Any, ...] = ()  # values of the target, if it is a text


class ListLowering(ExpressionLowering):
    """Lowering (translation) of Python lists and loops to C."""

    def lower_list(self, node: Any) -> CExpression:
        return self.array(node, None)

    lower_listcomp = lower_tuple = lower_list

    def is_display(self, node: Any) -> bool:
        is_copy = isinstance(node, ast.Call) and getattr(node.func, "id", "") == "list"
        is_product = isinstance(node, ast.BinOp) and isinstance(node.left, ast.List)
        return isinstance(node, (ast.List, ast.Tuple, ast.ListComp)) or is_product or is_copy

    def array(self, node: Any, target: CExpression | None, named: str = "") -> CExpression:
        """Lower a list into the array `target`, or into a new local array if `target` is None."""
        if target is not None and target.type.length is None:
            self._fill(target.text, node, target.type)
            return target
        name, reads_before, failures = named or self.fresh("list"), self.function.reads, self.failures
        self.function.reads = frozenset()
        with self.captured() as lines:
            type_ = self._fill(name, node, target and target.type)
        reads, self.function.reads = self.function.reads, self.function.reads | reads_before
        if target is not None and self.failures == failures and not target.reads & reads:
            # Write to the target directly: no element reads the old list, no failure leaves it incomplete.
            self.fit_length(node, target.type, type_)
            self.emit(*(re.sub(rf"\b{name}\b", target.text, line) for line in lines))
            self.function.taken.discard(name)
            return target
        self.emit(f"{self.program.declaration(type_, name)};", *lines)
        result = CExpression(name, type_, reads=frozenset({("local", name)}))
        if target is not None:
            self.copy(target, result, node)
        return result

    def fit_length(self, node: Any, target: ValueType, source: ValueType) -> None:
        is_same = source.length == target.length is not None
        found = f"a list of {source.length or 'any number of'} elements"
        self.require(is_same, node, found, f"{target.length} elements")

    def copy(self, target: CExpression, source: CExpression, node: Any) -> None:
        self.fit_length(node, target.type, source.type)
        with self._each(str(source.type.length)) as index:
            left, right = (CExpression(f"{value.text}[{index}]", value.type.of) for value in (target, source))
            if left.type.kind == "list":
                self.copy(left, right, node)
            else:
                self.emit(f"{left.text} = {right.stored(left.type)};")

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

    def _fill(self, target: str, node: Any, required: ValueType | None) -> ValueType:
        """Emit code that fills the array `target` with the elements of a list; return the list's type."""
        element = required and required.of
        if isinstance(node, (ast.List, ast.Tuple)):
            length = 0
            for item in node.elts:
                if isinstance(item, ast.Starred):
                    part = self.expression(item.value)
                    self.copy(CExpression(f"({target} + {length})", part.type), part, item)
                    element, length = part.type.of, length + (part.type.length or 0)
                else:
                    element, length = self._put(f"{target}[{length}]", item, element), length + 1
            return ValueType("list", element or FLOAT, length)
        if isinstance(node, ast.ListComp):
            return self._comprehension(target, node, element)
        if isinstance(node, ast.Call) and self.is_display(node):
            return self._fill(target, node.args[0], required)
        if isinstance(node, ast.BinOp) and isinstance(node.left, ast.List):
            count = self.number(node.right)
            has_length = count.constant is not None or (required and required.capacity)
            self.require(has_length, node, "a list of computed length", "a constant length")
            stop = f"{target}_length" if count.constant is None else count.text
            with self._each(stop) as index:
                element = self._put(f"{target}[{index}]", node.left.elts[0], element)
            return ValueType("list", element, count.constant)
        value = self.expression(node)
        self.require(value.type.kind == "list", node, f"a {value.type.kind}", "a list")
        self.copy(CExpression(target, value.type), value, node)
        return value.type

    def _put(self, target: str, node: Any, required: ValueType | None) -> ValueType:
        if self.is_display(node) or (required is not None and required.kind == "list"):
            return self._fill(target, node, required)
        value = self.expression(node)
        element = required or value.type.plain
        self.emit(f"{target} = {value.stored(element)};")
        self.check(value)
        return element

    def _comprehension(self, target: str, node: Any, element: ValueType | None) -> ValueType:
        generator, loop, hidden = node.generators[0], self.loop(node.generators[0].iter), dict(self.names)
        is_simple = len(node.generators) == 1 and not generator.ifs and loop.count is not None
        self.require(is_simple, node, "this comprehension", "a single `for` of known length without `if`")
        for index, text in enumerate(loop.texts):
            self.names[generator.target.id] = constant(text)
            element = self._put(f"{target}[{index}]", node.elt, element)
        if not loop.texts:
            with self._each(str(loop.count)) as index:
                values = loop.values(index if loop.start == "0" else f"{index} + {loop.start}")
                self.names |= dict(zip(self.targets(generator.target, len(values)), values, strict=True))
                element = self._put(f"{target}[{index}]", node.elt, element)
        self.names = hidden
        return ValueType("list", element or FLOAT, loop.count)

    def targets(self, node: Any, count: int) -> list[str]:
        names = [getattr(target, "id", "") for target in getattr(node, "elts", [node])]
        self.require(all(names) and len(names) == count, node, "this target", f"{count} names")
        return names

    def loop(self, node: Any) -> LoopRange:
        """Return the C index range of a `for` loop over `node`, and the values of the loop's targets."""
        called = getattr(node.func, "id", "") if isinstance(node, ast.Call) else ""
        if called == "range":
            return self._range(node)
        if called in ("zip", "enumerate"):
            loops = [self.loop(argument) for argument in node.args]
            counts = {loop.count for loop in loops}
            strict = any(k.arg == "strict" and getattr(k.value, "value", 0) for k in node.keywords)
            is_fixed = None not in counts and not (strict and len(counts) > 1)
            found = f"{called} of lists of {counts} elements"
            self.require(is_fixed, node, found, "lists of the same fixed length")
            count = min(loop.count or 0 for loop in loops)
            parts = [loop.values for loop in loops]
            if called == "enumerate":
                more = {"sign": Sign.NONNEGATIVE, "span": (0, count - 1)}
                parts.insert(0, lambda index: [CExpression(index, INT, **more)])
            return LoopRange("0", str(count), lambda i: [value for part in parts for value in part(i)], count)
        is_texts = isinstance(node, ast.Tuple) and all(isinstance(item, ast.Constant) for item in node.elts)
        value = constant(ast.literal_eval(node)) if is_texts else self.expression(node)
        if isinstance(value.constant, tuple) and any(isinstance(item, str) for item in value.constant):
            return LoopRange("0", "", lambda index: [], len(value.constant), texts=value.constant)
        expected = "a list, range, zip or enumerate"
        self.require(value.type.kind == "list", node, f"a loop over a {value.type.kind}", expected)
        count = value.type.length
        return LoopRange("0", str(count or value.length), lambda i: [self.at(value, i)], count)

    def _range(self, node: Any) -> LoopRange:
        bounds = self.operands(node.args, self.number)
        step = bounds[2].constant if len(bounds) > 2 else 1
        is_range = step in (1, -1) and all(bound.type.kind == "int" for bound in bounds)
        self.require(is_range, node, "this range", "a range of ints with the step 1 or -1")
        start, stop = [constant(0), *bounds][-2:] if len(bounds) < 3 else bounds[:2]
        span, count, sign = None, None, start.sign & Sign.NONNEGATIVE * (step == 1)
        if start.span and stop.span:
            span = (start.span[0], stop.span[1] - 1) if step == 1 else (stop.span[0] + 1, start.span[1])
            sign |= Sign.NONNEGATIVE * (span[0] >= 0)
        if start.constant is not None and stop.constant is not None:
            count = max(0, (stop.constant - start.constant) * step)

        def values(index: str) -> list[CExpression]:
            rank = Rank.SUM if " " in index else Rank.ATOM
            return [CExpression(index, INT, rank, sign=sign, span=span, below=stop.text)]

        return LoopRange(start.text, stop.text, values, count, step)

    def at(self, value: CExpression, index: str) -> CExpression:
        """Return the C expression for a list element whose index is certainly in range."""
        of, numbers = value.type.of, value.constant
        span = (min(numbers), max(numbers)) if isinstance(numbers, tuple) and of.kind == "int" else None
        sign = Sign.NONNEGATIVE if span and span[0] >= 0 else of.sign
        return CExpression(f"{value.text}[{index}]", of, reads=value.reads, sign=sign, span=span)

    def lower_subscript(self, node: Any) -> CExpression:
        value = self.expression(node.value)
        if value.type.kind == "struct":
            return self._entry(node, value)
        if value.type.kind == "list" and isinstance(node.slice, ast.Slice):
            return self._slice(node, value, node.slice)
        index = self.number(node.slice)
        if isinstance(value.constant, tuple) and index.constant is not None:
            return constant(value.constant[index.constant])
        is_list = value.type.kind == "list" and index.type.kind == "int"
        self.require(is_list, node, f"[...] of a {value.type.kind}", "an int index into a list")
        return self.at(value, self._index(node, value, index))

    def _index(self, node: Any, value: CExpression, index: CExpression) -> str:
        """Return the C code of an index; emit a test if the index may be outside the list."""
        size, is_above = value.type.length, index.sign & Sign.NONNEGATIVE
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
                self.facts[index.text] = index._replace(span=(0, size - 1))
        return index.text if is_above else f"{index.text} < 0 ? {index.text} + {length} : {index.text}"

    def _entry(self, node: Any, value: CExpression) -> CExpression:
        texts = {name: text.constant for name, text in self.names.items() if text.type.kind == "non-number"}
        try:
            code = compile(ast.Expression(node.slice), self.function.file, "eval")
            key = eval(code, {"__builtins__": {}}, texts)
            lowest = self.program.lowest[value.type.of][key]
        except Exception:
            raise self.reject(node, ast.unparse(node), "the name of a gain or limit") from None
        return CExpression(f"{value.text}->{key}", FLOAT, sign=sign_of(lowest) if lowest >= 0.0 else 0)

    def _slice(self, node: Any, value: CExpression, part: ast.Slice) -> CExpression:
        ends = [part.lower, part.upper]
        bounds = [None if end is None else self.number(end).constant for end in ends]
        is_known = part.step is None and bounds.count(None) == ends.count(None)
        expected = "constant bounds and a list of fixed length"
        self.require(is_known and value.type.length is not None, node, "this slice", expected)
        start, stop, _ = slice(*bounds).indices(value.type.length or 0)
        text = value.text if start == 0 else f"({value.text} + {start})"
        return value._replace(text=text, type=value.type._replace(length=stop - start), constant=None)
