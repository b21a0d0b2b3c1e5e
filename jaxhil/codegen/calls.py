"""Lowering of calls (built-in functions, `math`, functions, methods, constructors) and of attributes."""

import ast
import inspect
import types
from collections.abc import Callable
from typing import Any

from .expressions import MAX_SQUARABLE_INT, common
from .lists import ListLowering
from .subset import (
    ATOM,
    BOOL,
    CONDITIONAL,
    FLOAT,
    INT,
    SUM,
    UNARY,
    CExpression,
    Locations,
    ValueType,
    as_float,
    implies_sign,
)

# Condition on the operands `{0}`, `{1}` and the result `{r}` for which a function of `math` raises.
MATH_DOMAIN_ERRORS = {
    "sqrt": "{0} < 0.0",
    "log": "{0} <= 0.0",
    "exp": "isinf({r}) && isfinite({0})",
    "sin": "isinf({0})",
    "cos": "isinf({0})",
    "tan": "isinf({0})",
    "asin": "fabs({0}) > 1.0",
    "acos": "fabs({0}) > 1.0",
    "fmod": "isinf({0}) || {1} == 0.0",
    **dict.fromkeys(("atan", "atan2", "tanh", "fabs", "copysign"), ""),
}
INT_CONVERSIONS = {"int": "{}", "floor": "floor({})", "ceil": "ceil({})", "round": "nearbyint({})"}
FLOAT_TESTS = ("isfinite", "isnan", "isinf")
MAX_INT64_DOUBLE = "9007199254740992.0"  # LARGEST_INT


