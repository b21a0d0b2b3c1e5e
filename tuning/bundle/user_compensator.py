"""Source code of a user-registered compensator's runtime class, for `jaxhil_runtime.py`.

The source code contains the class and everything in its module that the class uses: imports, and the
top-level statements that define the other names.
"""

import ast
import inspect
import sys

from jaxhil.errors import InputError, to_one_line

FORMER_PACKAGE, RIG_PACKAGE = "jaxhil.runtime.", "jaxhil.rig."


def module_text(law: type, name: str) -> str:
    """Return the source code of a module that defines the class `law` and registers it as `name`.

    The module contains everything that the class uses. Raise `InputError` if the class has no source code.
    """
    try:
        text = inspect.getsource(sys.modules[law.__module__])
    except (OSError, TypeError, KeyError):
        # A class in a notebook cell has source code, but its module has none.
        text = _class_text(law)
    tree = ast.parse(text)
    names, statements = {law.__name__}, set()
    while True:
        new = [entry for entry in tree.body if entry not in statements and names & set(_bound_names(entry))]
        if not new:
            break
        statements.update(new)
        names |= {node.id for entry in new for node in ast.walk(entry) if isinstance(node, ast.Name)}
    parts = [
        _restrict_import(entry, names) if _is_import(entry) else entry
        for entry in tree.body
        if entry in statements
    ]
    texts = [
        ast.unparse(part) if _is_import(part) else ast.get_source_segment(text, part) or "" for part in parts
    ]
    registration = f'register("{name}")({law.__name__})'
    return "\n\n\n".join(["from jaxhil.rig.registry import register", *texts, registration])


def _class_text(law: type) -> str:
    """Return the source code of a class; raise `InputError` if there is none."""
    try:
        return inspect.getsource(law)
    except (OSError, TypeError) as error:
        reason = to_one_line(str(error), 100)
        raise InputError(
            f"{law.__name__}: found no source code of the class ({reason}), expected a class in a file"
        ) from None


def _is_import(statement: ast.stmt) -> bool:
    return isinstance(statement, (ast.Import, ast.ImportFrom))


def _bound_names(statement: ast.stmt) -> list[str]:
    """Return the names that a top-level statement defines or imports."""
    if isinstance(statement, (ast.Import, ast.ImportFrom)):
        return [alias.asname or alias.name.partition(".")[0] for alias in statement.names]
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        return [statement.name]
    stores = (node for node in ast.walk(statement) if isinstance(node, ast.Name))
    return [node.id for node in stores if isinstance(node.ctx, ast.Store)]


def _restrict_import(statement: ast.stmt, names: set[str]) -> ast.stmt:
    """Return an import statement with only `names`; replace the package `jaxhil.runtime` by `jaxhil.rig`."""
    assert isinstance(statement, (ast.Import, ast.ImportFrom))
    aliases = [alias for alias in statement.names if (alias.asname or alias.name.partition(".")[0]) in names]
    if isinstance(statement, ast.Import):
        return ast.Import(aliases)
    module = statement.module or ""
    if module.startswith(FORMER_PACKAGE):
        module = RIG_PACKAGE + module.removeprefix(FORMER_PACKAGE)
    return ast.ImportFrom(module, aliases, statement.level)
