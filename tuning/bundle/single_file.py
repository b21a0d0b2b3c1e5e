"""The rig's controller as one source file, with the exported compensator and no other.

It has what `jaxhil.rig` offers in `__all__`, the compensator, and the modules of `jaxhil` that these import.
Each module's text follows those that it imports, comments and all, without its own docstring and imports.
Imports from outside come first, once each. Two modules that bind the same name are refused.
"""

import ast
import importlib
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import jaxhil.rig
from tuning.bundle.foreign_law import module_text

OUTSIDE = {*sys.stdlib_module_names, "numpy"}


class Source(NamedTuple):
    """A module of the package."""

    name: str  # its full name
    text: str  # all of it
    tree: ast.Module  # its syntax tree
    inside: dict[str, str]  # module of the package from which each imported name is
    outside: tuple[str, ...]  # the import lines that it needs from elsewhere
    # the statements that are of no use in one file: docstring, imports, `__all__`
    dropped: tuple[ast.stmt, ...]


def runtime_source(compensator: str, package: ModuleType = jaxhil.rig) -> str:
    """Return the text of `jaxhil_runtime.py`: all that `package` offers, with one compensator.

    Raise KeyError for a compensator that the rig does not know, and ValueError for modules that cannot be put
    into one file: an import within a function, circular, relative, renamed, or of another package than this,
    the standard library and NumPy; a name that two modules bind.
    """
    root = package.__name__.partition(".")[0]
    class_ = importlib.import_module(f"{package.__name__}.registry").COMPENSATORS[compensator]
    law, own = class_.__module__, {}
    if law.partition(".")[0] != root:
        own[law] = source_of(module_text(class_, compensator), law, f"{compensator}.py", root)
    offered = read_source(f"{package.__name__}.__init__")
    sources = _in_order([law, *_offering(offered)], own)
    _check_unique(sources)
    public = [name for name in _public(offered) if name in offered.inside]
    imports = {line for source in sources for line in source.outside}
    needed = "NumPy beside it" if any("numpy" in line for line in imports) else "nothing else to install"
    lines = [
        f'"""The controller for the rig, compensator {compensator}: its whole source in this one file.',
        "",
        f"Made of the package's modules by `jaxhil export`; Python 3.11 or later, {needed}.",
        "",
        "    controller = Controller.from_file('gains.json')",
        '"""',
        "",
        *sorted(imports, key=lambda line: ("numpy" in line, line.startswith("from"), line)),
        *(line for source in sources for line in _section(source)),
        "",
        "",
        "__all__ = [" + ", ".join(f'"{name}"' for name in public) + "]",
    ]
    text = "\n".join(lines) + "\n"
    try:
        compile(text, "jaxhil_runtime.py", "exec")
    except SyntaxError as error:
        raise ValueError(f"the runtime in one file does not compile: {error}") from None
    return text


def read_source(name: str) -> Source:
    """Return a module by its full name, its docstring, imports and `__all__` apart from what it does."""
    root, _, below = name.partition(".")
    path = Path(str(sys.modules[root].__file__)).parent / f"{below.replace('.', '/')}.py"
    if not path.is_file():
        raise ValueError(f"{name}: found no module's file, expected imports of names from modules")
    return source_of(path.read_text(encoding="utf-8"), name, path.name, root)


def source_of(text: str, name: str, file: str, root: str) -> Source:
    """Return the same of a module's text, of which imports from the package `root` are inside."""
    tree = ast.parse(text, file)
    inside: dict[str, str] = {}
    outside: list[str] = []
    dropped = [one for one in tree.body if _assigns(one, "__all__")]
    dropped += tree.body[:1] if ast.get_docstring(tree) is not None else []
    for node in ast.walk(tree):
        if not isinstance(node, (ast.Import, ast.ImportFrom)):
            continue
        where = f"{file}, line {node.lineno}"
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{root}."):
            if node not in tree.body:
                raise ValueError(f"{where}: an import of the package within a block")
            inside.update(_from_inside(node, where))
        elif node in tree.body:
            outside.extend(_from_outside(node, where))
        if node in tree.body:
            dropped.append(node)
    return Source(name, text, tree, inside, tuple(outside), tuple(dropped))


