"""The names of a Python module: which it binds, where they are meant, and others in their place.

A name in a function means the module's own unless the function, or one around it, binds it: as a parameter,
by assignment, in a comprehension. `occurrences` knows the difference; `edited` replaces in the text, with its
comments, and `renamed` in the syntax tree.
"""

import ast
import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

Function = ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda
Comprehension = ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp


class Occurrence(NamedTuple):
    """Where a module's own name is meant: the node (a name, a definition, `module.name`), what to write."""

    node: ast.AST
    old: str
    new: str


def names_bound(statements: Iterable[ast.stmt]) -> list[str]:
    """The names that statements bind, other than in functions and classes of theirs, in their order."""
    found: dict[str, None] = {}
    for statement in statements:
        for name in _bound_by(statement):
            found[name] = None
    return list(found)


def occurrences(
    tree: ast.AST, names: Mapping[str, str], modules: Mapping[str, Mapping[str, str]]
) -> Iterator[Occurrence]:
    """Where the tree means its module's own `names`, or a name of one of the `modules` that it imports.

    Raises ValueError where an imported module is used other than for a name of its own.
    """
    yield from _visit(tree, names, modules, frozenset())


def edited(
    text: str,
    tree: ast.Module,
    dropped: Sequence[ast.stmt],
    names: Mapping[str, str],
    modules: Mapping[str, Mapping[str, str]],
) -> str:
    """The text without the `dropped` statements, its names replaced as `occurrences` has them."""
    lines = [line.encode() for line in text.splitlines(keepends=True)]
    # Columns of the syntax tree count bytes. From the end on, so that places stay where they are.
    changes = []
    for statement in tree.body:
        if statement in dropped:
            continue
        for one in occurrences(statement, names, modules):
            changes.append((*_place(one, lines), one))
    for line, column, length, one in sorted(changes, key=lambda change: change[:2], reverse=True):
        whole = lines[line]
        lines[line] = whole[:column] + one.new.encode() + whole[column + length :]
    for statement in dropped:
        for number in range(statement.lineno - 1, statement.end_lineno or statement.lineno):
            lines[number] = b""
    return b"".join(lines).decode()


def renamed(
    statement: ast.stmt, names: Mapping[str, str], modules: Mapping[str, Mapping[str, str]]
) -> ast.stmt:
    """A copy of the statement, its names replaced as `occurrences` has them."""
    made = copy.deepcopy(statement)
    replaced = {id(one.node): one for one in occurrences(made, names, modules)}
    _Renaming(replaced).visit(made)
    return made


class _Renaming(ast.NodeTransformer):
    def __init__(self, replaced: Mapping[int, Occurrence]):
        self._replaced = replaced

    def visit(self, node: ast.AST) -> ast.AST:
        one = self._replaced.get(id(node))
        if isinstance(one, Occurrence):
            if isinstance(node, ast.Attribute):
                return ast.Name(one.new, node.ctx)
            setattr(node, "id" if isinstance(node, ast.Name) else "name", one.new)
        return self.generic_visit(node)


def _place(one: Occurrence, lines: list[bytes]) -> tuple[int, int, int]:
    """Line and column, from 0, and length of what is to be replaced."""
    node = one.node
    assert isinstance(node, (ast.expr, ast.stmt, ast.ExceptHandler))
    line, column = node.lineno - 1, node.col_offset
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
        word = b"class" if isinstance(node, ast.ClassDef) else b"def"
        column = lines[line].index(one.old.encode(), lines[line].index(word, column) + len(word))
    return line, column, len(one.old.encode())


