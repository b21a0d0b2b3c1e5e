"""The page of exit codes and messages, read from the source: every refusal with the module that utters it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from tuning.__main__ import EXIT_BAD, EXIT_GOOD, EXIT_INTERRUPTED, EXIT_UNUSABLE_INPUT

ROOT = Path(__file__).resolve().parents[2]
REFUSALS = {"InputError", "KeyProblem", "GainFileError"}
GAP = "…"
PLAIN = re.compile(r"found|allowed|\W|_")  # what every message has


def messages() -> str:
    """Exit codes, and every message of a refusal; `…` stands for what is filled in."""
    sections = [HEAD]
    for package in ("jaxhil", "tuning"):
        for path in sorted((ROOT / package).rglob("*.py")):
            found = sorted(set(_refusals(ast.parse(path.read_text(encoding="utf-8")))))
            if found:
                name = str(path.relative_to(ROOT))
                sections.append(f"### {name}\n\n```text\n" + "\n".join(found) + "\n```")
    return "\n\n".join(sections) + "\n"


def _refusals(tree: ast.Module) -> Iterator[str]:
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    for scope in functions:
        for node in ast.walk(scope):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in REFUSALS:
                words = [_words(one, scope) for one in node.args]
                if len(words) == 3:  # a key's path, what was found, what is allowed
                    words = [f"{GAP}: found {words[1]}, expected {words[2]}"]
                text = re.sub(f"{GAP}+", GAP, " ".join("".join(words).split()))
                if PLAIN.sub("", text):
                    yield text


def _words(node: ast.expr, scope: ast.FunctionDef, depth: int = 3) -> str:
    """The text of an expression, as far as it stands in the source."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_words(part, scope, depth) for part in parts)
        case ast.FormattedValue(value=inner):
            return _words(inner, scope, depth) if isinstance(inner, ast.Name) else GAP
        case ast.BinOp(op=ast.Add(), left=left, right=right):
            return _words(left, scope, depth) + _words(right, scope, depth)
        case ast.Name(id=name) if depth:
            texts = [_words(value, scope, depth - 1) for value in _assigned(scope, name)]
            return texts[0] if len(texts) == 1 else GAP
        case _:
            return GAP


def _assigned(scope: ast.FunctionDef, name: str) -> Iterator[ast.expr]:
    """What a function gives to a name of its own."""
    for node in ast.walk(scope):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                if isinstance(target, ast.Name) and target.id == name:
                    yield node.value


HEAD = f"""\
# Exit codes and messages

| exit code | meaning |
| --- | --- |
| {EXIT_GOOD} | done and good |
| {EXIT_BAD} | done; the verdict is bad: an error beyond `--limit`, a corrupt bundle, too many wrong alarms |
| {EXIT_UNUSABLE_INPUT} | unusable input, or no way to write a file: one line on standard error says why |
| {EXIT_INTERRUPTED} | interrupted; what was finished is kept |

Standard output has the result alone (with `--json` one JSON document); progress, notes and lines that begin
with `warning:` go to standard error. A refusal is one line, `jaxhil: ` and what was found and what is
allowed; from Python it is a `jaxhil.InputError` of the same text. `internal error` is a fault of the program:
set `JAXHIL_TRACEBACK=1` for a traceback.

## Every refusal

By module; `{GAP}` stands for what is filled in. A key of the mechanism file is refused with the values that
its [type allows](mechanism_file.md)."""
