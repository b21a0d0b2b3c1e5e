"""C program: lowered functions with the structs, constants and helpers that they need."""

import ast
import inspect
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from .printing import C_HELPERS, escape_comment, format_comment, indent_lines
from .python_source import find_annotations, find_definition, find_name_lines, read_constant_comment
from .statements import BodyLowering
from .subset import C_RESERVED_WORDS, FLOAT, INT, Locations, SubsetError, ValueType, type_of_annotation
from .values import CExpression, Rank, constant


class CFunction:
    """C function, lowered (translated) from a Python function for given types of its parameters."""

    def __init__(
        self, function: Callable[..., Any], owner: type | None, types: Mapping[str, ValueType]
    ) -> None:
        self.node, self.file = find_definition(function)
        self.function, self.owner, self.returns = function, owner, types["return"]
        self.namespace = {**function.__globals__, **inspect.getclosurevars(function).nonlocals}
        types = {name: type_ for name, type_ in types.items() if name != "return"}
        self.parameters = {name: type_ for name, type_ in types.items() if type_.kind != "non-number"}
        self.texts = [name for name in types if name not in self.parameters]
        self.occurrences = find_name_lines(self.node)
        names = {node.id for node in ast.walk(self.node) if isinstance(node, ast.Name)} | {*types, "self"}
        self.taken = {f"{name}_" if name in C_RESERVED_WORDS else name for name in names} | C_RESERVED_WORDS
        self.reads: Locations = frozenset()
        self.writes: Locations = frozenset()
        self.changes: set[str] = set()  # parameters of type list that the function changes
        self.retained: dict[str, Locations] = {}  # parameters of type list that an attribute gets
        self.shared: dict[Any, SubsetError] = {}  # errors for local lists that are also attributes
        self.replaced: Locations = frozenset()  # attributes that get a new list or object
        self.fails = False  # whether the function may fail
        self.reason: tuple[str, int, str] | None = None  # file, line and reason of the first test
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


