"""Program in C: functions, structs and constants that the lowered functions need, in order."""

import ast
import inspect
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .core import Core
from .printing import HELPERS, comment, indented, plain
from .records import Records
from .source import constant_comment, definition_of, hints_of, places_of
from .statements import Body
from .subset import (
    BOOL,
    FLOAT,
    INT,
    RESERVED,
    TEXT,
    UNARY,
    Keys,
    SubsetError,
    Type,
    Value,
    sign_of,
    type_of_hint,
)


class Function:
    """One function in C, of a Python function with types of its parameters."""

    def __init__(self, function: Callable[..., Any], owner: type | None, types: Mapping[str, Type]) -> None:
        self.node, self.file = definition_of(function)
        self.function, self.owner, self.returns = function, owner, types["return"]
        self.namespace = {**function.__globals__, **inspect.getclosurevars(function).nonlocals}
        self.parameters = {
            name: one for name, one in types.items() if one.kind != "text" and name != "return"
        }
        self.texts = [name for name, one in types.items() if one.kind == "text" and name != "return"]
        self.places = places_of(self.node)
        names = {one.id for one in ast.walk(self.node) if isinstance(one, ast.Name)} | {*types, "self"}
        self.taken = {f"{name}_" if name in RESERVED else name for name in names} | RESERVED
        self.reads: Keys = frozenset()
        self.writes: Keys = frozenset()
        self.changes: set[str] = set()  # parameters whose lists it changes
        self.keeps: dict[str, Keys] = {}  # parameters whose lists it assigns to attributes
        self.shared: dict[Any, SubsetError] = {}  # local lists that an attribute has
        self.fails, self.reason = False, ""  # whether it may fail; file and line of what may
        self.name, self.error = "", "error"
        self.lines: list[str] = []


class Output(NamedTuple):
    """C text of a program."""

    declarations: str  # structs and public prototypes
    definitions: str  # constants, helpers, functions


