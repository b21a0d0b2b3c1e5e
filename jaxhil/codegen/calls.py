"""Lowering of calls (built-in functions, `math`, functions, methods, constructors) and of attributes."""

import ast
import inspect
import sys
import types
import typing
from collections.abc import Callable
from typing import Any

from .lists import ListLowering
from .lowering import LARGEST_INT, MAX_SQUARABLE_INT
from .subset import BOOL, FLOAT, INT, Locations, Sign, ValueType, type_of_annotation
from .values import CExpression, Rank, as_float, combine, constant

# Condition on the operands `{0}`, `{1}` and the result `{r}` for which a function of `math` raises.
MATH_DOMAIN_ERRORS = {
    **{"sqrt": "{0} < 0.0", "log": "{0} <= 0.0", "exp": "isinf({r}) && isfinite({0})"},
    **dict.fromkeys(("sin", "cos", "tan"), "isinf({0})"),
    **dict.fromkeys(("asin", "acos"), "fabs({0}) > 1.0"),
    "fmod": "isinf({0}) || {1} == 0.0",
    **dict.fromkeys(("atan", "atan2", "tanh", "fabs", "copysign", "isfinite", "isnan", "isinf"), ""),
}
# Sign of the operand for which a function does not raise.
SAFE_SIGNS = {
    "sqrt": Sign.NONNEGATIVE,
    "log": Sign.POSITIVE,
}
INT_CONVERSIONS = {"floor": "floor({})", "ceil": "ceil({})", "round": "nearbyint({})"}
# C cannot reproduce the rounding of these functions.
IRREPRODUCIBLE = ("sum", "fsum", "hypot", "pow")