def _from_inside(node: ast.ImportFrom, where: str) -> Iterator[tuple[str, str]]:
    """Yield each name that an import of the package binds, and the module that it is from."""
    for alias in node.names:
        if alias.asname is not None:
            raise ValueError(f"{where}: imports {alias.name} under another name, allowed its own")
        yield alias.name, str(node.module)


def _from_outside(node: ast.Import | ast.ImportFrom, where: str) -> Iterator[str]:
    """One import line for each name."""
    for alias in node.names:
        module = node.module or "" if isinstance(node, ast.ImportFrom) else alias.name
        if isinstance(node, ast.ImportFrom) and node.level:
            raise ValueError(f"{where}: a relative import, allowed imports by a module's full name")
        if module.partition(".")[0] not in OUTSIDE:
            raise ValueError(f"{where}: imports {module}, allowed the standard library and NumPy")
        named = f"import {alias.name}" + (f" as {alias.asname}" if alias.asname else "")
        yield f"from {module} {named}" if isinstance(node, ast.ImportFrom) else named


def _in_order(wanted: Iterable[str], own: dict[str, Source]) -> list[Source]:
    """Return the modules wanted and all that they import, each after its own imports.

    The `own` sources are not read from files.
    """
    ordered: dict[str, Source] = {}

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise ValueError(f"modules that import each other: {' -> '.join([*above, name])}")
        if name in ordered:
            return
        source = own.get(name) or read_source(name)
        for needed in dict.fromkeys(source.inside.values()):
            visit(needed, (*above, name))
        ordered[name] = source

    for name in wanted:
        visit(name, ())
    return list(ordered.values())


def _check_unique(sources: Iterable[Source]) -> None:
    """Raises ValueError where two modules bind one name, or one name means two things from outside."""
    owners: dict[str, str] = {}
    for source in sources:
        bound = {name: source.name for one in source.tree.body for name in _bound_by(one)}
        for line in source.outside:
            bound[re.split(r"[ .]", line.rpartition(" as ")[2].rpartition("import ")[2])[0]] = line
        for name, owner in bound.items():
            if owners.setdefault(name, owner) != owner:
                raise ValueError(f"{name}: found in {owners[name]} and in {owner}, allowed once")


def _bound_by(statement: ast.stmt) -> Iterator[str]:
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        yield statement.name
    elif not isinstance(statement, (ast.Import, ast.ImportFrom)) and not _assigns(statement, "__all__"):
        for node in ast.walk(statement):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                yield node.id


def _section(source: Source) -> Iterator[str]:
    """The module's docstring as a comment, then its text without what is dropped."""
    yield from ("", "", f"# ---- {source.name} " + "-" * (100 - len(source.name)))
    for line in (ast.get_docstring(source.tree) or "").splitlines():
        yield f"# {line}".rstrip()
    yield ""
    lines = source.text.splitlines()
    for statement in source.dropped:
        for number in range(statement.lineno - 1, statement.end_lineno or statement.lineno):
            lines[number] = ""
    yield re.sub(r"\n{4,}", "\n\n\n", "\n".join(lines)).strip("\n")


def _public(offered: Source) -> list[str]:
    for statement in offered.tree.body:
        if isinstance(statement, ast.Assign) and _assigns(statement, "__all__"):
            return list(ast.literal_eval(statement.value))
    raise ValueError("the runtime's __init__ says nothing in __all__")


def _offering(offered: Source) -> list[str]:
    return [offered.inside[name] for name in _public(offered) if name in offered.inside]


def _assigns(statement: ast.stmt, name: str) -> bool:
    return isinstance(statement, ast.Assign) and any(
        isinstance(target, ast.Name) and target.id == name for target in statement.targets
    )
