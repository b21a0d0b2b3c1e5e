"""Lowering of classes to C structs: names, attributes and their types, lists of run-time length."""

import ast
import inspect
import re
import typing
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from .printing import format_comment, indent_lines
from .python_source import find_definition
from .subset import C_RESERVED_WORDS, FLOAT, INT, CExpression, SubsetError, ValueType, type_of_annotation

if TYPE_CHECKING:
    from .lowering import Lowering


class StructLowering:
    """Lowering of classes to the structs of a C program."""

    literal: Callable[[Any], CExpression]

    def __init__(self, prefix: str, names: Mapping[type, str], bindings: Mapping[type, type]) -> None:
        self.prefix, self.names, self.bindings = prefix, names, bindings
        self.fields: dict[type, dict[str, ValueType]] = {}
        self.samples: dict[type, list[str]] = {}  # attributes that are lists of run-time length, by class
        self.owned: dict[type, dict[str, str]] = {}  # arrays of samples by owning class, with their keys
        self.changed_in_place: frozenset[Any] = frozenset()  # locations of lists that change in place
        self.shared: list[tuple[frozenset[Any], SubsetError]] = []  # locations of one list, and the error
        self.enumerators: Mapping[str, int] = {}

    def class_name(self, class_: type) -> str:
        """Return the C name of a class."""
        snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", class_.__name__).lower()
        return self.prefix + self.names.get(class_, snake)

    def c_type(self, type_: ValueType) -> str:
        """Return the C type of a value, without the brackets of an array."""
        simple = {"float": "double", "int": type_.c_int, "bool": "bool", "none": "void", "list": "void"}
        if type_.kind == "struct":
            return f"{self.prefix}{type_.of}"
        return simple[type_.kind] if type_.kind in simple else self.class_name(type_.of)

    def declaration(self, type_: ValueType, name: str) -> str:
        """Return the C declaration of a name, without the semicolon."""
        while type_.kind == "list":
            name, type_ = f"{name}[{type_.length}]", type_.of
        return f"{self.c_type(type_)} {name}"

    def local(self, name: str) -> str:
        """Return the C name of a local variable."""
        return f"{name}_" if name in C_RESERVED_WORDS else name

    def class_of(self, function: Any, node: ast.expr) -> type | None:
        """Return the class whose constructor an expression calls; None if it calls no constructor."""
        called = node.func if isinstance(node, ast.Call) else None
        value = function.namespace.get(called.id) if isinstance(called, ast.Name) else None
        is_class = inspect.isclass(value) and not issubclass(value, tuple) and value.__module__ != "builtins"
        return value if is_class else None

    def field(self, body: "Lowering", value: CExpression, name: str, node: ast.AST) -> CExpression:
        """Return the C expression for an attribute of an object."""
        class_, plain = value.type.of, name.lstrip("_")
        keys = frozenset({(class_, name)})
        body.function.reads |= keys
        if name in self.samples.get(class_, ()):
            text = value.samples[self.samples[class_].index(name)]
            return CExpression(
                text, ValueType("list", FLOAT), reads=keys, length=self._access(value, f"{plain}_length")
            )
        type_ = self.fields.get(class_, {}).get(name)
        if type_ is None and (constant := self._class_constant(class_, name)) is not None:
            return constant
        type_ = type_ or self.field_type(body, value.type, name, node)
        parts = self.samples_in(type_.of) if type_.kind == "object" else ()
        samples = tuple(self._access(value, f"{plain}_{part}") for part in parts)
        text = self._access(value, self._field_name(class_, name))
        return CExpression(text, type_, reads=value.reads | keys, sign=type_.sign, samples=samples)

    def _access(self, value: CExpression, name: str) -> str:
        return f"{value.text}->{name}" if value.is_pointer else f"{value.text}.{name}"

    def _field_name(self, class_: type, name: str) -> str:
        plain = name.lstrip("_")
        taken = {*self.fields.get(class_, {}), *getattr(class_, "__slots__", ())}
        return self.local(plain if plain == name or plain not in taken else f"{plain}_")

    def _class_constant(self, class_: type, name: str) -> CExpression | None:
        """Return a class attribute as a constant; None if it is not a number, or if a method assigns it."""
        static = inspect.getattr_static(class_, name, None)
        if not isinstance(static, (bool, int, float)):
            return None
        owners = [owner for owner in class_.__mro__ if owner.__module__ not in ("builtins", "typing")]
        methods = [value for owner in owners for value in vars(owner).values() if inspect.isfunction(value)]
        nodes = [node for method in methods for node in ast.walk(find_definition(method)[0])]
        attributes = [node for node in nodes if isinstance(node, ast.Attribute) and node.attr == name]
        if any(isinstance(node.ctx, ast.Store) for node in attributes):
            return None
        try:
            source = inspect.getsource(next(owner for owner in owners if name in vars(owner)))
        except (OSError, TypeError):
            source = ""
        named = re.search(rf"^    {name}\b.*= ([A-Z_]+)$", source, re.MULTILINE)
        if named and self.enumerators.get(named[1]) == static:
            return CExpression(f"{self.prefix}{named[1]}".upper(), INT, constant=static)
        return self.literal(static)

    def field_type(self, body: "Lowering", type_: ValueType, name: str, node: ast.AST) -> ValueType:
        """Return the type of an attribute from its annotation. Raise SubsetError if it has no annotation."""
        hints = typing.get_type_hints(type_.of, include_extras=True)
        hinted = type_of_annotation(hints.get(name, ...), self.bindings)
        if hinted is None:
            found = f"{name} of {type_.of.__name__}, which has no known type"
            raise body.refuse(node, found, "an assignment in `__init__`, or an annotation in the class")
        fields = self.fields.setdefault(type_.of, {})
        # A record has all its fields, in order, because its initialisers name none.
        for other in getattr(type_.of, "_fields", ()):
            fields.setdefault(other, type_of_annotation(hints[other], self.bindings) or hinted)
        return fields.setdefault(name, hinted)

    def known_field(self, body: "Lowering", owner: CExpression, target: ast.Attribute) -> CExpression | None:
        """Return the C expression for an attribute; None if the type of the attribute is not yet known."""
        class_, name = owner.type.of, target.attr
        if owner.type.kind != "object":
            raise body.refuse(target, f"an attribute of a {owner.type.kind}", "an object")
        fields = {*self.samples.get(class_, ()), *self.fields.get(class_, {}), *typing.get_type_hints(class_)}
        return self.field(body, owner, name, target) if name in fields else None

    def new_field(
        self, body: "Lowering", owner: CExpression, target: ast.Attribute, type_: ValueType
    ) -> CExpression:
        """Return the C expression for an attribute; if its type is not yet known, record it as `type_`."""
        field = self.known_field(body, owner, target)
        if field is not None:
            return field
        plain = type_._replace(sign="", is_index=False, c_int="int64_t")
        self.fields.setdefault(owner.type.of, {})[target.attr] = plain
        return self.field(body, owner, target.attr, target)

    def new_samples(
        self, body: "Lowering", owner: CExpression, target: ast.Attribute, count: CExpression
    ) -> None:
        """Record an attribute that is a list of run-time length; emit a test of its length."""
        class_, name, plain = owner.type.of, target.attr, target.attr.lstrip("_")
        if body.function.node.name != "__init__" or owner.text != "self":
            raise body.refuse(
                target, "a list of computed length", "a list of fixed length, or an assignment in `__init__`"
            )
        if name not in self.samples.setdefault(class_, []):
            self.samples[class_].append(name)
            self.fields.setdefault(class_, {})[f"{plain}_length"] = INT
        body.names["self"] = body.names["self"]._replace(samples=self.samples_in(class_))
        condition = f"{count.text} < 0 || {count.text} > {plain}_capacity"
        body.fail_if(condition, target, "a list longer than its capacity")
        body.emit(f"self->{plain}_length = {count.text};")

    def length_of(self, body: "Lowering", target: str, node: ast.AST) -> str:
        """Return the C code for the length of a list that `new_samples` has recorded."""
        if body.function.owner is None or target not in self.samples_in(body.function.owner):
            raise body.refuse(node, "a list of computed length", "a constant length")
        return f"self->{target}_length"

    def samples_in(self, class_: Any) -> tuple[str, ...]:
        """Return the C parameter names for a class's lists of run-time length."""
        return tuple(name.lstrip("_") for name in self.samples.get(class_, ()))

    def capacities(self, body: "Lowering", class_: type, target: CExpression, node: ast.Call) -> list[str]:
        """Return a constructor's C arguments for its lists of run-time length: arrays and capacities."""
        first, key, arguments = node.args[0] if node.args else None, target.type.key, []
        if isinstance(first, ast.Subscript) and isinstance(first.slice, ast.Constant) and not key:
            key = str(first.slice.value)
        for name in self.samples_in(class_):
            if not key or body.function.owner is None or not target.text.startswith("self->"):
                expected = "`Annotated[DelayLine, 'name of the gain']`"
                raise body.refuse(node, "a delay line of unknown capacity", expected)
            array = f"{target.text}_{name}"
            self.owned.setdefault(body.function.owner, {})[array.removeprefix("self->")] = key
            arguments += [array, f"{self.prefix}{key}_samples".upper()]
        return arguments

    def structs(self, owners: list[type]) -> str:
        """Return the C structs of all classes, ordered so that a struct follows its member structs."""
        texts: dict[type, str] = {}

        def visit(class_: type) -> None:
            lines, name = [], self.class_name(class_)
            for field, type_ in self.fields.get(class_, {}).items():
                if type_.kind in ("object", "record") and type_.of not in texts:
                    visit(type_.of)
                if type_.kind != "text":
                    lines.append(f"{self.declaration(type_, self._field_name(class_, field))};")
            for field, key in self.owned.get(class_, {}).items():
                lines.append(f"double {field}[{self.prefix.upper()}{key.upper()}_SAMPLES];")
            lines = lines or ["char nothing; /* C has no empty structs */"]
            text = indent_lines([f"typedef struct {name} {{", *lines, f"}} {name};"])
            texts[class_] = f"\n{format_comment(inspect.getdoc(class_))}{text}"

        for class_ in dict.fromkeys([*self.fields, *owners]):
            if class_ not in texts:
                visit(class_)
        return "".join(texts.values())
