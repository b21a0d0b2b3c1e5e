"""C program: lowered functions with the structs, constants and helpers that they need."""

import ast
import inspect
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .lowering import Lowering
from .printing import C_HELPERS, escape_comment, format_comment, indent_lines
from .python_source import find_annotations, find_definition, find_name_lines, read_constant_comment
from .records import StructLowering
from .statements import BodyLowering
from .subset import (
    BOOL,
    C_RESERVED_WORDS,
    FLOAT,
    INT,
    TEXT,
    UNARY,
    CExpression,
    Locations,
    SubsetError,
    ValueType,
    as_float,
    refusal,
    sign_of,
    type_of_annotation,
)


class CFunction:
    """C function that is the lowering of a Python function for given types of its parameters."""

    def __init__(
        self, function: Callable[..., Any], owner: type | None, types: Mapping[str, ValueType]
    ) -> None:
        self.node, self.file = find_definition(function)
        self.function, self.owner, self.returns = function, owner, types["return"]
        self.namespace = {**function.__globals__, **inspect.getclosurevars(function).nonlocals}
        types = {name: type_ for name, type_ in types.items() if name != "return"}
        self.parameters = {name: type_ for name, type_ in types.items() if type_.kind != "text"}
        self.texts = [name for name in types if name not in self.parameters]
        self.occurrences = find_name_lines(self.node)
        names = {node.id for node in ast.walk(self.node) if isinstance(node, ast.Name)} | {*types, "self"}
        self.taken = {f"{name}_" if name in C_RESERVED_WORDS else name for name in names} | C_RESERVED_WORDS
        self.reads: Locations = frozenset()
        self.writes: Locations = frozenset()
        self.changes: set[str] = set()  # list parameters that the function changes
        self.retained: dict[str, Locations] = {}  # list parameters that the function assigns to attributes
        self.shared: dict[Any, SubsetError] = {}  # errors for local lists that are also attributes
        self.replaced: Locations = frozenset()  # attributes that get a new list or object
        self.fails, self.reason = False, ""  # whether the function may fail; file, line and reason
        self.name, self.error = "", "error"
        self.lines: list[str] = []


class GeneratedCode(NamedTuple):
    """C code of a program.

    Attributes:
        declarations: structs and prototypes of the public functions, for the header.
        definitions: constants, helpers and functions, for the source file.
    """

    declarations: str
    definitions: str