class CProgram:
    """C program with lowered functions, their structs, constants and helpers.

    Args:
        prefix: prefix of all C names.
        structs: minimum values of fields, by struct (such as `jaxhil_gains`) and field.
        names: C names of classes, without the prefix, if they differ from the names in Python.
        public: functions that the header declares, with their C names.
        bindings: classes that replace types in annotations; for example, a compensator replaces its protocol.
        enumerators: constants that the header already defines, by name.
    """

    def __init__(
        self,
        prefix: str,
        structs: Mapping[str, Mapping[str, float]] | None = None,
        names: Mapping[type, str] | None = None,
        public: Mapping[Callable[..., Any], str] | None = None,
        bindings: Mapping[type, type] | None = None,
        enumerators: Mapping[str, int] | None = None,
    ) -> None:
        self.prefix, self.lowest, self.names, self.public = prefix, structs or {}, names or {}, public or {}
        self.bindings, self.enumerators = bindings or {}, enumerators or {}
        self.fields: dict[type, dict[str, ValueType]] = {}  # types of the attributes of each class
        self.changed_in_place: Locations = frozenset()  # locations of lists that change in place
        self.shared: list[
            tuple[Locations, SubsetError]
        ] = []  # locations that refer to one list, and the error if it changes
        self.under_way: list[Any] = []  # keys of the functions that are being lowered
        self.functions: dict[Any, CFunction] = {}
        self.constants: dict[str, tuple[str, str]] = {}  # C code and comment of each constant, by name
        self.helpers: set[str] = set()

    def add(self, function: Callable[..., Any], owner: type | None = None) -> CFunction:
        """Lower a function, or a method of `owner`, with the types of its annotations."""
        return self.function(function, owner, self.parameters(function, owner), None)

    def parameters(self, function: Callable[..., Any], owner: type | None) -> dict[str, ValueType]:
        """Return the types of a function's parameters, and of its result under the key "return"."""
        protocol = next((protocol for protocol, bound in self.bindings.items() if bound is owner), None)
        hints, types = find_annotations(function, protocol), {}
        for name in [*inspect.signature(function).parameters, "return"]:
            type_ = type_of_annotation(hints.get(name, None if name == "return" else ...), self.bindings)
            if name != "self" and type_ is None:
                node, file = find_definition(function)
                found = f"no type in C for {name} of {function.__name__}"
                raise SubsetError(file, node.lineno, found, "an annotation such as float, int or bool")
            types |= {name: type_} if name != "self" else {}
        return types

    def function(
        self, function: Any, owner: type | None, types: Mapping[str, ValueType], caller: Any
    ) -> CFunction:
        """Return the C function of a Python function for the parameter `types`; lower it at first use."""
        key = (function, owner, *((n, t.length, t.of) for n, t in types.items() if t.kind == "list"))
        if key in self.under_way and caller is not None:
            raise caller.reject(caller.function.node, f"{function.__name__} calling itself", "a loop")
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
        try:
            hint = eval(compile(ast.Expression(node), function.file, "eval"), function.namespace)
        except Exception:
            return None
        return type_of_annotation(hint, self.bindings)

    def class_name(self, class_: type) -> str:
        snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", class_.__name__).lower()
        return self.prefix + self.names.get(class_, snake)

    def c_type(self, type_: ValueType) -> str:
        simple = {"float": "double", "int": type_.c_int, "bool": "bool", "none": "void", "list": "void"}
        simple["struct"] = f"{self.prefix}{type_.of}"
        return simple[type_.kind] if type_.kind in simple else self.class_name(type_.of)

    def declaration(self, type_: ValueType, name: str) -> str:
        """Return the C declaration of a name, without the semicolon."""
        while type_.kind == "list":
            name, type_ = f"{name}[{type_.length or type_.capacity}]", type_.of
        return f"{self.c_type(type_)} {name}"

    def local(self, name: str) -> str:
        return f"{name}_" if name in C_RESERVED_WORDS else name

    def class_of(self, function: Any, node: ast.expr) -> type | None:
        """Return the class whose constructor an expression calls; None if it calls no constructor."""
        called = node.func if isinstance(node, ast.Call) else None
        value = function.namespace.get(called.id) if isinstance(called, ast.Name) else None
        is_class = inspect.isclass(value) and not issubclass(value, tuple) and value.__module__ != "builtins"
        return value if is_class else None

    def field_name(self, class_: type, name: str) -> str:
        plain = name.lstrip("_")
        taken = {*self.fields.get(class_, {}), *getattr(class_, "__slots__", ())}
        return self.local(plain if plain == name or plain not in taken else f"{plain}_")

    def named_constant(self, name: str, namespace: dict[str, Any]) -> CExpression:
        """Return the C name of a module's constant as an expression."""
        value, named = namespace[name], f"{self.prefix}{name}".upper()
        result = constant(value)
        if self.enumerators.get(name) == value:
            return result._replace(text=named, rank=Rank.ATOM)
        if isinstance(value, tuple) and value and all(isinstance(element, (int, float)) for element in value):
            type_ = FLOAT if any(isinstance(element, float) for element in value) else INT
            joined = ", ".join(repr(float(element) if type_ is FLOAT else element) for element in value)
            named = f"{self.prefix}{name.lstrip('_')}".lower()
            text = f"static const {self.c_type(type_)} {named}[{len(value)}] = {{{joined}}};"
            result = CExpression(named, ValueType("list", type_, len(value)), constant=value)
        elif not isinstance(value, (int, float)) or not math.isfinite(value):
            return result
        else:
            text, result = result.at(Rank.ATOM), result._replace(text=named, rank=Rank.ATOM)
        if self.constants.get(named, (text, ""))[0] != text:
            return constant(value)  # a different module uses the same name for a different value
        self.constants[named] = (text, read_constant_comment(name, namespace))
        return result

    def helper(self, name: str, *texts: str) -> str:
        self.helpers.add(name)
        return f"{self.prefix}{name}({', '.join(texts)})"

    def capacities(self, owner: Any, class_: type) -> dict[str, int]:
        """Return the capacities (lengths) of `owner`'s lists of run-time length, by name of the constant."""
        result: dict[str, int] = {}
        for name, type_ in self.fields.get(class_, {}).items():
            lengths = {type_.capacity: len(getattr(owner, name))} if type_.capacity else {}
            lengths |= self.capacities(getattr(owner, name, None), type_.of) if type_.kind == "object" else {}
            result |= {key: max(length, result.get(key, 0)) for key, length in lengths.items()}
        return result

    def output(self) -> GeneratedCode:
        """Return the C code of all lowered functions with their structs, constants and helpers."""
        for keys, error in self.shared:
            if self.changed_in_place & keys:
                raise error
        public = [function for function in self.functions.values() if function.function in self.public]
        for function in public:
            if function.reason and function.fails:
                file, line, reason = function.reason
                expected = "an operation that cannot raise, or `try` around it"
                raise SubsetError(file, line, f"{reason} within {function.name}", expected)
        prototypes = (f"\n{format_comment(ast.get_docstring(f.node))}{self._signature(f)};\n" for f in public)
        functions = "".join(map(self._definition, self.functions.values()))
        texts = []
        for name, (value, note) in self.constants.items():
            if re.search(rf"\b{name}\b", functions):
                head = value if value.startswith("static") else f"#define {name} {value}"
                texts.append(f"{head} /* {escape_comment(note)} */\n" if note else f"{head}\n")
        for name in sorted(self.helpers):
            texts.append("\nstatic " + indent_lines(C_HELPERS[name].replace("@", self.prefix).splitlines()))
        return GeneratedCode(self._structs() + "".join(prototypes), "".join(texts) + functions)

    def _structs(self) -> str:
        """Return the C structs of all classes, ordered so that a struct follows its member structs."""
        texts: dict[type, str] = {}

        def visit(class_: type) -> None:
            lines, name = [], self.class_name(class_)
            for field, type_ in self.fields.get(class_, {}).items():
                if type_.kind in ("object", "record") and type_.of not in texts:
                    visit(type_.of)
                if type_.kind != "non-number":
                    lines.append(f"{self.declaration(type_, self.field_name(class_, field))};")
            lines = lines or ["char nothing; /* C has no empty structs */"]
            text = indent_lines([f"typedef struct {name} {{", *lines, f"}} {name};"])
            texts[class_] = f"\n{format_comment(inspect.getdoc(class_))}{text}"

        owners = [function.owner for function in self.functions.values() if function.owner]
        for class_ in dict.fromkeys([*self.fields, *owners]):
            if class_ not in texts:
                visit(class_)
        return "".join(texts.values())

    def _signature(self, function: CFunction) -> str:
        const, parts = "" if function.writes else "const ", []
        if function.owner:
            parts.append(f"{const}{self.class_name(function.owner)} *self")
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
        names += map(self.local, function.parameters)
        unused = [f"(void){name};" for name in names if not re.search(rf"\b{name}\b", "\n".join(lines))]
        note = "" if function.function in self.public else format_comment(ast.get_docstring(function.node))
        return f"\n{note}{indent_lines([f'{self._signature(function)} {{', *unused, *lines, '}'])}"
