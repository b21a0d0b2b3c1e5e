"""Habits of writing that make docstrings hard to read stay out of the packages."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# A docstring that begins so describes a fact or a noun without a name, not what the object is or does.
FIRST_WORDS = re.compile(r"(Of|What|Whether|How|Where|Which|Likewise|The same|Those|That)\b")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def docstrings(path: Path):
    """Yield line and docstring of everything documented in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, DOCUMENTED) and (text := ast.get_docstring(node)):
            yield getattr(node, "lineno", 1), text


@pytest.mark.parametrize("package", ["jaxhil", "tuning"])
def test_docstrings_begin_with_a_verb_or_a_noun(package):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, text in docstrings(path)
        if FIRST_WORDS.match(text)
    ]
    assert not wrong, "\n".join(wrong)