class CallLowering(ListLowering):
    """Lowering (translation) of Python calls and attributes to C."""

    share: Callable[[ast.AST, Locations, CExpression], None]
    changed: Callable[[CExpression, bool], None]
    replace: Callable[[ast.expr, Locations], None]

    def lower_attribute(self, node: Any) -> CExpression:
        name = getattr(node.value, "id", "")
        module = None if name in self.names else self.function.namespace.get(name)
        if isinstance(module, types.ModuleType) and hasattr(module, node.attr):
            return self.program.named_constant(node.attr, vars(module))
        value = self.expression(node.value)
        found = f".{node.attr} of a {value.type.kind}"
        self.require(value.type.kind in ("object", "record"), node, found, "an attribute of an object")
        static = inspect.getattr_static(value.type.of, node.attr, None)
        if isinstance(static, property):
            return self.invoke(static.fget, value, ast.copy_location(ast.Call(node, [], []), node))
        return self.field(value, node.attr, node)

    def field(self, owner: CExpression, name: str, node: ast.AST, new_type: Any = None) -> CExpression:
        """Return the C expression for an attribute.

        Raise SubsetError if the attribute has no known type. An assignment passes `new_type`, a function that
        returns the type of the assigned value.
        """
        class_, plain, keys = owner.type.of, name.lstrip("_"), frozenset({(owner.type.of, name)})
        is_object = owner.type.kind == "object" or new_type is None
        self.require(is_object, node, f"an attribute of a {owner.type.kind}", "an object")
        self.function.reads |= keys
        fields = self.program.fields.setdefault(class_, {})
        default = inspect.getattr_static(class_, name, None)
        if name not in fields and isinstance(default, (bool, int, float)):
            if new_type is None:
                return self._class_constant(class_, name, default)
            is_initial = any(key[0].__name__ == "__init__" for key in self.program.under_way)
            found = f"the first assignment to {name}, which has a default"
            self.require(is_initial, node, found, "an assignment in `__init__`")
        if name not in fields and new_type and name not in typing.get_type_hints(class_):
            fields[name] = new_type().plain
        type_ = fields.get(name) or self.field_type(owner.type, name, node)
        length = owner.attribute(f"{plain}_length") if type_.capacity else ""
        text = owner.attribute(self.program.field_name(class_, name))
        return CExpression(text, type_, reads=owner.reads | keys, sign=type_.sign, length=length)

    def _class_constant(self, class_: type, name: str, value: float) -> CExpression:
        """Return the C expression of a class attribute: an enumerator of the header, or its value.

        The enumerator is used if the class's module has a constant with its name and value.
        """
        owner = next(owner for owner in class_.__mro__ if name in vars(owner))
        namespace, result = vars(sys.modules[owner.__module__]), constant(value)
        numbers = self.program.enumerators
        names = [name for name, number in numbers.items() if namespace.get(name) == number == value]
        return result._replace(text=f"{self.program.prefix}{names[0]}".upper()) if names else result

    def field_type(self, type_: ValueType, name: str, node: ast.AST) -> ValueType:
        """Return the type of an attribute from its annotation. Raise SubsetError if it has no annotation."""
        hints = typing.get_type_hints(type_.of, include_extras=True)
        hinted = type_of_annotation(hints.get(name, ...), self.program.bindings)
        if hinted is None:
            found = f"{name} of {type_.of.__name__}, which has no known type"
            raise self.reject(node, found, "an assignment in `__init__`, or an annotation in the class")
        fields = self.program.fields.setdefault(type_.of, {})
        # A record has all its fields, in order, because its initialisers name none.
        for other in getattr(type_.of, "_fields", ()):
            fields.setdefault(other, type_of_annotation(hints[other], self.program.bindings) or hinted)
        return fields.setdefault(name, hinted)

    def new_samples(self, owner: CExpression, target: ast.Attribute, count: CExpression) -> None:
        """Record an attribute that is a list of floats of run-time length; emit a test of its length."""
        class_, plain = owner.type.of, target.attr.lstrip("_")
        is_initial = self.function.node.name == "__init__" and owner.text == "self"
        expected = "a list of fixed length, or an assignment in `__init__`"
        self.require(is_initial, target, "a list of computed length", expected)
        capacity = f"{self.program.class_name(class_)}_{plain}".upper()
        fields = {f"{plain}_length": INT, target.attr: ValueType("list", FLOAT, capacity=capacity)}
        self.program.fields.setdefault(class_, {}).update(fields)
        condition = f"{count.text} < 0 || {count.text} > {capacity}"
        self.fail_if(condition, target, "a list longer than its capacity")
        self.emit(f"self->{plain}_length = {count.text};")

    def lower_call(self, node: Any) -> CExpression:
        called, namespace = node.func, self.function.namespace
        name = getattr(called, "attr", getattr(called, "id", ""))
        if isinstance(called, ast.Attribute):
            target = namespace.get(getattr(called.value, "id", ""))
            if not isinstance(target, types.ModuleType):
                value = self.expression(called.value)
                method = inspect.getattr_static(value.type.of, name, None)
                is_method = value.type.kind == "object" and inspect.isfunction(method)
                self.require(is_method, node, f"a call of .{name}", "a method of a class with source code")
                return self.invoke(method, value, node)
            target = getattr(target, name, None)
        else:
            target = namespace.get(name, getattr(self, f"builtin_{name}", None))
        if inspect.ismethod(target):
            return target(node)
        if inspect.isfunction(target):
            return self.invoke(target, None, node)
        if inspect.isclass(target):
            expected = "`self.name = Class(...)` in `__init__`"
            self.require(issubclass(target, tuple), node, f"{name}(...) here", expected)
            return self._record(target, node)
        return self._math(node, getattr(target, "__name__", name))

    def builtin_abs(self, node: Any) -> CExpression:
        value = self.number(node.args[0])
        if value.type.kind == "int":
            text = self.simple(value, "value").text
            text = f"{text} < 0 ? -{text} : {text}"
            return combine(text, INT, Rank.CONDITIONAL, value, sign=Sign.NONNEGATIVE)
        return combine(f"fabs({value.text})", FLOAT, Rank.ATOM, value, sign=value.sign | Sign.NONNEGATIVE)

    def builtin_max(self, node: Any, mark: str = ">") -> CExpression:
        values = [self.simple(value, "value") for value in self.operands(node.args, self.number)]
        is_alike = len(values) > 1 and len({value.type.kind for value in values}) == 1
        self.require(is_alike, node, "max or min of other values", "two or more numbers of one type")
        extreme, sign = values[0], values[0].sign
        for value in values[1:]:
            # With this order of the operands, NaN has the same result as in Python.
            extreme = self.simple(extreme, "extreme") if extreme.rank == Rank.CONDITIONAL else extreme
            text = f"{value.at(Rank.SUM)} {mark} {extreme.at(Rank.SUM)} ? {value.text} : {extreme.text}"
            extreme = combine(text, extreme.type.plain, Rank.CONDITIONAL, extreme, value)
            sign &= value.sign
        if mark == ">":
            sign = max((value.sign for value in values if value.sign & Sign.NONNEGATIVE), default=0)
        return extreme._replace(sign=sign)

    def builtin_min(self, node: Any) -> CExpression:
        return self.builtin_max(node, "<")

    def builtin_float(self, node: Any) -> CExpression:
        return as_float(self.number(node.args[0]))

    def builtin_bool(self, node: Any) -> CExpression:
        return self.truth(node.args[0])

    def builtin_list(self, node: Any) -> CExpression:
        return self.array(node, None)

    def builtin_len(self, node: Any) -> CExpression:
        value = self.expression(node.args[0])
        self.require(value.type.kind == "list", node, f"len of a {value.type.kind}", "len of a list")
        length = value.type.length
        return constant(length) if length else CExpression(value.length, INT, sign=Sign.NONNEGATIVE)

    def builtin_int(self, node: Any, form: str = "") -> CExpression:
        """Lower a conversion to int; the C code fails for values that are not finite or exceed 2^53."""
        self.require(len(node.args) == 1, node, "round to digits", "round to an int")
        value = self.number(node.args[0])
        if value.type.kind == "int":
            return value
        text = form.format(value.text) if form else value.at(Rank.UNARY)
        if not (value.span and max(map(abs, value.span)) < MAX_SQUARABLE_INT):
            text = self.temporary(value._replace(text=text), "whole").text
            condition = f"!(fabs({text}) <= {float(LARGEST_INT)})"
            self.fail_if(condition, node, "a float to int conversion that may fail")
        return CExpression(f"(int64_t){text}", INT, Rank.UNARY, sign=value.sign & Sign.NONNEGATIVE)

    def _math(self, node: Any, name: str) -> CExpression:
        if name in INT_CONVERSIONS:
            return self.builtin_int(node, INT_CONVERSIONS[name])
        is_available = name in MATH_DOMAIN_ERRORS and not node.keywords
        other = "a loop or a product" if name in IRREPRODUCIBLE else "a function with source code"
        expected = f"{other}, or a function of the module math ({', '.join(MATH_DOMAIN_ERRORS)})"
        self.require(is_available, node, f"{name}(...)", expected)
        values = [as_float(operand) for operand in self.operands(node.args, self.number)]
        safe, sign = SAFE_SIGNS.get(name), values[0].sign
        test = "" if safe and sign & safe == safe else MATH_DOMAIN_ERRORS[name]
        values = [self.simple(operand, "operand") for operand in values] if test else values
        texts = [operand.text for operand in values]
        signs = {"sqrt": sign | Sign.NONNEGATIVE, "fabs": sign | Sign.NONNEGATIVE, "exp": Sign.NONNEGATIVE}
        type_ = BOOL if name.startswith("is") else FLOAT
        value = combine(f"{name}({', '.join(texts)})", type_, Rank.ATOM, *values, sign=signs.get(name, 0))
        if test:
            value = self.temporary(value, f"{name}_value") if "{r}" in test else value
            self.fail_if(test.format(*texts, r=value.text), node, f"{name} that may raise")
        return value

    def call_helper(self, node: Any, left: CExpression, right: CExpression, name: str) -> CExpression:
        if name != "power":
            right = self.divisor(node, right)
            sign = right.sign & Sign.NONNEGATIVE * name.startswith("modulo")
            text = self.program.helper(name, left.text, right.text)
            return combine(text, left.type.plain, Rank.ATOM, left, right, sign=sign)
        left, right = self.simple(left, "base"), self.simple(right, "exponent")
        value = self.temporary(CExpression(self.program.helper(name, left.text, right.text), FLOAT), "power")
        base, exponent = left.text, right.text
        tests = [f"(isinf({value.text}) && isfinite({base}) && isfinite({exponent}))"]
        if not (isinstance(right.constant, float) and right.constant.is_integer() and right.constant > 0.0):
            is_whole = f"isfinite({exponent}) && floor({exponent}) == {exponent}"
            tests += [f"({base} == 0.0 && {exponent} < 0.0)", f"({base} < 0.0 && !({is_whole}))"]
        self.fail_if(" || ".join(tests), node, "a power that may raise")
        return value

    def _arguments(self, function: Callable[..., Any], node: Any) -> dict[str, Any]:
        """Return the arguments of a call by parameter name, as syntax trees or default values."""
        parameters = {k: p for k, p in inspect.signature(function).parameters.items() if k != "self"}
        arguments: dict[str, Any] = dict(zip(parameters, node.args, strict=False))
        arguments |= {str(keyword.arg): keyword.value for keyword in node.keywords}
        defaults = {k: p.default for k, p in parameters.items() if p.default is not p.empty}
        is_complete = len(node.args) <= len(parameters) and {*parameters} == {*defaults, *arguments}
        self.require(is_complete, node, "these arguments", "one argument for each parameter")
        return arguments | {k: default for k, default in defaults.items() if k not in arguments}

    def _lowered(self, arguments: dict[str, Any]) -> dict[str, CExpression]:
        nodes = [argument for argument in arguments.values() if isinstance(argument, ast.expr)]
        lowered = iter(self.operands(nodes))
        return {k: next(lowered) if isinstance(v, ast.expr) else constant(v) for k, v in arguments.items()}

    def invoke(self, function: Any, receiver: CExpression | None, node: Any) -> CExpression:
        """Lower a call of a function with source code, or of a method of `receiver`."""
        owner = receiver.type.of if receiver else None
        types_ = self.program.parameters(function, owner)
        arguments = self._arguments(function, node)
        values = self._lowered({k: v for k, v in arguments.items() if types_[k].kind != "non-number"})
        for name, value in values.items():
            required = types_[name]
            if required.kind == value.type.kind == "list" and required.length in (None, value.type.length):
                types_[name] = value.type
            else:
                self.fit(node, required, value, f"for {name}")
        called = self.program.function(function, owner, types_, self)
        texts = [receiver.pointer] if receiver else []
        texts += [values[name].stored(called.parameters[name]) for name in called.parameters]
        writes = called.writes | {key for name in called.changes for key in values[name].reads}
        self.note(writes)
        self.replace(node, called.replaced)
        for name in called.parameters:
            is_old = values[name].type.kind in ("list", "object") and values[name].reads & called.replaced
            found = f"{name} as an argument of {called.node.name}, which replaces it"
            self.require(not is_old, node, found, "a copy, `list(...)`")
        for name in called.changes:
            self.changed(values[name], True)
        for name, target in called.retained.items():
            self.share(node, target, values[name])
        self.function.reason = self.function.reason or called.reason
        self.function.fails = self.function.fails or called.fails
        returns, array = called.returns, ""
        if returns.kind == "list":
            array = self.fresh(self.hint_of(node))
            self.emit(f"{self.program.declaration(returns, array)};")
        texts += [array] * bool(array) + [self.function.error] * called.fails
        reads = called.reads | (receiver.reads if receiver else frozenset())
        text, type_ = f"{called.name}({', '.join(texts)})", returns._replace(sign=0)
        value = CExpression(text, type_, Rank.ATOM, reads, writes, called.fails, returns.sign)
        if not array:
            return value
        self.emit(f"{text};")
        self.check(value)
        return CExpression(array, returns, reads=frozenset({("local", array)}))

    def _record(self, target: Any, node: Any) -> CExpression:
        values, record = self._lowered(self._arguments(target, node)), ValueType("record", target)
        required = {name: self.field_type(record, name, node) for name in target._fields}
        texts = [values[name].stored(t) for name, t in required.items() if t.kind != "non-number"]
        name = self.fresh("record")
        self.emit(f"const {self.program.c_type(record)} {name} = {{{', '.join(texts)}}};")
        return CExpression(name, record)

    def construct(self, target: CExpression, class_: type, node: Any) -> None:
        """Lower `self.name = Class(...)` to a call that initialises the member struct `name`."""
        init = inspect.getattr_static(class_, "__init__", None)
        if inspect.isfunction(init):
            value = self.invoke(init, target, node)
            self.emit(f"{value.text};")
            self.check(value)
