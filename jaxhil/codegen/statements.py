"""Lowering of statements: assignments, branches, loops and exceptions."""

import ast
import re
from typing import TYPE_CHECKING

from .calls import CallLowering
from .lists import has_text
from .lowering import NumberFact
from .subset import ATOM, FLOAT, INT, TEXT, UNARY, CExpression, Locations, ValueType

if TYPE_CHECKING:
    from .program import CFunction, CProgram


class BodyLowering(CallLowering):
    """Lowering of the statements of one function."""

    def __init__(self, program: "CProgram", function: "CFunction") -> None:
        super().__init__(program, function)
        self.span = (0, 0)  # first and last line of the current block
        self.hoisted: list[str] = []  # C declarations at the beginning of the function
        # local names of lists and objects: name, value, last line of use
        self.aliases: list[tuple[str, CExpression, int]] = []
        for name, type_ in function.parameters.items():
            text, is_list = program.local(name), type_.kind == "list"
            reads: Locations = frozenset({("parameter", name)}) if is_list else frozenset()
            value = CExpression(text, type_, reads=reads, sign=type_.sign, is_pointer=type_.kind == "object")
            if type_.kind == "optional":
                value = value._replace(text=f"*{text}", type=FLOAT, rank=UNARY, length="optional")
            self.names[name] = value
        self.names |= dict.fromkeys(function.texts, CExpression("", TEXT))
        if function.owner is not None:
            owner, samples = ValueType("object", function.owner), program.samples_in(function.owner)
            self.names["self"] = CExpression("self", owner, is_pointer=True, samples=samples)

    def run(self) -> list[str]:
        """Lower the function; return its lines of C code."""
        self.block(self.function.node.body)
        lines = self.lines[:-1] if self.lines[-1:] == ["return;"] else self.lines
        return [*self.hoisted, *lines]

    def block(self, body: list[ast.stmt]) -> bool:
        """Lower the statements of a block; return whether control never reaches the end of the block."""
        leaves, outer = False, self.span
        self.span = (body[0].lineno, body[-1].end_lineno or 0) if body else outer
        for statement in body:
            is_constant = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if not is_constant and not isinstance(statement, ast.Pass):
                self.explain(statement)
                lower = getattr(self, f"do_{type(statement).__name__.lower()}", None)
                if lower is None:
                    expected = "assignments, if, for, while, return"
                    raise self.refuse(statement, type(statement).__name__, expected)
                leaves = bool(lower(statement)) or leaves
        self.span = outer
        return leaves

    def do_assign(self, node: ast.Assign) -> None:
        is_simple = isinstance(node.value, (ast.Constant, ast.Attribute, ast.Name))
        if len(node.targets) > 1 and not is_simple:
            raise self.refuse(node, "one expression for several targets", "an assignment for each target")
        for target in reversed(node.targets):
            if isinstance(target, ast.Tuple):
                self._unpack(node, target)
            else:
                self._assign(node, target, node.value)

    def do_annassign(self, node: ast.AnnAssign) -> None:
        required = self.program.local_type(self.function, node.annotation)
        if node.value is None or required is None:
            expected = "`name: TYPE = value`, where TYPE is float, int, bool or a class"
            raise self.refuse(node, f"`{ast.unparse(node)}`", expected)
        self._assign(node, node.target, node.value, required)

    def do_augassign(self, node: ast.AugAssign) -> None:
        value = ast.copy_location(ast.BinOp(node.target, node.op, node.value), node)
        self._store(node, node.target, self.number(value))

    def _unpack(self, node: ast.Assign, target: ast.Tuple) -> None:
        if isinstance(node.value, ast.Tuple):
            values = [self.expression(element) for element in node.value.elts]
            stored = {getattr(target, "id", getattr(target, "attr", "")) for target in target.elts}
            used = {getattr(node, "id", getattr(node, "attr", "")) for node in ast.walk(node.value)}
            if stored & used or any(value.writes for value in values):
                values = [self.temporary(value, "value") if value.is_number else value for value in values]
        else:
            value = self.expression(node.value)
            if value.type.kind != "list" or value.type.length is None:
                raise self.refuse(node, f"a {value.type.kind} for several names", "a list of fixed length")
            values = [self.at(value, str(index)) for index in range(value.type.length)]
        if len(values) != len(target.elts):
            found = f"{len(target.elts)} targets for {len(values)} values"
            raise self.refuse(node, found, "as many targets as values")
        for element, value in zip(target.elts, values, strict=True):
            if getattr(element, "id", "") == "_":
                continue
            if value.type.kind in ("object", "list") and isinstance(element, ast.Name):
                self._alias(node, element, value)
            else:
                self._store(node, element, value)

    def _assign(
        self, node: ast.stmt, target: ast.expr, source: ast.expr, required: ValueType | None = None
    ) -> None:
        class_ = self.program.class_of(self.function, source)
        if isinstance(target, ast.Attribute) and isinstance(source, ast.Call) and class_ is not None:
            owner = self.expression(target.value)
            field = self.program.new_field(self, owner, target, ValueType("object", class_))
            self.construct(field, class_, source)
            self.replace(node, field.reads)
        elif self.is_display(source):
            self._assign_list(node, target, source)
        else:
            value = self.expression(source)
            if value.type.kind in ("object", "list") and isinstance(target, ast.Name):
                self._alias(node, target, value)
            elif value.type.kind != "text":
                self._store(node, target, value, required)

    def _alias(self, node: ast.stmt, target: ast.Name, value: CExpression) -> None:
        """Bind a local name to an object or a list."""
        occurrences = self.function.occurrences[target.id]
        is_local = all(self.span[0] <= line <= self.span[1] for line, _ in occurrences)
        if target.id in self.names or sum(is_store for _, is_store in occurrences) > 1 or not is_local:
            expected = "a name that is assigned once, and used only within its block"
            raise self.refuse(node, f"{target.id} assigned twice", expected)
        uses, tree = [line for line, _ in occurrences], ast.walk(self.function.node)
        loops = [n for n in tree if isinstance(n, (ast.For, ast.While)) and n.lineno > target.lineno]
        # A use in a loop may follow the last statement of the loop, in the next iteration.
        uses += [(loop.end_lineno or 0) + 1 for loop in loops if loop.lineno <= uses[-1]]
        self.aliases.append((target.id, value, max(uses)))
        name, type_ = self.program.local(target.id), value.type
        is_own = type_.kind == "list" and any(key[0] == "local" for key in value.reads)
        if not is_own and not (type_.kind == "list" and type_.of.kind == "list"):
            text = value.text if type_.kind == "list" else self.pointer(value)
            if text != name:
                base = self.program.c_type(type_.of if type_.kind == "list" else type_)
                self.emit(f"@const@{base} *const {name} = {text};")
            value = value._replace(text=name, is_pointer=True, rank=ATOM)
        self.names[target.id] = value

    def replace(self, node: ast.stmt | ast.expr, keys: Locations, of_element: bool = False) -> None:
        """Record attributes to which an assignment gives a new list or object.

        Raise SubsetError if a local name of the old one is used later: in Python it still means the old one.
        """
        self.function.replaced |= keys
        for name, value, last in self.aliases:
            is_outer = of_element and value.type.kind == "list" and value.type.of.kind == "list"
            if value.reads & keys and not is_outer and last > (node.end_lineno or 0):
                expected = f"`[:] = ` in place, or a copy, `{name} = list(...)`"
                raise self.refuse(node, f"a new list or object while {name} uses the old one", expected)

    def _assign_list(self, node: ast.stmt, target: ast.expr, source: ast.expr) -> None:
        if isinstance(target, ast.Name):
            self._alias(node, target, self.array(source, None, self.program.local(target.id)))
            return
        field = None if isinstance(target, ast.Attribute) else self.expression(target)
        if isinstance(target, ast.Attribute):
            owner = self.expression(target.value)
            if isinstance(source, ast.BinOp) and (count := self.number(source.right)).constant is None:
                self.program.new_samples(self, owner, target, count)
                owner = self.expression(target.value)
            field = self.program.known_field(self, owner, target)
            if field is None:
                with self.captured():
                    type_ = self.array(source, None).type
                field = self.program.new_field(self, owner, target, type_)
        if field is None or field.type.kind != "list":
            raise self.refuse(node, "a list assigned to an element", "a number")
        self.array(source, field)
        self._replace_at(node, target, field)
        self.changed(field, isinstance(target, ast.Subscript))

    def _store(
        self, node: ast.stmt, target: ast.expr, value: CExpression, required: ValueType | None = None
    ) -> None:
        """Emit the assignment of a value to a name, an attribute or an element."""
        if isinstance(target, ast.Name):
            self._store_name(node, target.id, value, required)
            return
        if value.fails:
            value = self.temporary(value, self.hint_of(target))
        if isinstance(target, ast.Attribute):
            owner = self.expression(target.value)
            existing = self.program.known_field(self, owner, target)
            field = existing or self.program.new_field(self, owner, target, value.type)
        elif isinstance(target, ast.Subscript):
            field = self.expression(target)
        else:
            raise self.refuse(node, "this target", "a name, an attribute or an element")
        if field.type.kind == "list":
            self.copy(field, value, node)
            self._replace_at(node, target, field)
            self.share(node, field.reads, value)
        elif field.type.kind != "text":
            self._emit_store(node, field, value)
        self.changed(field, isinstance(target, ast.Subscript))
        if value.sign:
            self.facts[field.text] = NumberFact(value.sign, field.reads)

    def _replace_at(self, node: ast.stmt, target: ast.expr, field: CExpression) -> None:
        """Record that an assignment replaces a list, unless it is an assignment in place."""
        if not (isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice)):
            self.replace(node, field.reads, isinstance(target, ast.Subscript))

    def _emit_store(self, node: ast.stmt, field: CExpression, value: CExpression) -> None:
        self.fit(node, field.type, value, f"for a {field.type.kind}", "one type for each name")
        text = self.program.stored(field.type, value)
        operation = re.match(rf"{re.escape(field.text)} ([-+*/&|^]) ", text)
        if operation and isinstance(node, ast.AugAssign):
            self.emit(f"{field.text} {operation[1]}= {text[operation.end() :]};")
        elif text != field.text:
            self.emit(f"{field.text} = {text};")

    def _store_name(self, node: ast.stmt, name: str, value: CExpression, required: ValueType | None) -> None:
        text, existing = self.program.local(name), self.names.get(name)
        if existing is None:
            occurrences = self.function.occurrences[name]
            type_ = required or value.type._replace(c_int="int64_t", sign="")
            declared = f"{self.program.c_type(type_)} {text}"
            is_once = sum(is_store for _, is_store in occurrences) == 1
            first, last = max(self.span[0], node.lineno), self.span[1]
            is_here = all(first <= line <= last for line, _ in occurrences)
            zero = {"float": " = 0.0", "int": " = 0", "bool": " = false"}.get(type_.kind, "")
            if is_here:
                head = "const " if is_once else ""
                self.emit(f"{head}{declared} = {self.program.stored(type_, value)};")
            else:
                self.hoisted.append(f"{declared}{zero};")
                self.emit(f"{text} = {self.program.stored(type_, value)};")
            self.names[name] = CExpression(text, type_, sign=type_.sign, span=value.span if is_once else None)
        else:
            self._emit_store(node, existing._replace(text=text), value)
        self.check(value)
        self.facts.pop(text, None)
        if value.sign:
            self.facts[text] = NumberFact(value.sign)

    def changed(self, field: CExpression, in_place: bool) -> None:
        """Record an assignment to an attribute or an element."""
        self.note(field.reads)
        self.function.changes |= {name for kind, name in field.reads if kind == "parameter"}
        if in_place:
            self.program.changed_in_place |= field.reads
            for key in field.reads & self.function.shared.keys():
                raise self.function.shared[key]

    def share(self, node: ast.AST, target: Locations, value: CExpression) -> None:
        """Record a list that an attribute shares with a second name; such a list must not change in place."""
        error = self.refuse(node, "a list that is shared and changed in place", "a copy of it, `list(...)`")
        for key in value.reads:
            if key[0] == "parameter":
                self.function.retained[key[1]] = target
            elif key[0] == "local":
                self.function.shared[key] = error
            else:
                self.program.shared.append((target | value.reads, error))

    def do_expr(self, node: ast.Expr) -> None:
        value = self.expression(node.value)
        if not isinstance(node.value, ast.Call):
            raise self.refuse(node, "an expression without effect", "a call")
        if value.type.kind != "list":
            self.emit(f"{value.text};" if value.type.kind == "none" else f"(void){value.text};")
            self.check(value)

    def do_return(self, node: ast.Return) -> bool:
        returns = self.function.returns
        if node.value is None or returns.kind == "none":
            self.emit("return;")
        elif returns.kind == "list":
            self.array(node.value, CExpression("result", returns))
            self.emit("return;")
        else:
            self._return(node, self.expression(node.value))
        return True

    def _return(self, node: ast.stmt, value: CExpression) -> None:
        self.fit(node, self.function.returns, value, "returned")
        self.emit(f"return {self.program.stored(self.function.returns, value)};")

    def do_raise(self, node: ast.Raise) -> bool:
        self.fail(node, "a raise")
        return True

    def do_if(self, node: ast.If) -> bool:
        test = self.truth(node.test)
        if test.constant is not None:
            return self.block(node.body if test.constant else node.orelse)
        self.emit(f"if ({test.text}) {{")
        before, outcomes = self.facts, []
        for body, truth in ((node.body, True), (node.orelse, False)):
            self.facts = before | self.facts_of(node.test, truth)
            outer, self.lines = self.lines, []
            leaves = self.block(body)
            inner, self.lines = self.lines, outer
            is_chain = not truth and len(body) == 1 and isinstance(body[0], ast.If)
            if is_chain and inner and inner[0].startswith("if ("):
                self.emit(f"}} else {inner[0]}", *inner[1:-1])
            else:
                self.emit(*["} else {"] * bool(inner and not truth), *inner)
            outcomes.append((leaves, self.facts))
        self.emit("}")
        (first, left), (second, right) = outcomes
        self.facts = right if first else left if second else dict(left.items() & right.items())
        return first and second

    def do_for(self, node: ast.For) -> None:
        loop = self.loop(node.iter)
        if node.orelse or not loop.stop or has_text(loop.constants):
            found = "a loop over text, or with else"
            raise self.refuse(node, found, "a loop over numbers, without else")
        names = self.targets(node.target, len(loop.values("")))
        is_range = loop.values("i")[0].text == "i" and len(names) == 1 and names[0] != "_"
        index = self.program.local(names[0]) if is_range else self.fresh("i")
        stop = loop.stop
        if loop.count is None and not stop.replace("->", "").isidentifier():
            stop = self.temporary(CExpression(stop, INT), "stop").text
        test, step = ("<", "++") if loop.step == 1 else (">", "--")
        self.emit(f"for (int64_t {index} = {loop.start}; {index} {test} {stop}; {index}{step}) {{")
        hidden, self.facts = dict(self.names), {}
        for name, value in zip(names, loop.values(index), strict=True):
            if value.text != index and name != "_" and value.type.kind != "list":
                text = self.program.local(name)
                constant = "" if name in self.function.occurrences else "const "
                self.emit(f"{constant}{self.program.c_type(value.type)} {text} = {value.text};")
                value = value._replace(text=text, reads=frozenset(), rank=ATOM)
            self.names[name] = value
        before = len(self.aliases)
        self.aliases += [("the loop", value, (node.end_lineno or 0) + 1) for value in loop.values(index)]
        self.block(node.body)
        del self.aliases[before:]
        self.emit("}")
        others = {name: value for name, value in self.names.items() if name not in names}
        self.names = others | {name: hidden[name] for name in names if name in hidden}
        self.facts = {}

    def do_while(self, node: ast.While) -> None:
        self.facts = {}
        with self.captured() as lines:
            test = self.truth(node.test)
        leave = [f"if (!{test.at(UNARY)}) {{", "break;", "}"]
        self.emit(f"while ({'true' if lines else test.text}) {{", *lines, *leave * bool(lines))
        self.block(node.body)
        self.emit("}")
        self.facts = {}

    def do_break(self, node: ast.Break | ast.Continue) -> bool:
        self.emit("break;" if isinstance(node, ast.Break) else "continue;")
        return True

    do_continue = do_break

    def do_try(self, node: ast.Try) -> bool:
        """Lower `try` around a single call with `except Exception`."""
        statement = node.body[0]
        if len(node.body + node.handlers) != 2 or node.orelse or node.finalbody:
            raise self.refuse(node, "this try", "`try` with a single call and a single `except Exception`")
        if not isinstance(statement, (ast.Assign, ast.Return)) or not isinstance(statement.value, ast.Call):
            raise self.refuse(node, "this try", "`try` with `name = call(...)` or `return call(...)`")
        function, failures, position = self.function, self.failures, len(self.lines)
        before = function.error, function.fails, function.reason
        flag = self.fresh("failed")
        function.error = f"&{flag}"
        value = self.expression(statement.value)
        if self.failures > failures:
            raise self.refuse(node, "an operation in try that may raise", "only a call")
        function.error, function.fails, function.reason = before
        fails, value = value.fails, value._replace(fails=False)
        if fails:
            self.lines.insert(position, f"bool {flag} = false;")
            if isinstance(statement, ast.Return):
                value = self.temporary(value, "value")
        if isinstance(statement, ast.Assign):
            self._store(statement, statement.targets[0], value)
        if fails:
            self.emit(f"if ({flag}) {{")
            self.block(node.handlers[0].body)
            self.emit("}")
        if isinstance(statement, ast.Return):
            self._return(statement, value)
        return isinstance(statement, ast.Return)