def _visit(
    node: ast.AST, names: Mapping[str, str], modules: Mapping[str, Mapping[str, str]], local: frozenset[str]
) -> Iterator[Occurrence]:
    def inner(children: Iterable[ast.AST | None], shadowed: frozenset[str] = local) -> Iterator[Occurrence]:
        for child in children:
            if child is not None:
                yield from _visit(child, names, modules, shadowed)

    if isinstance(node, ast.Name):
        if node.id in modules and node.id not in local:
            raise ValueError(f"line {node.lineno}: the module {node.id} itself is used")
        if node.id in names and node.id not in local:
            yield Occurrence(node, node.id, names[node.id])
    elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id not in local:
        module = modules.get(node.value.id)
        if module is None:
            yield from inner([node.value])
        elif node.attr not in module:
            raise ValueError(f"line {node.lineno}: {node.value.id}.{node.attr} is not a name of that module")
        else:
            yield Occurrence(node, f"{node.value.id}.{node.attr}", module[node.attr])
    elif isinstance(node, Function):
        if not isinstance(node, ast.Lambda):
            if node.name in names and node.name not in local:
                yield Occurrence(node, node.name, names[node.name])
            annotations = [one.annotation for one in _parameters(node.args)]
            yield from inner([*node.decorator_list, *annotations, node.returns])
        yield from inner([*node.args.defaults, *node.args.kw_defaults])
        body = [node.body] if isinstance(node, ast.Lambda) else node.body
        yield from inner(body, _within(node, local))
    elif isinstance(node, ast.ClassDef):
        if node.name in names and node.name not in local:
            yield Occurrence(node, node.name, names[node.name])
        yield from inner([*node.decorator_list, *node.bases, *(one.value for one in node.keywords)])
        # What a class binds hides a name in its own statements, and not in its methods.
        of_class = frozenset(names_bound(node.body))
        for one in _own_nodes(node.body):
            if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Load) and one.id in of_class & {*names}:
                raise ValueError(f"line {one.lineno}: {one.id} may be the class's own or the module's")
        for statement in node.body:
            if isinstance(statement, (ast.FunctionDef, ast.AsyncFunctionDef)):
                for one in inner([statement]):
                    if one.node is not statement:
                        yield one
            else:
                yield from inner([statement], local | of_class)
    elif isinstance(node, Comprehension):
        targets = frozenset(
            one.id for part in node.generators for one in ast.walk(part.target) if isinstance(one, ast.Name)
        )
        yield from inner([node.generators[0].iter])
        rest = [part.iter for part in node.generators[1:]] + [
            one for part in node.generators for one in part.ifs
        ]
        parts = [node.key, node.value] if isinstance(node, ast.DictComp) else [node.elt]
        yield from inner([*(part.target for part in node.generators), *rest, *parts], local | targets)
    else:
        yield from inner(ast.iter_child_nodes(node))


def _within(node: Function, local: frozenset[str]) -> frozenset[str]:
    """The names that are not the module's in a function's body."""
    own = {one.arg for one in _parameters(node.args)}
    if isinstance(node, ast.Lambda):
        return local | own
    shared = {name for one in _own_nodes(node.body) if isinstance(one, ast.Global) for name in one.names}
    return (local | own | frozenset(names_bound(node.body))) - shared


def _parameters(arguments: ast.arguments) -> list[ast.arg]:
    starred = [one for one in (arguments.vararg, arguments.kwarg) if one is not None]
    return [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, *starred]


def _bound_by(statement: ast.stmt) -> Iterator[str]:
    for node in _own_nodes([statement]):
        if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            yield node.id
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name:
            yield node.name
        elif isinstance(node, (ast.Import, ast.ImportFrom)):
            yield from (alias.asname or alias.name.partition(".")[0] for alias in node.names)


def _own_nodes(statements: Iterable[ast.AST]) -> Iterator[ast.AST]:
    """All nodes but those within functions, classes and comprehensions, whose names are their own.

    An assignment expression in a comprehension binds around it; the runtime has none.
    """
    for node in statements:
        yield node
        if not isinstance(node, _OPAQUE):
            yield from _own_nodes(ast.iter_child_nodes(node))


_OPAQUE = (
    *(ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef, ast.Lambda),
    *(ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp),
)
