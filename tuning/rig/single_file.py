"""The runtime as one source file, with the exported law and what it imports, and no other.

What the package's `__init__` offers in `__all__`, the law, and what their relative imports lead to: each
module's text follows those that it imports, comments and all. Imports from outside come first, once each.
Where two modules use one name for different things, the later module's is renamed, wherever it is
not a local one that is meant; the text so edited must parse to what renaming in the syntax tree gives.
"""

import ast
import importlib
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import jaxhil.runtime
from tuning.rig.names import edited, names_bound, renamed

OUTSIDE = {*sys.stdlib_module_names, "numpy"}


class External(NamedTuple):
    """What an import from outside the package binds: a module, or with `name` a thing in it."""

    module: str
    name: str | None


class Internal(NamedTuple):
    """A name of another module of the package; with `name` None the module itself."""

    module: str
    name: str | None


class Source(NamedTuple):
    """A module of the package: its text and tree, the statements to keep, what its imports bind."""

    name: str
    text: str
    tree: ast.Module
    kept: tuple[ast.stmt, ...]
    imports: dict[str, External | Internal]


def runtime_source(compensator: str, package: ModuleType = jaxhil.runtime) -> str:
    """The text of `jaxhil_runtime.py` for one compensator: all that `package` offers, but for other laws.

    Raises KeyError for a compensator that the runtime does not know, ValueError for a package that cannot be
    put into one file: an import that is relative within a function, circular, or neither of the standard
    library nor of NumPy.
    """
    laws = importlib.import_module(f"{package.__name__}.registry").COMPENSATORS
    law = laws[compensator].__module__.rpartition(".")[2]
    left_out = {one.__module__.rpartition(".")[2] for one in laws.values()} - {law}
    folder = Path(str(package.__file__)).parent
    offered = read_source(folder / "__init__.py", package.__name__)
    public = {name: origin for name in _public(offered) if (origin := _origin(offered, name))}
    wanted = [law, *(module for module, _ in public.values() if module not in left_out)]
    sources = _in_order(folder, package.__name__, wanted)
    there = {source.name for source in sources}
    public = {name: origin for name, origin in public.items() if origin[0] in there}
    bodies, external = _joined(sources, public)
    numpy = any(origin.module.partition(".")[0] == "numpy" for origin in external.values())
    needed = "NumPy beside it" if numpy else "nothing else to install"
    lines = [
        f'"""The controller for the rig, compensator {compensator}: its whole source in this one file.',
        "",
        f"Made of the package's modules by `jaxhil export`; Python 3.11 or later, {needed}.",
        "",
        "    controller = Controller.from_file('gains.json')",
        '"""',
        "",
        *_import_lines(external),
        *bodies,
        "",
        "__all__ = [" + ", ".join(f'"{name}"' for name in public) + "]",
    ]
    text = "\n".join(lines) + "\n"
    try:
        compile(text, "jaxhil_runtime.py", "exec")
    except SyntaxError as error:
        raise ValueError(f"the runtime in one file does not compile: {error}") from None
    return text


