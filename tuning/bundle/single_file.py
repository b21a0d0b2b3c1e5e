"""Controller of the rig as one source file, with only the exported compensator.

It contains what `jaxhil.rig` offers in `__all__`, the compensator, and the modules of `jaxhil` that they
import. The text of a module, with comments but without its docstring and imports, follows the modules that it
imports. External imports come first, each once. Two modules that bind the same name raise an error.
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
from tuning.bundle.user_compensator import module_text

EXTERNAL_PACKAGES = {*sys.stdlib_module_names, "numpy"}


class ModuleSource(NamedTuple):
    """Source of a module of the package."""

    name: str  # full name of the module
    text: str  # whole text
    tree: ast.Module  # syntax tree
    inside: dict[str, str]  # module of the package by the name imported from it
    outside: tuple[str, ...]  # import lines for external modules
    # statements that are left out in one file: docstring, imports, `__all__`
    omitted_statements: tuple[ast.stmt, ...]


def build_runtime_source(compensator: str, package: ModuleType = jaxhil.rig) -> str:
    """Return the text of `jaxhil_runtime.py`: all that `package` offers, with one compensator.

    Args:
        compensator: name of the compensator.
        package: package of the runtime.

    Returns:
        Python source.

    Raises:
        KeyError: If the rig does not know the compensator.
        ValueError: If the modules cannot be joined to one file: imports that are within a function, circular,
            relative, renamed, or of packages other than this one, the standard library and NumPy; or a name
            that two modules bind.
    """
    root = package.__name__.partition(".")[0]
    class_ = importlib.import_module(f"{package.__name__}.registry").COMPENSATORS[compensator]
    law, generated = class_.__module__, {}
    if law.partition(".")[0] != root:
        generated[law] = parse_source(module_text(class_, compensator), law, f"{compensator}.py", root)
    offered = read_source(f"{package.__name__}.__init__")
    sources = _sort_by_imports([law, *_public_modules(offered)], generated)
    _check_unique(sources)
    public = [name for name in _public_names(offered) if name in offered.inside]
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
        *(line for source in sources for line in _module_section(source)),
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


def read_source(name: str) -> ModuleSource:
    """Return a module by its full name, with its docstring, imports and `__all__` separated."""
    root, _, below = name.partition(".")
    path = Path(str(sys.modules[root].__file__)).parent / f"{below.replace('.', '/')}.py"
    if not path.is_file():
        raise ValueError(f"{name}: found no module's file, expected imports of names from modules")
    return parse_source(path.read_text(encoding="utf-8"), name, path.name, root)


def parse_source(text: str, name: str, file: str, root: str) -> ModuleSource:
    """Return a module from its text; imports from the package `root` are internal."""
    tree = ast.parse(text, file)
    inside: dict[str, str] = {}
    outside: list[str] = []
    dropped = [statement for statement in tree.body if _assigns(statement, "__all__")]
    dropped += tree.body[:1] if ast.get_docstring(tree) is not None else []
    for node in ast.walk(tree):
        if not isinstance(node, (ast.Import, ast.ImportFrom)):
            continue
        where = f"{file}, line {node.lineno}"
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{root}."):
            if node not in tree.body:
                raise ValueError(f"{where}: an import of the package within a block")
            inside.update(_internal_imports(node, where))
        elif node in tree.body:
            outside.extend(_external_imports(node, where))
        if node in tree.body:
            dropped.append(node)
    return ModuleSource(name, text, tree, inside, tuple(outside), tuple(dropped))


def _internal_imports(node: ast.ImportFrom, where: str) -> Iterator[tuple[str, str]]:
    """Yield each name that an import of the package binds, and its module."""
    for alias in node.names:
        if alias.asname is not None:
            raise ValueError(f"{where}: imports {alias.name} under another name, expected its own")
        yield alias.name, str(node.module)


def _external_imports(node: ast.Import | ast.ImportFrom, where: str) -> Iterator[str]:
    """Yield one import line for each imported name."""
    for alias in node.names:
        module = node.module or "" if isinstance(node, ast.ImportFrom) else alias.name
        if isinstance(node, ast.ImportFrom) and node.level:
            raise ValueError(f"{where}: a relative import, expected imports by a module's full name")
        if module.partition(".")[0] not in EXTERNAL_PACKAGES:
            raise ValueError(f"{where}: imports {module}, expected the standard library and NumPy")
        line = f"import {alias.name}" + (f" as {alias.asname}" if alias.asname else "")
        yield f"from {module} {line}" if isinstance(node, ast.ImportFrom) else line


def _sort_by_imports(names: Iterable[str], generated: dict[str, ModuleSource]) -> list[ModuleSource]:
    """Return the wanted modules and all modules that they import, each after its own imports.

    Modules in `generated` are not read from files.
    """
    ordered: dict[str, ModuleSource] = {}

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise ValueError(f"modules that import each other: {' -> '.join([*above, name])}")
        if name in ordered:
            return
        source = generated.get(name) or read_source(name)
        for needed in dict.fromkeys(source.inside.values()):
            visit(needed, (*above, name))
        ordered[name] = source

    for name in names:
        visit(name, ())
    return list(ordered.values())


def _check_unique(sources: Iterable[ModuleSource]) -> None:
    """Raise ValueError if two modules bind the same name, or a name has two external meanings."""
    owners: dict[str, str] = {}
    for source in sources:
        bound = {name: source.name for statement in source.tree.body for name in _bound_names(statement)}
        for line in source.outside:
            bound[re.split(r"[ .]", line.rpartition(" as ")[2].rpartition("import ")[2])[0]] = line
        for name, owner in bound.items():
            if owners.setdefault(name, owner) != owner:
                raise ValueError(f"{name}: found in {owners[name]} and in {owner}, expected once")


def _bound_names(statement: ast.stmt) -> Iterator[str]:
    """Yield the names that a top-level statement binds, except for imports and `__all__`."""
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        yield statement.name
    elif not isinstance(statement, (ast.Import, ast.ImportFrom)) and not _assigns(statement, "__all__"):
        for node in ast.walk(statement):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                yield node.id


def _module_section(source: ModuleSource) -> Iterator[str]:
    """Yield the module's docstring as a comment, then its text without the dropped statements."""
    yield from ("", "", f"# ---- {source.name} " + "-" * (100 - len(source.name)))
    for line in (ast.get_docstring(source.tree) or "").splitlines():
        yield f"# {line}".rstrip()
    yield ""
    lines = source.text.splitlines()
    for statement in source.omitted_statements:
        for number in range(statement.lineno - 1, statement.end_lineno or statement.lineno):
            lines[number] = ""
    yield re.sub(r"\n{4,}", "\n\n\n", "\n".join(lines)).strip("\n")


def _public_names(offered: ModuleSource) -> list[str]:
    """Return the names in `__all__` of a module. Raise ValueError if there are none."""
    for statement in offered.tree.body:
        if isinstance(statement, ast.Assign) and _assigns(statement, "__all__"):
            return list(ast.literal_eval(statement.value))
    raise ValueError("the runtime's __init__ says nothing in __all__")


def _public_modules(offered: ModuleSource) -> list[str]:
    """Return the modules of the public names."""
    return [offered.inside[name] for name in _public_names(offered) if name in offered.inside]


def _assigns(statement: ast.stmt, name: str) -> bool:
    """Return whether a statement assigns to a name."""
    return isinstance(statement, ast.Assign) and any(
        isinstance(target, ast.Name) and target.id == name for target in statement.targets
    )