class CallLowering(ListLowering):
    """Lowering of calls and attributes."""

    share: Callable[[ast.AST, Locations, CExpression], None]
    changed: Callable[[CExpression, bool], None]
    replace: Callable[[ast.expr, Locations], None]

    def lower_attribute(self, node: ast.Attribute) -> CExpression:
        name = getattr(node.value, "id", "")
        module = None if name in self.names else self.function.namespace.get(name)
        if isinstance(module, types.ModuleType) and hasattr(module, node.attr):
            return self.program.named_constant(node.attr, vars(module)) or self.unknown(node, node.attr)
        value = self.expression(node.value)
        if value.type.kind not in ("object", "record"):
            raise self.refuse(node, f".{node.attr} of a {value.type.kind}", "an attribute of an object")
        static = inspect.getattr_static(value.type.of, node.attr, None)
        if isinstance(static, property) and static.fget is not None:
            return self.invoke(static.fget, value, ast.copy_location(ast.Call(node, [], []), node))
        return self.program.field(self, value, node.attr, node)

    def lower_call(self, node: ast.Call) -> CExpression:
        called, target = node.func, None
        if isinstance(called, ast.Name) and called.id not in self.names:
            target = self.function.namespace.get(called.id, getattr(self, f"builtin_{called.id}", called.id))
        elif isinstance(called, ast.Attribute):
            module = self.function.namespace.get(getattr(called.value, "id", ""))
            if isinstance(module, types.ModuleType):
                target = getattr(module, called.attr, None)
            else:
                value = self.expression(called.value)
                method = inspect.getattr_static(value.type.of, called.attr, None) if value.type.of else None
                if value.type.kind != "object" or not inspect.isfunction(method):
                    expected = "a method of a class with source code"
                    raise self.refuse(node, f"a call of .{called.attr}", expected)
                return self.invoke(method, value, node)
        if inspect.ismethod(target):
            return target(node)
        if inspect.isfunction(target):
            return self.invoke(target, None, node)
        if inspect.isclass(target):
            if issubclass(target, tuple):
                return self._record(target, node)
            raise self.refuse(node, f"{target.__name__}(...) here", "`self.name = Class(...)` in `__init__`")
        name = target if isinstance(target, str) else getattr(target, "__name__", "?")
        is_unknown = isinstance(target, str) and name != "round"
        return self._no_call(node, name) if is_unknown else self._math(node, name)

    def _no_call(self, node: ast.Call, name: str) -> CExpression:
        is_sum = name in ("sum", "fsum", "hypot", "pow")
        # C cannot reproduce the rounding of these functions.
        expected = "a loop or a product" if is_sum else "a function with source code"
        functions = ", ".join([*MATH_DOMAIN_ERRORS, *FLOAT_TESTS])
        raise self.refuse(node, f"{name}(...)", f"{expected}, or a function of the module math ({functions})")

    def builtin_abs(self, node: ast.Call) -> CExpression:
        (value,) = self.operands(node.args, self.number)
        if value.type.kind == "int":
            text = self.simple(value, "value").text
            return CExpression(f"{text} < 0 ? -{text} : {text}", INT, CONDITIONAL, value.reads, sign=">= 0")
        sign = "> 0" if value.sign and implies_sign(value.sign, "not 0") else ">= 0"
        return value._replace(text=f"fabs({value.text})", rank=ATOM, sign=sign, type=FLOAT, constant=None)

    def builtin_max(self, node: ast.Call, mark: str = ">") -> CExpression:
        values = [self.simple(value, "value") for value in self.operands(node.args, self.number)]
        extreme, signs = values[0], {value.sign for value in values}
        if len(values) < 2 or len({value.type.kind for value in values}) > 1:
            raise self.refuse(node, f"{ast.unparse(node)}", "two or more numbers of one type")
        for value in values[1:]:
            # With this order of the operands, NaN has the same result as in Python.
            extreme = self.simple(extreme, "extreme") if extreme.rank == CONDITIONAL else extreme
            text = f"{value.at(SUM)} {mark} {extreme.at(SUM)} ? {value.text} : {extreme.text}"
            extreme = CExpression(
                text, extreme.type._replace(sign=""), CONDITIONAL, extreme.reads | value.reads
            )
        largest = next((sign for sign in ("> 0", ">= 0") if sign in signs), "")
        return extreme._replace(sign=largest if mark == ">" else common([value.sign for value in values]))

    def builtin_min(self, node: ast.Call) -> CExpression:
        return self.builtin_max(node, "<")

    def builtin_float(self, node: ast.Call) -> CExpression:
        return as_float(self.number(node.args[0]))

    def builtin_bool(self, node: ast.Call) -> CExpression:
        return self.truth(node.args[0])

    def builtin_list(self, node: ast.Call) -> CExpression:
        return self.array(node.args[0], None)

    def builtin_len(self, node: ast.Call) -> CExpression:
        value = self.expression(node.args[0])
        if value.type.kind != "list":
            raise self.refuse(node, f"len of a {value.type.kind}", "len of a list")
        length = value.type.length
        return CExpression(value.length, INT, sign=">= 0") if length is None else self.program.literal(length)

    def builtin_int(self, node: ast.Call, form: str = "{}") -> CExpression:
        """Lower a conversion to int; the C code fails for values that are not finite or exceed 2^53."""
        value = self.number(node.args[0])
        if value.type.kind == "int" or len(node.args) > 1:
            return value if len(node.args) == 1 else self._no_call(node, "round to digits")
        text = value.at(UNARY) if form == "{}" else form.format(value.text)
        if not (value.span and max(map(abs, value.span)) < MAX_SQUARABLE_INT):
            text = self.temporary(value._replace(text=text, rank=ATOM), "whole").text
            self.fail_if(
                f"!(fabs({text}) <= {MAX_INT64_DOUBLE})", node, "a float to int conversion that may fail"
            )
        return CExpression(
            f"(int64_t){text}", INT, UNARY, sign=">= 0" if value.sign in ("> 0", ">= 0") else ""
        )

    def builtin_round(self, node: ast.Call) -> CExpression:
        return self.builtin_int(node, INT_CONVERSIONS["round"])

    def _math(self, node: ast.Call, name: str) -> CExpression:
        if name in INT_CONVERSIONS:
            return self.builtin_int(node, INT_CONVERSIONS[name])
        if (name not in MATH_DOMAIN_ERRORS and name not in FLOAT_TESTS) or node.keywords:
            return self._no_call(node, name)
        values = [as_float(operand) for operand in self.operands(node.args, self.number)]
        reads: Locations = frozenset().union(*(operand.reads for operand in values))
        if name in FLOAT_TESTS:
            return CExpression(f"{name}({values[0].text})", BOOL, reads=reads)
        test, sign = MATH_DOMAIN_ERRORS[name], values[0].sign if name in ("sqrt", "log", "fabs") else ""
        if (name == "sqrt" and sign in ("> 0", ">= 0")) or (name == "log" and sign == "> 0"):
            test = ""
        values = [self.simple(operand, "operand") for operand in values] if test else values
        text = f"{name}({', '.join(operand.text for operand in values)})"
        positive = {"sqrt": "> 0" if sign == "> 0" else ">= 0", "fabs": ">= 0", "exp": ">= 0"}.get(name, "")
        value = CExpression(text, FLOAT, reads=reads, sign=positive)
        if test:
            value = self.temporary(value, f"{name}_value") if "{r}" in test else value
            condition = test.format(*(operand.text for operand in values), r=value.text)
            self.fail_if(condition, node, f"{name} that may raise")
        return value

    def _arguments(self, function: Callable[..., Any], node: ast.Call) -> dict[str, Any]:
        """Return the arguments of a call by parameter name, as syntax trees or default values."""
        parameters = {k: p for k, p in inspect.signature(function).parameters.items() if k != "self"}
        arguments: dict[str, Any] = dict(zip(parameters, node.args, strict=False))
        arguments |= {str(keyword.arg): keyword.value for keyword in node.keywords}
        defaults = {k: p.default for k, p in parameters.items() if p.default is not p.empty}
        arguments |= {k: default for k, default in defaults.items() if k not in arguments}
        if len(node.args) > len(parameters) or {*parameters} != {*arguments}:
            raise self.refuse(node, "these arguments", "one argument for each parameter")
        return arguments

    def _lowered(self, arguments: dict[str, Any], node: ast.AST) -> dict[str, CExpression]:
        nodes = [argument for argument in arguments.values() if isinstance(argument, ast.expr)]
        lowered, literal = iter(self.operands(nodes)), self.program.literal
        return {k: next(lowered) if isinstance(v, ast.expr) else literal(v) for k, v in arguments.items()}

    def invoke(
        self, function: Callable[..., Any], receiver: CExpression | None, node: ast.Call
    ) -> CExpression:
        """Lower a call of a function with source code, or of a method of `receiver`."""
        owner = receiver.type.of if receiver else None
        types_ = self.program.parameters(function, owner)
        arguments = self._arguments(function, node)
        values = self._lowered({k: v for k, v in arguments.items() if types_[k].kind != "text"}, node)
        for name, value in values.items():
            types_[name] = self._argument(node, name, types_[name], value)
        called = self.program.function(function, owner, types_, self)
        texts = [self.pointer(receiver), *receiver.samples] if receiver else []
        texts += [self.program.stored(called.parameters[name], values[name]) for name in called.parameters]
        writes = called.writes | {key for name in called.changes for key in values[name].reads}
        self.note(writes)
        self.replace(node, called.replaced)
        for name in [name for name in called.parameters if values[name].type.kind in ("list", "object")]:
            if values[name].reads & called.replaced:
                found = f"{name} as an argument of {called.node.name}, which replaces it"
                raise self.refuse(node, found, "a copy, `list(...)`")
        for name in called.changes:
            self.changed(values[name], True)
        for name in called.retained:
            self.share(node, called.retained[name], values[name])
        returns, array = called.returns, ""
        if returns.kind == "list":
            array = self.fresh(self.hint_of(node))
            self.emit(f"{self.program.declaration(returns, array)};")
        texts += [array] * bool(array) + [self.function.error] * called.fails
        self.function.reason = self.function.reason or called.reason
        self.function.fails = self.function.fails or called.fails
        text = f"{called.name}({', '.join(texts)})"
        reads = called.reads | (receiver.reads if receiver else frozenset())
        if not array:
            return CExpression(
                text, returns._replace(sign=""), ATOM, reads, writes, called.fails, returns.sign
            )
        self.emit(f"{text};")
        self.check(CExpression("", returns, fails=called.fails))
        return CExpression(array, returns, reads=frozenset({("local", array)}))

    def _argument(self, node: ast.AST, name: str, required: ValueType, value: CExpression) -> ValueType:
        """Return the type of a parameter for one call. Raise SubsetError if the argument does not fit."""
        if required.kind == value.type.kind == "list" and required.length in (None, value.type.length):
            return value.type
        self.fit(node, required, value, f"for {name}")
        return required

    def pointer(self, value: CExpression) -> str:
        """Return the C code of a pointer to an object."""
        return value.text if value.is_pointer else f"&{value.text}"

    def _record(self, target: Any, node: ast.Call) -> CExpression:
        """Lower the construction of a NamedTuple to a local C constant."""
        values, record = self._lowered(self._arguments(target, node), node), ValueType("record", target)
        required = {name: self.program.field_type(self, record, name, node) for name in target._fields}
        texts = [self.program.stored(t, values[name]) for name, t in required.items() if t.kind != "text"]
        name = self.fresh("record")
        self.emit(f"const {self.program.c_type(record)} {name} = {{{', '.join(texts)}}};")
        return CExpression(name, record)

    def construct(self, target: CExpression, class_: type, node: ast.Call) -> None:
        """Lower `self.name = Class(...)` to a call that initialises the member struct `name`."""
        init = inspect.getattr_static(class_, "__init__", None)
        if inspect.isfunction(init):
            value = self.invoke(init, target._replace(samples=()), node)
            head, comma, tail = value.text.partition(", ")
            samples = self.program.capacities(self, class_, target, node)
            self.emit(f"{', '.join([head, *samples])}{comma}{tail};")
            self.check(value)