class CProgram(StructLowering):
    """C program with lowered functions, their structs, constants and helpers.

    Args:
        prefix: prefix of all C names.
        structs: signs of the fields of structs such as `jaxhil_gains`, by struct and field.
        names: C names of classes, without the prefix, if they differ from the names in Python.
        public: functions that the header declares, with their C names.
        bindings: classes that replace types in annotations; for example, a compensator replaces its protocol.
        enumerators: constants that the header already defines, by name.
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
        self.functions: dict[Any, CFunction] = {}
        self.under_way: list[Any] = []
        self.constants: dict[str, tuple[str, str]] = {}  # C code and comment of each constant, by name
        self.helpers: set[str] = set()

    def add(self, function: Callable[..., Any], owner: type | None = None) -> CFunction:
        """Lower a function, or a method of `owner`, with the types of its annotations."""
        return self.function(function, owner, self.parameters(function, owner), None)

    def parameters(self, function: Callable[..., Any], owner: type | None) -> dict[str, ValueType]:
        """Return the types of a function's parameters, and of its result under the key "return"."""
        protocols = [protocol for protocol, bound in self.bindings.items() if bound is owner]
        hints = find_annotations(function, *protocols[:1])
        types = {}
        for name in [*inspect.signature(function).parameters, "return"]:
            type_ = type_of_annotation(hints.get(name, None if name == "return" else ...), self.bindings)
            if type_ is None and name != "self":
                node, file = find_definition(function)
                found = f"no type in C for {name} of {function.__name__}"
                raise refusal(file, node.lineno, found, "an annotation such as float, int or bool")
            if name != "self" and type_ is not None:
                types[name] = type_
        return types

    def function(
        self,
        function: Callable[..., Any],
        owner: type | None,
        types: Mapping[str, ValueType],
        caller: Lowering | None,
    ) -> CFunction:
        """Return the C function for a Python function with parameter types; lower it on the first call."""
        key = (function, owner, *((n, t.length, t.of) for n, t in types.items() if t.kind == "list"))
        if key in self.under_way and caller is not None:
            raise caller.refuse(caller.function.node, f"{function.__name__} calling itself", "a loop")
        if key not in self.functions:
            result = CFunction(function, owner, types)
            self.under_way.append(key)
            result.name = self._name(result)
            result.lines = BodyLowering(self, result).run()
            self.under_way.pop()
            inner = {key for key in result.writes | result.reads if key[0] in ("local", "parameter")}
            result.writes, result.reads = result.writes - inner, result.reads - inner
            if any(type_.kind == "list" and type_.of.kind == "list" for type_ in result.parameters.values()):
                # C does not convert a matrix to a pointer to constant arrays: declare it as changed.
                result.writes |= {("matrix", "")}
            self.functions[key] = result
        return self.functions[key]

    def _name(self, function: CFunction) -> str:
        if function.function in self.public:
            return self.public[function.function]
        name = "init" if function.node.name == "__init__" else function.node.name.strip("_")
        base = f"{self.class_name(function.owner) if function.owner else self.prefix.rstrip('_')}_{name}"
        taken = {existing.name for existing in self.functions.values()} | {*self.public.values()}
        lengths = "_".join(str(t.length) for t in function.parameters.values() if t.kind == "list")
        module = function.function.__module__.rpartition(".")[2]
        alternatives = (f"{base}_{lengths}", f"{self.prefix}{module}_{name}", f"{base}_{len(taken)}")
        return next(text for text in (base, *alternatives) if text not in taken and not text.endswith("_"))

    def local_type(self, function: CFunction, node: ast.expr) -> ValueType | None:
        """Return the type of a local variable's annotation; None if C has no equivalent."""
        try:
            hint = eval(compile(ast.Expression(node), function.file, "eval"), function.namespace)
        except Exception:
            return None
        return type_of_annotation(hint, self.bindings)

    def constant(self, value: Any) -> CExpression | None:
        """Return the C expression for a constant; None if it is not a number, bool, text or sequence."""
        if isinstance(value, (str, tuple, list, frozenset)):
            return CExpression("", TEXT, constant=value)
        if isinstance(value, bool):
            return CExpression("true" if value else "false", BOOL, constant=value)
        if not isinstance(value, (int, float)):
            return None
        special = {math.inf: "INFINITY", -math.inf: "-INFINITY"}
        text = "NAN" if math.isnan(value) else special.get(value, repr(value))
        span = (value, value) if math.isfinite(value) else None
        rank = UNARY if text.startswith("-") else 16
        type_ = INT if isinstance(value, int) else FLOAT
        return CExpression(text, type_, rank, sign=sign_of(value), span=span, constant=value)

    def literal(self, value: Any) -> CExpression:
        """Return the C expression for a constant, with empty code if C has no equivalent."""
        return self.constant(value) or CExpression("", TEXT, constant=value)

    def named_constant(self, name: str, namespace: dict[str, Any]) -> CExpression | None:
        """Return the C name of a module's constant as an expression; None if C has no equivalent."""
        value = namespace[name]
        result, named = self.constant(value), f"{self.prefix}{name}".upper()
        if result is not None and self.enumerators.get(name) == value:
            return result._replace(text=named, rank=16)
        if isinstance(value, tuple) and value and all(isinstance(element, (int, float)) for element in value):
            type_ = FLOAT if any(isinstance(element, float) for element in value) else INT
            joined = ", ".join(repr(float(element) if type_ is FLOAT else element) for element in value)
            named = f"{self.prefix}{name.lstrip('_')}".lower()
            text = f"static const {self.c_type(type_)} {named}[{len(value)}] = {{{joined}}};"
            result = CExpression(named, ValueType("list", type_, len(value)), constant=value)
        elif result is None or not isinstance(value, (int, float)) or not math.isfinite(value):
            return result
        else:
            text, result = result.at(16), result._replace(text=named, rank=16)
        if self.constants.get(named, (text, ""))[0] != text:
            return self.constant(value)  # a different module uses the same name for a different value
        self.constants[named] = (text, read_constant_comment(name, namespace))
        return result

    def helper(self, name: str, *texts: str) -> str:
        """Return the C code for a call of a helper."""
        self.helpers.add(name)
        return f"{self.prefix}{name}({', '.join(texts)})"

    def stored(self, required: ValueType, value: CExpression) -> str:
        """Return the C code for a value that is assigned to a variable or parameter of the required type."""
        if required.kind == "object":
            return value.text if value.is_pointer else f"&{value.text}"
        if required.kind == "float" and value.type.kind == "int":
            return as_float(value).text
        is_cast = required.kind == "int" and required.c_int not in ("int64_t", value.type.c_int)
        return f"({required.c_int}){value.at(UNARY)}" if is_cast and value.constant is None else value.text

    def output(self) -> GeneratedCode:
        """Return the C code of all lowered functions with their structs, constants and helpers."""
        for keys, error in self.shared:
            if self.changed_in_place & keys:
                raise error
        lowered = [*self.functions.values()]
        public = [function for function in lowered if function.function in self.public]
        for function in public:
            if function.fails:
                found = f"{function.reason} within {function.name}"
                raise SubsetError(f"{found}, expected an operation that cannot raise, or `try` around it")
        prototypes = (f"\n{format_comment(ast.get_docstring(f.node))}{self._signature(f)};\n" for f in public)
        structs = self.structs([function.owner for function in lowered if function.owner])
        functions = "".join(self._definition(function) for function in lowered)
        texts = []
        for name, (value, note) in self.constants.items():
            if re.search(rf"\b{name}\b", functions):
                head = value if value.startswith("static") else f"#define {name} {value}"
                texts.append(f"{head} /* {escape_comment(note)} */\n" if note else f"{head}\n")
        for name in sorted(self.helpers):
            texts.append("\nstatic " + indent_lines(C_HELPERS[name].replace("@", self.prefix).splitlines()))
        return GeneratedCode(structs + "".join(prototypes), "".join(texts) + functions)

    def _signature(self, function: CFunction) -> str:
        constant, parts = "" if function.writes else "const ", []
        if function.owner:
            parts.append(f"{constant}{self.class_name(function.owner)} *self")
            for name in self.samples_in(function.owner):
                is_first = function.node.name == "__init__"
                parts += [f"{constant}double *{name}"] + [f"int64_t {name}_capacity"] * is_first
        parts += [self._parameter(function, name, type_) for name, type_ in function.parameters.items()]
        parts += [f"{self.c_type(function.returns.of)} *result"] if function.returns.kind == "list" else []
        parts += ["bool *error"] if function.fails else []
        static = "" if function.function in self.public else "static "
        return f"{static}{self.c_type(function.returns)} {function.name}({', '.join(parts) or 'void'})"

    def _parameter(self, function: CFunction, name: str, type_: ValueType) -> str:
        local = self.local(name)
        if type_.kind == "list" and type_.of.kind == "list":
            return f"{self.c_type(type_.of.of)} (*{local})[{type_.of.length}]"
        if type_.kind == "list":
            return f"{'' if name in function.changes else 'const '}{self.c_type(type_.of)} *{local}"
        if type_.kind in ("optional", "struct"):
            return f"const {'double' if type_.kind == 'optional' else self.c_type(type_)} *{local}"
        return f"{self.c_type(type_)} {'*' if type_.kind == 'object' else ''}{local}"

    def _definition(self, function: CFunction) -> str:
        lines = [line.replace("@const@", "" if function.writes else "const ") for line in function.lines]
        names = ["self"] * bool(function.owner)
        names += [*map(self.local, function.parameters), *self.samples_in(function.owner)]
        unused = [f"(void){name};" for name in names if not re.search(rf"\b{name}\b", "\n".join(lines))]
        note = "" if function.function in self.public else format_comment(ast.get_docstring(function.node))
        return f"\n{note}{indent_lines([f'{self._signature(function)} {{', *unused, *lines, '}'])}"