def read_source(path: Path, package: str) -> Source:
    """A module of the package, its docstring, imports and `__all__` told apart from what it does."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text, str(path))
    imports: dict[str, External | Internal] = {}
    kept = []
    for number, statement in enumerate(tree.body):
        if isinstance(statement, (ast.Import, ast.ImportFrom)):
            imports.update(_bound(statement, package, path))
        elif not (number == 0 and _is_docstring(statement)) and not _assigns(statement, "__all__"):
            kept.append(statement)
    for statement in kept:
        for node in ast.walk(statement):
            if isinstance(node, (ast.Import, ast.ImportFrom)) and _is_inside(node, package):
                raise ValueError(f"{path.name}, line {node.lineno}: an import of the package within a block")
    return Source(path.stem, text, tree, tuple(kept), imports)


def _bound(
    statement: ast.Import | ast.ImportFrom, package: str, path: Path
) -> Iterator[tuple[str, External | Internal]]:
    """The names that an import binds, and to what."""
    inside = _is_inside(statement, package)
    where = f"{path.name}, line {statement.lineno}"
    if isinstance(statement, ast.Import):
        for alias in statement.names:
            if inside or (alias.name.partition(".")[0] not in OUTSIDE):
                raise ValueError(
                    f"{where}: imports {alias.name}, allowed the standard library, NumPy, or `from`"
                )
            if alias.asname is None:
                yield alias.name.partition(".")[0], External(alias.name, None)
            else:
                yield alias.asname, External(alias.name, None)
        return
    module = statement.module or ""
    if inside and not statement.level:
        module = module.removeprefix(package).lstrip(".")
    for alias in statement.names:
        name = alias.asname or alias.name
        if inside:
            yield name, Internal(module, alias.name) if module else Internal(alias.name, None)
        elif module.partition(".")[0] in OUTSIDE:
            yield name, External(module, alias.name)
        else:
            raise ValueError(f"{where}: imports {module}, allowed the standard library and NumPy")


def _is_inside(statement: ast.Import | ast.ImportFrom, package: str) -> bool:
    if isinstance(statement, ast.ImportFrom):
        return statement.level > 0 or (statement.module or "").startswith(package)
    return any(alias.name.startswith(package) for alias in statement.names)


def _in_order(folder: Path, package: str, wanted: Iterable[str]) -> list[Source]:
    """The modules wanted and what they import, directly or not, each after those that it imports itself."""
    ordered: dict[str, Source] = {}
    begun: list[str] = []

    def visit(name: str) -> None:
        if name in ordered:
            return
        if name in begun:
            raise ValueError(f"{package}: modules that import each other: {' -> '.join([*begun, name])}")
        begun.append(name)
        source = read_source(folder / f"{name}.py", package)
        for needed in _needed(source):
            visit(needed)
        begun.pop()
        ordered[name] = source

    for name in wanted:
        visit(name)
    return list(ordered.values())


def _needed(source: Source) -> list[str]:
    return list(dict.fromkeys(one.module for one in source.imports.values() if isinstance(one, Internal)))


def _joined(
    sources: list[Source], public: Mapping[str, tuple[str, str]]
) -> tuple[list[str], dict[str, External]]:
    """The modules' texts under names that do not clash, and what they import from outside, by final name.

    What is `public` keeps its name.
    """
    taken: dict[str, External | tuple[str, str]] = dict(public)
    final = {origin: name for name, origin in public.items()}  # of each module's own names
    external: dict[str, External] = {}
    bodies = []
    own_names = {source.name: names_bound(source.kept) for source in sources}
    for source in sources:
        for name in own_names[source.name]:
            if (source.name, name) not in final:
                final[source.name, name] = _free(name, source.name, (source.name, name), taken)
    for source in sources:
        names: dict[str, str] = {}
        modules: dict[str, Mapping[str, str]] = {}
        for name, origin in source.imports.items():
            if isinstance(origin, External):
                names[name] = _free(name, source.name, origin, taken)
                external[names[name]] = origin
            elif origin.name is None:
                owned = own_names[origin.module]
                modules[name] = {inner: final[origin.module, inner] for inner in owned}
            else:
                names[name] = final[origin.module, origin.name]
        names.update({name: final[source.name, name] for name in own_names[source.name]})
        changed = {name: new for name, new in names.items() if name != new}
        bodies += ["", "", *_heading(source), _text_of(source, changed, modules)]
    return bodies, external


def _free(name: str, module: str, meaning: External | tuple[str, str], taken: dict) -> str:
    """`name`, or where it already means something else a name that says which module it is from."""
    candidate = name
    while taken.setdefault(candidate, meaning) != meaning:
        candidate = f"{candidate}_{module}"
    return candidate


def _text_of(source: Source, changed: Mapping[str, str], modules: Mapping[str, Mapping[str, str]]) -> str:
    """The module's text without docstring, imports and `__all__`, its names replaced."""
    dropped = [statement for statement in source.tree.body if statement not in source.kept]
    text = edited(source.text, source.tree, dropped, changed, modules)
    expected = ast.Module([renamed(one, changed, modules) for one in source.kept], [])
    if ast.dump(ast.parse(text)) != ast.dump(expected):
        raise ValueError(f"{source.name}.py: its names cannot be replaced in its text")
    return re.sub(r"\n{4,}", "\n\n\n", text).strip("\n")


def _heading(source: Source) -> Iterator[str]:
    """The module's docstring as a comment."""
    yield f"# ---- {source.name} " + "-" * (100 - len(source.name))
    for line in (ast.get_docstring(source.tree) or "").splitlines():
        yield f"# {line}".rstrip()
    yield ""


def _import_lines(external: Mapping[str, External]) -> Iterator[str]:
    """Plain imports, then `from` imports, in the order of the alphabet; NumPy's last."""
    plain, named = set(), {}
    for name, origin in external.items():
        if origin.module == "__future__":
            continue
        if origin.name is None:
            direct = origin.module.partition(".")[0] == name
            plain.add(f"import {origin.module}" + ("" if direct else f" as {name}"))
        else:
            text = origin.name + ("" if origin.name == name else f" as {name}")
            named.setdefault(origin.module, set()).add(text)
    lines = [
        *sorted(plain),
        *(f"from {module} import {', '.join(sorted(named[module]))}" for module in sorted(named)),
    ]
    future = sorted(origin.name or "" for origin in external.values() if origin.module == "__future__")
    if future:
        yield f"from __future__ import {', '.join(future)}"
        yield ""
    yield from (line for line in lines if "numpy" not in line.split()[1])
    outside = [line for line in lines if "numpy" in line.split()[1]]
    if outside:
        yield from ("", *outside)


def _public(offered: Source) -> list[str]:
    for statement in offered.tree.body:
        if _assigns(statement, "__all__") and isinstance(statement, ast.Assign):
            return list(ast.literal_eval(statement.value))
    raise ValueError("the runtime's __init__ says nothing in __all__")


def _origin(offered: Source, name: str) -> tuple[str, str] | None:
    """Module and name there of what is offered as `name`; None for a module."""
    origin = offered.imports.get(name)
    if not isinstance(origin, Internal) or origin.name is None:
        return None
    return origin.module, origin.name


def _is_docstring(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _assigns(statement: ast.stmt, name: str) -> bool:
    return isinstance(statement, ast.Assign) and any(
        isinstance(target, ast.Name) and target.id == name for target in statement.targets
    )
