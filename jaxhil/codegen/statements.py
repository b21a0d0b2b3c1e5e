"""Lowering of statements: assignments, branches, loops and exceptions."""

import ast
import re
from typing import TYPE_CHECKING, Any

from .calls import CallLowering
from .printing import escape_comment
from .python_source import read_comment_before
from .subset import FLOAT, INT, Locations, ValueType
from .values import ZEROS, CExpression, Rank, constant

if TYPE_CHECKING:
    from .program import CFunction, CProgram


class BodyLowering(CallLowering):
    """Lowering (translation) of the statements of one Python function to C."""

    def __init__(self, program: "CProgram", function: "CFunction") -> None:
        super().__init__(program, function)
        self.span = (0, 0)  # first and last line of the current block
        self.hoisted: list[str] = []  # C declarations at the beginning of the function
        # local names of lists and objects: name, value, last line of use
        self.aliases: list[tuple[str, CExpression, int]] = []
        for name, type_ in function.parameters.items():
            text, is_list = program.local(name), type_.kind == "list"
            reads: Locations = frozenset({("parameter", name)} if is_list else ())
            value = CExpression(text, type_, reads=reads, sign=type_.sign, is_pointer=type_.kind == "object")
            if type_.kind == "optional":
                value = value._replace(text=f"*{text}", type=FLOAT, rank=Rank.UNARY, length="optional")
            self.names[name] = value
        self.names |= dict.fromkeys(function.texts, constant(""))
        if function.owner is not None:
            owner = ValueType("object", function.owner)
            self.names["self"] = CExpression("self", owner, is_pointer=True)

    def run(self) -> list[str]:
        self.block(self.function.node.body)
        lines = self.lines[:-1] if self.lines[-1:] == ["return;"] else self.lines
        return [*self.hoisted, *lines]

    def block(self, body: list[ast.stmt]) -> bool:
        """Lower the statements of a block; return whether control always leaves it early, as by `return`."""
        leaves, outer = False, self.span
        self.span = (body[0].lineno, body[-1].end_lineno or 0) if body else outer
        for statement in body:
            is_constant = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
            if not is_constant and not isinstance(statement, ast.Pass):
                if text := read_comment_before(self.function.file, statement):
                    self.emit(f"/* {escape_comment(text)} */")
                kind = type(statement).__name__
                lower: Any = getattr(self, f"do_{kind.lower()}", None)
                self.require(lower, statement, kind, "assignments, if, for, while, return")
                leaves = bool(lower(statement)) or leaves
        self.span = outer
        return leaves

    def do_assign(self, node: Any) -> None:
        is_simple = len(node.targets) == 1 or isinstance(node.value, (ast.Constant, ast.Attribute, ast.Name))
        found, expected = "one expression for several targets", "an assignment for each target"
        self.require(is_simple, node, found, expected)
        for target in reversed(node.targets):
            if isinstance(target, ast.Tuple):
                self._unpack(node, target)
            else:
                self._assign(node, target, node.value)

    def do_annassign(self, node: Any) -> None:
        required = self.program.local_type(self.function, node.annotation)
        expected = "`name: TYPE = value`, where TYPE is float, int, bool or a class"
        self.require(node.value and required, node, f"`{ast.unparse(node)}`", expected)
        self._assign(node, node.target, node.value, required)

    def do_augassign(self, node: Any) -> None:
        value = ast.copy_location(ast.BinOp(node.target, node.op, node.value), node)
        self._store(node, node.target, self.number(value))

    def _unpack(self, node: Any, target: Any) -> None:
        if isinstance(node.value, ast.Tuple):
            values = [self.expression(element) for element in node.value.elts]
            stored = {getattr(target, "id", getattr(target, "attr", "")) for target in target.elts}
            used = {getattr(node, "id", getattr(node, "attr", "")) for node in ast.walk(node.value)}
            if stored & used or any(value.writes for value in values):
                values = [self.temporary(value, "value") if value.is_number else value for value in values]
        else:
            value = self.expression(node.value)
            is_list = value.type.kind == "list" and value.type.length is not None
            self.require(is_list, node, f"a {value.type.kind} for several names", "a list of fixed length")
            values = [self.at(value, str(index)) for index in range(value.type.length or 0)]
        found = f"{len(target.elts)} targets for {len(values)} values"
        self.require(len(values) == len(target.elts), node, found, "as many targets as values")
        for element, value in zip(target.elts, values, strict=True):
            if getattr(element, "id", "") != "_":
                self._store(node, element, value)

    def _assign(self, node: Any, target: Any, source: Any, required: ValueType | None = None) -> None:
        class_ = self.program.class_of(self.function, source)
        if isinstance(target, ast.Attribute) and class_ is not None:
            owner, type_ = self.expression(target.value), ValueType("object", class_)
            field = self.field(owner, target.attr, target, lambda: type_)
            self.construct(field, class_, source)
            self.replace(node, field.reads)
        elif self.is_display(source):
            self._assign_list(node, target, source)
        else:
            self._store(node, target, self.expression(source), required)

    def _alias(self, node: Any, target: Any, value: CExpression) -> None:
        occurrences = self.function.occurrences[target.id]
        uses = [line for line, _ in occurrences]
        is_once = sum(is_store for _, is_store in occurrences) == 1 and target.id not in self.names
        is_local = self.span[0] <= uses[0] and uses[-1] <= self.span[1]
        expected = "a name that is assigned once, and used only within its block"
        self.require(is_once and is_local, node, f"{target.id} assigned twice", expected)
        # A use in a loop may follow the last statement of the loop, in the next iteration.
        loops = [n for n in ast.walk(self.function.node) if isinstance(n, (ast.For, ast.While))]
        ends = [(loop.end_lineno or 0) + 1 for loop in loops if target.lineno < loop.lineno <= uses[-1]]
        self.aliases.append((target.id, value, max(uses + ends)))
        name, type_, is_list = self.program.local(target.id), value.type, value.type.kind == "list"
        is_new = is_list and any(key[0] == "local" for key in value.reads)
        if not is_new and not (is_list and type_.of.kind == "list"):
            text = value.text if is_list else value.pointer
            if text != name:
                base = self.program.c_type(type_.of if is_list else type_)
                self.emit(f"@const@{base} *const {name} = {text};")
            value = value._replace(text=name, is_pointer=True, rank=Rank.ATOM)
        self.names[target.id] = value

    def replace(self, node: Any, keys: Locations, of_element: bool = False) -> None:
        """Record that an assignment has replaced the lists or objects of the attributes `keys`.

        Raise SubsetError if a later line uses a local name that was assigned the old list or object. In
        Python, this name still refers to the old one, but in C to the new one.
        """
        self.function.replaced |= keys
        for name, value, last in self.aliases:
            is_outer = of_element and value.type.kind == "list" and value.type.of.kind == "list"
            is_used = value.reads & keys and not is_outer and last > node.end_lineno
            found, expected = f"a new list or object while {name} uses the old one", f"`{name} = list(...)`"
            self.require(not is_used, node, found, f"`[:] = ` in place, or a copy, {expected}")

    def _assign_list(self, node: Any, target: Any, source: Any) -> None:
        if isinstance(target, ast.Name):
            self._alias(node, target, self.array(source, None, self.program.local(target.id)))
            return

        def new_type() -> ValueType:
            with self.captured():
                return self.array(source, None).type

        if isinstance(target, ast.Attribute):
            owner = self.expression(target.value)
            if isinstance(source, ast.BinOp) and (count := self.number(source.right)).constant is None:
                self.new_samples(owner, target, count)
            field = self.field(owner, target.attr, target, new_type)
        else:
            field = self.expression(target)
        self.require(field.type.kind == "list", node, "a list assigned to an element", "a number")
        self.array(source, field)
        self._replace_at(node, target, field)
        self.changed(field, isinstance(target, ast.Subscript))

    def _store(self, node: Any, target: Any, value: CExpression, required: ValueType | None = None) -> None:
        """Emit the assignment of a value to a name, an attribute or an element."""
        is_name, is_element = isinstance(target, ast.Name), isinstance(target, ast.Subscript)
        if value.type.kind in ("object", "list") and is_name:
            return self._alias(node, target, value)
        if value.type.kind == "non-number":
            is_text = isinstance(value.constant, (str, tuple, list, frozenset))
            found, expected = "a value without equivalent in C", "a number, a bool or a text"
            return self.require(is_text, node, found, expected)
        if is_name:
            return self._store_name(node, target.id, value, required)
        if value.fails:
            value = self.temporary(value, self.hint_of(target))
        if isinstance(target, ast.Attribute):
            owner = self.expression(target.value)
            field = self.field(owner, target.attr, target, lambda: value.type)
        else:
            self.require(is_element, node, "this target", "a name, an attribute or an element")
            field = self.expression(target)
        if field.type.kind == "list":
            self.copy(field, value, node)
            self._replace_at(node, target, field)
            self.share(node, field.reads, value)
        elif field.type.kind != "non-number":
            self._emit_store(node, field, value)
        self.changed(field, is_element)
        self.facts[field.text] = field._replace(sign=value.sign)

    def _replace_at(self, node: Any, target: Any, field: CExpression) -> None:
        if not (isinstance(target, ast.Subscript) and isinstance(target.slice, ast.Slice)):
            self.replace(node, field.reads, isinstance(target, ast.Subscript))

    def _emit_store(self, node: Any, field: CExpression, value: CExpression) -> None:
        self.fit(node, field.type, value, f"for a {field.type.kind}", "one type for each name")
        text = value.stored(field.type)
        operation = re.match(rf"{re.escape(field.text)} ([-+*/&|^]) ", text)
        if operation and isinstance(node, ast.AugAssign):
            self.emit(f"{field.text} {operation[1]}= {text[operation.end() :]};")
        elif text != field.text:
            self.emit(f"{field.text} = {text};")

    def _store_name(self, node: Any, name: str, value: CExpression, required: ValueType | None) -> None:
        text, existing = self.program.local(name), self.names.get(name)
        if existing is None:
            lines = [line for line, _ in self.function.occurrences[name]]
            is_once = sum(is_store for _, is_store in self.function.occurrences[name]) == 1
            type_ = required or value.type.plain._replace(is_index=value.type.is_index)
            declared = f"{self.program.c_type(type_)} {text}"
            if max(self.span[0], node.lineno) <= lines[0] and lines[-1] <= self.span[1]:
                declared = f"{'const ' if is_once else ''}{declared}"
            else:
                zero = f" = {ZEROS[type_.kind]}" if type_.kind in ZEROS else ""
                self.hoisted.append(f"{declared}{zero};")
                declared = text
            self.emit(f"{declared} = {value.stored(type_)};")
            self.names[name] = CExpression(text, type_, sign=type_.sign, span=value.span if is_once else None)
        else:
            self._emit_store(node, existing._replace(text=text), value)
        self.check(value)
        self.facts[text] = CExpression(text, value.type, sign=value.sign)

    def changed(self, field: CExpression, in_place: bool) -> None:
        """Record an assignment to an attribute or an element."""
        self.note(field.reads)
        self.function.changes |= {name for kind, name in field.reads if kind == "parameter"}
        if in_place:
            self.program.changed_in_place |= field.reads
            for key in field.reads & self.function.shared.keys():
                raise self.function.shared[key]

    def share(self, node: Any, target: Locations, value: CExpression) -> None:
        """Record a list that an attribute shares with a second name; such a list must not change in place."""
        error = self.reject(node, "a list that is shared and changed in place", "a copy of it, `list(...)`")
        for key in value.reads:
            if key[0] == "parameter":
                self.function.retained[key[1]] = target
            elif key[0] == "local":
                self.function.shared[key] = error
            else:
                self.program.shared.append((target | value.reads, error))

    def do_expr(self, node: Any) -> None:
        value = self.expression(node.value)
        self.require(isinstance(node.value, ast.Call), node, "an expression without effect", "a call")
        if value.type.kind != "list":
            self.emit(f"{value.text};" if value.type.kind == "none" else f"(void){value.text};")
            self.check(value)

    def do_return(self, node: Any) -> bool:
        returns = self.function.returns
        if node.value is None or returns.kind == "none":
            self.emit("return;")
        elif returns.kind == "list":
            self.array(node.value, CExpression("result", returns))
            self.emit("return;")
        else:
            self._return(node, self.expression(node.value))
        return True

    def _return(self, node: Any, value: CExpression) -> None:
        self.fit(node, self.function.returns, value, "returned")
        self.emit(f"return {value.stored(self.function.returns)};")

    def do_raise(self, node: Any) -> bool:
        self.fail(node, "a raise")
        return True

    def do_if(self, node: Any) -> bool:
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

    def do_for(self, node: Any) -> None:
        loop = self.loop(node.iter)
        is_numeric = not (node.orelse or loop.texts)
        self.require(is_numeric, node, "a loop over text, or with else", "a loop over numbers, without else")
        names = self.targets(node.target, len(loop.values("")))
        is_range = loop.values("i")[0].text == "i" and len(names) == 1 and names[0] != "_"
        index = self.program.local(names[0]) if is_range else self.fresh("i")
        stop = loop.stop
        if loop.count is None and not stop.replace("->", "").isidentifier():
            stop = self.temporary(CExpression(stop, INT), "stop").text
        test, step = ("<", "++") if loop.step == 1 else (">", "--")
        self.emit(f"for (int64_t {index} = {loop.start}; {index} {test} {stop}; {index}{step}) {{")
        hidden, self.facts, aliases = dict(self.names), {}, len(self.aliases)
        for name, value in zip(names, loop.values(index), strict=True):
            self.aliases.append(("the loop", value, node.end_lineno + 1))
            if value.text != index and name != "_" and value.type.kind != "list":
                text = self.program.local(name)
                constant = "" if name in self.function.occurrences else "const "
                self.emit(f"{constant}{self.program.c_type(value.type)} {text} = {value.text};")
                value = value._replace(text=text, reads=frozenset(), rank=Rank.ATOM)
            self.names[name] = value
        self.block(node.body)
        del self.aliases[aliases:]
        self.emit("}")
        for name in names:
            self.names.pop(name, None)
            self.names |= {name: hidden[name]} if name in hidden else {}
        self.facts = {}

    def do_while(self, node: Any) -> None:
        self.facts = {}
        with self.captured() as lines:
            test = self.truth(node.test)
        leave = [f"if (!{test.at(Rank.UNARY)}) {{", "break;", "}"]
        self.emit(f"while ({'true' if lines else test.text}) {{", *lines, *leave * bool(lines))
        self.block(node.body)
        self.emit("}")
        self.facts = {}

    def do_break(self, node: Any) -> bool:
        self.emit("break;" if isinstance(node, ast.Break) else "continue;")
        return True

    do_continue = do_break

    def do_try(self, node: Any) -> bool:
        statement, function = node.body[0], self.function
        is_single = len(node.body + node.handlers) == 2 and not (node.orelse or node.finalbody)
        is_return = isinstance(statement, ast.Return)
        is_call = isinstance(getattr(statement, "value", None), ast.Call)
        is_simple = is_single and is_call and (is_return or isinstance(statement, ast.Assign))
        expected = "`name = call(...)` or `return call(...)`, and a single `except Exception`"
        self.require(is_simple, node, "this try", expected)
        before, failures, position = (function.fails, function.reason), self.failures, len(self.lines)
        flag = self.fresh("failed")
        function.error = f"&{flag}"
        value = self.expression(statement.value)
        self.require(self.failures == failures, node, "an operation in try that may raise", "only a call")
        function.error, (function.fails, function.reason) = "error", before
        fails, value = value.fails, value._replace(fails=False)
        if fails:
            self.lines.insert(position, f"bool {flag} = false;")
            value = self.temporary(value, "value") if is_return else value
        if not is_return:
            self._store(statement, statement.targets[0], value)
        if fails:
            self.emit(f"if ({flag}) {{")
            self.block(node.handlers[0].body)
            self.emit("}")
        if is_return:
            self._return(statement, value)
        return is_return
