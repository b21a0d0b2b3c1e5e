"""Source code of Python functions: syntax trees, comments, annotations and uses of local names."""

import ast
import inspect
import linecache
import sys
import textwrap
import typing
from collections.abc import Callable
from functools import cache
from typing import Any

from .subset import SubsetError


@cache
def parse_file(file: str) -> ast.Module:
    """Return the syntax tree of a file or of a notebook cell."""
    return ast.parse("".join(linecache.getlines(file)), file)


@cache
def find_definition(function: Callable[..., Any]) -> tuple[ast.FunctionDef, str]:
    """Return a function's syntax tree and its file. Raise SubsetError if there is no source code."""
    code = function.__code__
    try:
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
        ast.increment_lineno(node, code.co_firstlineno - 1)
    except (OSError, SyntaxError, ValueError):
        node = None
    if not isinstance(node, ast.FunctionDef):
        found = f"no source code of {function.__qualname__}"
        raise SubsetError(code.co_filename, code.co_firstlineno, found, "a function in a file")
    return node, code.co_filename


def find_annotations(function: Callable[..., Any], protocol: type | None) -> dict[str, Any]:
    """Return a function's annotations; those of the method with its name in `protocol` take precedence."""
    method = vars(protocol).get(function.__name__) if protocol else None
    method = method.fget if isinstance(method, property) else method
    more = typing.get_type_hints(method, include_extras=True) if inspect.isfunction(method) else {}
    return typing.get_type_hints(function, include_extras=True) | more


def read_comment_before(file: str, statement: ast.stmt) -> str:
    """Return the comment directly above a statement, without `#`; "" if there is none."""
    comment, line = "", statement.lineno - 1
    while (text := linecache.getline(file, line).strip()).startswith("#"):
        comment, line = f"{text.lstrip('# ')} {comment}", line - 1
    return comment.strip()


def read_constant_comment(name: str, namespace: dict[str, Any]) -> str:
    """Return the comment on the line of a module constant's assignment; "" if there is none."""
    file = getattr(sys.modules.get(namespace["__name__"]), "__file__", None)
    for node in parse_file(file).body if file else []:
        if isinstance(node, ast.ImportFrom) and any(alias.name == name for alias in node.names):
            package = namespace["__name__"].rsplit(".", node.level)[0] + "." if node.level else ""
            module = sys.modules.get(f"{package}{node.module}")
            return read_constant_comment(name, vars(module)) if module else ""
        if isinstance(node, ast.Assign) and name in (getattr(target, "id", "") for target in node.targets):
            line = linecache.getline(file or "", node.end_lineno or 0)
            return line[node.end_col_offset or 0 :].partition("#")[2].strip()
    return ""


def find_name_lines(function: ast.FunctionDef) -> dict[str, list[tuple[int, bool]]]:
    """Return the occurrences of each local name: line number, and whether it is an assignment."""
    targets = [loop.target for loop in ast.walk(function) if isinstance(loop, (ast.For, ast.comprehension))]
    loops = {name for target in targets for name in ast.walk(target)}
    result: dict[str, list[tuple[int, bool]]] = {}
    for node in ast.walk(function):
        if isinstance(node, ast.Name):
            is_store = isinstance(node.ctx, ast.Store) and node not in loops
            result.setdefault(node.id, []).append((node.lineno, is_store))
    return {name: sorted(uses) for name, uses in result.items() if any(store for _, store in uses)}
