"""Generation of `jaxhil_runtime.py`: the rig's controller and one compensator in a single source file.

The file contains the modules that define the names in `jaxhil.rig.__all__`, the module of the compensator,
and all modules of `jaxhil` that they import. Imports of other packages are at the top. Each module comes
after the modules that it imports, without its import statements. Two modules must not define the same name.
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
    """Source code of one module, with its imports."""

    name: str  # full name of the module
    text: str  # source code
    tree: ast.Module  # syntax tree of the source code
    inside: dict[str, str]  # for each name imported from this package, the module that defines it
    outside: tuple[str, ...]  # import statements for other packages
    # statements that the single file omits: docstring, imports and `__all__`
    omitted_statements: tuple[ast.stmt, ...]


def build_runtime_source(
    compensator: str, package: ModuleType = jaxhil.rig, table: str = "COMPENSATORS"
) -> str:
    """Return the source code of `jaxhil_runtime.py`: the public names of `package` and one compensator.

    Args:
        compensator: name of the compensator.
        package: package of the runtime.
        table: name of the table of compensators in the package's module `registry`.

    Returns:
        Python source code.

    Raises:
        KeyError: If the runtime does not know the compensator.
        ValueError: If the modules cannot be joined into one file. An import must not be circular, relative,
            renamed or within a function, and may only use this package, the standard library and NumPy. Two
            modules must not define the same name.
    """
    root = package.__name__.partition(".")[0]
    registry = importlib.import_module(f"{package.__name__}.registry")
    class_ = getattr(registry, table)[compensator]
    law, generated = class_.__module__, {}
    if law.partition(".")[0] != root:
        generated[law] = parse_source(module_text(class_, compensator), law, f"{compensator}.py", root)
    offered = read_source(f"{package.__name__}.__init__")
    sources = _sort_by_imports([law, *_public_modules(offered)], generated)
    _check_unique(sources)
    public = [name for name in _public_names(offered) if name in offered.inside]
    controller = next(name for name in public if name.startswith("Controller"))
    imports = {line for source in sources for line in source.outside}
    needed = " and NumPy" if any("numpy" in line for line in imports) else ", and no other package"
    lines = [
        f'"""Controller for the rig with the compensator {compensator}, in a single source file.',
        "",
        f"`jaxhil export` made this file from the modules of jaxhil. It needs Python 3.11 or later{needed}.",
        "",
        f"    controller = {controller}.from_file('gains.json')",
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
        raise ValueError(f"jaxhil_runtime.py: the joined modules do not compile: {error}") from None
    return text


def read_source(name: str) -> ModuleSource:
    """Read and parse the source file of a module, given by its full name."""
    root, _, below = name.partition(".")
    path = Path(str(sys.modules[root].__file__)).parent / f"{below.replace('.', '/')}.py"
    if not path.is_file():
        raise ValueError(f"{name}: found no source file, expected a module and not a package")
    return parse_source(path.read_text(encoding="utf-8"), name, path.name, root)


def parse_source(text: str, name: str, file: str, root: str) -> ModuleSource:
    """Parse the source code of a module; imports from the package `root` are internal.

    `file` is the file name for error messages.
    """
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
                raise ValueError(f"{where}: found an import of {root} within a block, expected no block")
            inside.update(_internal_imports(node, where))
        elif node in tree.body:
            outside.extend(_external_imports(node, where))
        if node in tree.body:
            dropped.append(node)
    return ModuleSource(name, text, tree, inside, tuple(outside), tuple(dropped))


def _internal_imports(node: ast.ImportFrom, where: str) -> Iterator[tuple[str, str]]:
    """Yield (name, module) for each name that a statement imports from this package."""
    for alias in node.names:
        if alias.asname is not None:
            raise ValueError(f"{where}: imports {alias.name} under another name, expected no `as`")
        yield alias.name, str(node.module)


def _external_imports(node: ast.Import | ast.ImportFrom, where: str) -> Iterator[str]:
    """Yield one import statement for each name that a statement imports from another package."""
    for alias in node.names:
        module = node.module or "" if isinstance(node, ast.ImportFrom) else alias.name
        if isinstance(node, ast.ImportFrom) and node.level:
            raise ValueError(f"{where}: found a relative import, expected the module's full name")
        if module.partition(".")[0] not in EXTERNAL_PACKAGES:
            raise ValueError(f"{where}: imports {module}, expected only the standard library and NumPy")
        line = f"import {alias.name}" + (f" as {alias.asname}" if alias.asname else "")
        yield f"from {module} {line}" if isinstance(node, ast.ImportFrom) else line


def _sort_by_imports(names: Iterable[str], generated: dict[str, ModuleSource]) -> list[ModuleSource]:
    """Return the named modules and all modules that they import, in an order that satisfies the imports.

    A source in `generated` replaces the source file of the module with this name.
    """
    ordered: dict[str, ModuleSource] = {}

    def visit(name: str, above: tuple[str, ...]) -> None:
        if name in above:
            raise ValueError(f"these modules import each other: {' -> '.join([*above, name])}")
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
    """Raise ValueError if two modules define the same name, or import different objects under one name."""
    owners: dict[str, str] = {}
    for source in sources:
        bound = {name: source.name for statement in source.tree.body for name in _bound_names(statement)}
        for line in source.outside:
            bound[re.split(r"[ .]", line.rpartition(" as ")[2].rpartition("import ")[2])[0]] = line
        for name, owner in bound.items():
            if owners.setdefault(name, owner) != owner:
                raise ValueError(f"{name}: found in {owners[name]} and in {owner}, expected once")


def _bound_names(statement: ast.stmt) -> Iterator[str]:
    """Yield the names that a top-level statement defines, except for imports and `__all__`."""
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        yield statement.name
    elif not isinstance(statement, (ast.Import, ast.ImportFrom)) and not _assigns(statement, "__all__"):
        for node in ast.walk(statement):
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                yield node.id


def _module_section(source: ModuleSource) -> Iterator[str]:
    """Yield a module's lines for `jaxhil_runtime.py`: docstring as a comment, then code without imports."""
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
    """Return the names in the `__all__` of a module; raise ValueError if the module has no `__all__`."""
    for statement in offered.tree.body:
        if isinstance(statement, ast.Assign) and _assigns(statement, "__all__"):
            return list(ast.literal_eval(statement.value))
    raise ValueError(f"{offered.name}: found no __all__, expected the public names of the runtime")


def _public_modules(offered: ModuleSource) -> list[str]:
    """Return the modules that define the public names of a package."""
    return [offered.inside[name] for name in _public_names(offered) if name in offered.inside]


def _assigns(statement: ast.stmt, name: str) -> bool:
    """Return whether a statement assigns a value to the variable `name`."""
    return isinstance(statement, ast.Assign) and any(
        isinstance(target, ast.Name) and target.id == name for target in statement.targets
    )
