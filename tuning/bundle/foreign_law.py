"""A law from outside the package on the rig: the source of its runtime class, for the runtime in one file.

It is the class with what it uses of its own module: imports of the standard library, of NumPy and of
`jaxhil.rig`, and the statements at the module's top that bind the other names.
"""

import ast
import inspect
import sys

from jaxhil.errors import InputError, one_line

FORMER, PACKAGE = "jaxhil.runtime.", "jaxhil.rig."


def module_text(law: type, name: str) -> str:
    """The text of a module with nothing but the class, registered as `name`, and what it names.

    Raises `InputError` for a class without a source.
    """
    try:
        text = inspect.getsource(sys.modules[law.__module__])
    except (OSError, TypeError, KeyError):
        # A class of a notebook's cell has a source, its module has none.
        text = _class_text(law)
    tree = ast.parse(text)
    wanted, kept = {law.__name__}, set()
    while True:
        found = [one for one in tree.body if one not in kept and wanted & set(_bound(one))]
        if not found:
            break
        kept.update(found)
        wanted |= {node.id for one in found for node in ast.walk(one) if isinstance(node, ast.Name)}
    parts = [_only(one, wanted) if _is_import(one) else one for one in tree.body if one in kept]
    texts = [
        ast.unparse(one) if _is_import(one) else ast.get_source_segment(text, one) or "" for one in parts
    ]
    entered = f'register("{name}")({law.__name__})'
    return "\n\n\n".join(["from jaxhil.rig.registry import register", *texts, entered])


def _class_text(law: type) -> str:
    try:
        return inspect.getsource(law)
    except (OSError, TypeError) as error:
        reason = one_line(str(error), 100)
        raise InputError(f"{law.__name__}: found no source of the runtime class: {reason}") from None


def _is_import(statement: ast.stmt) -> bool:
    return isinstance(statement, (ast.Import, ast.ImportFrom))


def _bound(statement: ast.stmt) -> list[str]:
    """Names that a statement at a module's top binds."""
    if isinstance(statement, (ast.Import, ast.ImportFrom)):
        return [alias.asname or alias.name.partition(".")[0] for alias in statement.names]
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        return [statement.name]
    stores = (node for node in ast.walk(statement) if isinstance(node, ast.Name))
    return [node.id for node in stores if isinstance(node.ctx, ast.Store)]


def _only(statement: ast.stmt, wanted: set[str]) -> ast.stmt:
    """Return an import of the names wanted alone; the rig's package has its present name."""
    assert isinstance(statement, (ast.Import, ast.ImportFrom))
    names = [one for one in statement.names if (one.asname or one.name.partition(".")[0]) in wanted]
    if isinstance(statement, ast.Import):
        return ast.Import(names)
    module = statement.module or ""
    if module.startswith(FORMER):
        module = PACKAGE + module.removeprefix(FORMER)
    return ast.ImportFrom(module, names, statement.level)