class Program(Records):
    """Lowered functions with all that they need.

    Args:
        prefix: of all names in C.
        structs: signs of the fields of `jaxhil_gains` and the like, by the struct's name.
        names: names of classes in C where they differ from Python's, without the prefix.
        public: functions that the header declares, and their names in C.
        bindings: class that stands for another one wherever that is the type (a law for its protocol).
        enumerators: constants that the header has already, by name.
    """

    def __init__(
        self,
        prefix: str,
        structs: Mapping[str, Mapping[str, str]] | None = None,
        names: Mapping[type, str] | None = None,
        public: Mapping[Callable[..., Any], str] | None = None,
        bindings: Mapping[type, type] | None = None,
        enumerators: Mapping[str, int] | None = None,
    ) -> None:
        super().__init__(prefix, names or {}, bindings or {})
        self.struct_signs, self.public = structs or {}, public or {}
        self.enumerators = enumerators or {}
        self.functions: dict[Any, Function] = {}
        self.under_way: list[Any] = []
        self.constants: dict[str, tuple[str, str]] = {}  # text and comment, by name
        self.helpers: set[str] = set()

    def add(self, function: Callable[..., Any], owner: type | None = None) -> Function:
        """Lower a function or method with the types of its annotations."""
        return self.function(function, owner, self.parameters(function, owner), None)

    def parameters(self, function: Callable[..., Any], owner: type | None) -> dict[str, Type]:
        """Return the types of a function's parameters, and of what it returns."""
        hints = hints_of(
            function, next((one for one, bound in self.bindings.items() if bound is owner), None)
        )
        found = {}
        for name in [*inspect.signature(function).parameters, "return"]:
            type_ = type_of_hint(hints.get(name, None if name == "return" else ...), self.bindings)
            if type_ is None and name != "self":
                node, file = definition_of(function)
                what = f"no type in C for {name} of {function.__name__}"
                raise SubsetError(
                    f"{file}:{node.lineno}: found {what}, expected an annotation: float, int, bool..."
                )
            if name != "self" and type_ is not None:
                found[name] = type_
        return found

    def function(
        self, function: Callable[..., Any], owner: type | None, types: Mapping[str, Type], caller: Core | None
    ) -> Function:
        """Return the function for these types; lower it if that is the first call."""
        key = (function, owner, *((n, t.length, t.of) for n, t in types.items() if t.kind == "list"))
        if key in self.under_way and caller is not None:
            raise caller.refuse(caller.function.node, f"{function.__name__} calling itself", "a loop")
        if key not in self.functions:
            made = Function(function, owner, types)
            self.under_way.append(key)
            made.name = self._name(made)
            made.lines = Body(self, made).run()
            self.under_way.pop()
            made.writes, made.reads = (
                frozenset(one for one in keys if one[0] not in ("local", "parameter"))
                for keys in (made.writes, made.reads)
            )
            if any(one.kind == "list" and one.of.kind == "list" for one in made.parameters.values()):
                # C has no pointer to constant arrays of arrays that one may pass on.
                made.writes |= {("matrix", "")}
            self.functions[key] = made
        return self.functions[key]

    def _name(self, made: Function) -> str:
        if made.function in self.public:
            return self.public[made.function]
        name = "init" if made.node.name == "__init__" else made.node.name.strip("_")
        base = f"{self.class_name(made.owner) if made.owner else self.prefix.rstrip('_')}_{name}"
        taken = {one.name for one in self.functions.values()} | {*self.public.values()}
        lengths = "_".join(str(one.length) for one in made.parameters.values() if one.kind == "list")
        module = made.function.__module__.rpartition(".")[2]
        others = (f"{base}_{lengths}", f"{self.prefix}{module}_{name}", f"{base}_{len(taken)}")
        return next(one for one in (base, *others) if one not in taken and not one.endswith("_"))

    def local_type(self, function: Function, node: ast.expr) -> Type | None:
        """Return the type of a local annotation."""
        try:
            hint = eval(compile(ast.Expression(node), function.file, "eval"), function.namespace)
        except Exception:
            return None
        return type_of_hint(hint, self.bindings)

    def constant(self, value: Any) -> Value | None:
        """Return a constant, None if it is no number, bool or text."""
        if isinstance(value, (str, tuple, list, frozenset)):
            return Value("", TEXT, constant=value)
        if isinstance(value, bool):
            return Value("true" if value else "false", BOOL, constant=value)
        if not isinstance(value, (int, float)):
            return None
        special = {math.inf: "INFINITY", -math.inf: "-INFINITY"}
        text = "NAN" if math.isnan(value) else special.get(value, repr(value))
        span = (value, value) if math.isfinite(value) else None
        rank = UNARY if text.startswith("-") else 16
        type_ = INT if isinstance(value, int) else FLOAT
        return Value(text, type_, rank, sign=sign_of(value), span=span, constant=value)

    def known(self, value: Any) -> Value:
        """Return a constant that there is."""
        return self.constant(value) or Value("", TEXT, constant=value)

    def named_constant(self, name: str, namespace: dict[str, Any]) -> Value | None:
        """Return a module's constant by its name in C."""
        value = namespace[name]
        found, named = self.constant(value), f"{self.prefix}{name}".upper()
        if found is not None and self.enumerators.get(name) == value:
            return found._replace(text=named, rank=16)
        if isinstance(value, tuple) and value and all(isinstance(one, (int, float)) for one in value):
            type_ = FLOAT if any(isinstance(one, float) for one in value) else INT
            joined = ", ".join(repr(float(one) if type_ is FLOAT else one) for one in value)
            named = f"{self.prefix}{name.lstrip('_')}".lower()
            text = f"static const {self.c_type(type_)} {named}[{len(value)}] = {{{joined}}};"
            found = Value(named, Type("list", type_, len(value)), constant=value)
        elif found is None or not isinstance(value, (int, float)) or not math.isfinite(value):
            return found
        else:
            text, found = found.at(16), found._replace(text=named, rank=16)
        if self.constants.get(named, (text, ""))[0] != text:
            return self.constant(value)  # another module has the name for another value
        self.constants[named] = (text, constant_comment(name, namespace))
        return found

    def helper(self, name: str, *texts: str) -> str:
        """Return the call of a helper."""
        self.helpers.add(name)
        return f"{self.prefix}{name}({', '.join(texts)})"

    def stored(self, wanted: Type, value: Value) -> str:
        """Return the text of a value as it is assigned to, or passed for, a type."""
        if wanted.kind == "object":
            return value.text if value.is_pointer else f"&{value.text}"
        if wanted.kind == "float" and value.type.kind == "int":
            is_literal = value.constant is not None and value.text.lstrip("-").isdigit()
            return f"{value.text}.0" if is_literal else f"(double){value.at(UNARY)}"
        is_cast = wanted.kind == "int" and wanted.c_int not in ("int64_t", value.type.c_int)
        return f"({wanted.c_int}){value.at(UNARY)}" if is_cast and value.constant is None else value.text

    def output(self) -> Output:
        """Return the C text of all that was lowered."""
        for keys, error in self.shared:
            if self.changed_in_place & keys:
                raise error
        made = [*self.functions.values()]
        public = [one for one in made if one.function in self.public]
        for one in public:
            if one.fails:
                raise SubsetError(
                    f"{one.reason} within {one.name}, expected what cannot raise, or try around it"
                )
        prototypes = (f"\n{comment(ast.get_docstring(one.node))}{self._signature(one)};\n" for one in public)
        structs = self.structs([one.owner for one in made if one.owner])
        functions = "".join(self._definition(one) for one in made)
        texts = []
        for name, (value, note) in self.constants.items():
            if re.search(rf"\b{name}\b", functions):
                head = value if value.startswith("static") else f"#define {name} {value}"
                texts.append(f"{head} /* {plain(note)} */\n" if note else f"{head}\n")
        for name in sorted(self.helpers):
            texts.append("\nstatic " + indented(HELPERS[name].replace("@", self.prefix).splitlines()))
        return Output(structs + "".join(prototypes), "".join(texts) + functions)

    def _signature(self, one: Function) -> str:
        constant, parts = "" if one.writes else "const ", []
        if one.owner:
            parts.append(f"{constant}{self.class_name(one.owner)} *self")
            for name in self.samples_in(one.owner):
                is_first = one.node.name == "__init__"
                parts += [f"{constant}double *{name}"] + [f"int64_t {name}_capacity"] * is_first
        parts += [
            self._parameter(one, self.local(name), name, type_) for name, type_ in one.parameters.items()
        ]
        parts += [f"{self.c_type(one.returns.of)} *result"] if one.returns.kind == "list" else []
        parts += ["bool *error"] if one.fails else []
        static = "" if one.function in self.public else "static "
        return f"{static}{self.c_type(one.returns)} {one.name}({', '.join(parts) or 'void'})"

    def _parameter(self, one: Function, local: str, name: str, type_: Type) -> str:
        if type_.kind == "list" and type_.of.kind == "list":
            return f"{self.c_type(type_.of.of)} (*{local})[{type_.of.length}]"
        if type_.kind == "list":
            return f"{'' if name in one.changes else 'const '}{self.c_type(type_.of)} *{local}"
        if type_.kind in ("optional", "struct"):
            return f"const {'double' if type_.kind == 'optional' else self.c_type(type_)} *{local}"
        return f"{self.c_type(type_)} {'*' if type_.kind == 'object' else ''}{local}"

    def _definition(self, one: Function) -> str:
        lines = [line.replace("@const@", "" if one.writes else "const ") for line in one.lines]
        names = [*["self"] * bool(one.owner), *map(self.local, one.parameters), *self.samples_in(one.owner)]
        unused = [f"(void){name};" for name in names if not re.search(rf"\b{name}\b", "\n".join(lines))]
        note = "" if one.function in self.public else comment(ast.get_docstring(one.node))
        return f"\n{note}{indented([f'{self._signature(one)} {{', *unused, *lines, '}'])}"
