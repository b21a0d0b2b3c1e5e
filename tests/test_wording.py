"""Style rules for docstrings and names of the packages."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# A docstring that begins so describes a fact or a noun without a name, not what the object is or does.
FIRST_WORDS = re.compile(r"(Of|What|Whether|How|Where|Which|Likewise|The same|Those|That)\b")
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def docstrings(path: Path):
    """Yield line and docstring of all documented objects in a file."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, DOCUMENTED) and (text := ast.get_docstring(node)):
            yield getattr(node, "lineno", 1), text


@pytest.mark.parametrize("package", ["jaxhil", "tuning"])
def test_docstrings_do_not_begin_with_discouraged_words(package):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text.splitlines()[0]}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, text in docstrings(path)
        if FIRST_WORDS.match(text)
    ]
    assert not wrong, "\n".join(wrong)


# Names that say nothing about the value that they hold.
EMPTY_NAMES = set("found one own told known place given kept met said some each held carried likely".split())
# "found" names the part of a message that says what was found.
MESSAGE_PARTS = {"found"}


def bound_names(path: Path):
    """Yield line and name of all parameters and variables in the functions of a file."""
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            parameters = function.args
            for parameter in (*parameters.posonlyargs, *parameters.args, *parameters.kwonlyargs):
                yield function.lineno, parameter.arg
            for node in ast.walk(function):
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    yield node.lineno, node.id


@pytest.mark.parametrize("package", ["jaxhil", "tuning"])
def test_variables_have_no_meaningless_names(package):
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for line, name in bound_names(path)
        if name in EMPTY_NAMES - MESSAGE_PARTS
    ]
    assert not wrong, "\n".join(wrong)


def concept(path: Path) -> str:
    """Return the concept of a file's classes; variants of a concept may share class names."""
    relative = path.relative_to(ROOT).as_posix()
    if relative.startswith("jaxhil/laws/") or re.fullmatch(
        r"jaxhil/rig/(six_axes/)?(filters|registry)\.py", relative
    ):
        return "compensator"
    if relative.startswith(("jaxhil/sixdof/", "jaxhil/mechanism/", "jaxhil/simulation/")):
        return "rig model"
    return relative


def test_class_names_are_unique_except_for_variants_of_a_concept():
    concepts = {}
    for package in ("jaxhil", "tuning"):
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    concepts.setdefault(node.name, set()).add(concept(path))
    shared = {name: sorted(homes) for name, homes in concepts.items() if len(homes) > 1}
    assert not shared


# Words that the glossary retires, in the documents that users read.
RETIRED = re.compile(
    r"\b(bank of hypotheses|farewell|blindness|damped twins?|doubts|untold|from elsewhere|learnt|"
    r"retrospective_(reference|delay_bank)|kept programs?|honestly|carried weights?|"
    r"in[ _]space(?!\", Acta|_))\b",  # except in the title of a paper and in names of CSV columns
    re.IGNORECASE,
)


def test_guide_readme_and_notebooks_use_no_retired_words():
    pages = [
        ROOT / "README.md",
        *sorted((ROOT / "notebooks").rglob("*.md")),
        *sorted((ROOT / "notebooks").glob("*.ipynb")),
    ]
    wrong = [
        f"{page.relative_to(ROOT)}:{number}: {line.strip()}"
        for page in pages
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1)
        if RETIRED.search(line)
    ]
    assert not wrong, "\n".join(wrong)


# Names that no code may bring back: of modules, classes, functions, methods and fields.
RETIRED_NAMES = re.compile(
    r"\b(EpisodeInSpace|SpaceRun|simulate_in_space|final_in_space|follow_contact|start_flight|advance_flight|"
    r"fresh_watch|ContactWatch|watch_tick|check_followed|meeting_mass|touching_height|outcome_of|loop_of|"
    r"MonotonePieces|monotone_pieces|wrench_in_space|twist_in_space|LawMetrics|LawFailure|compare_laws|"
    r"evaluate_law|sixdof\.(alone|space|reference|values|watch|meaning)|simulation\.watch|contact_watch|"
    r"in_floats|dissipates_by|damped_as|_cut_tolerated|_most_turn|laws_from_elsewhere|"
    r"law\.(edge|hold|remembers|jumps|arcs|specialised)|def (edge|remembers|jumps|arcs|specialised)|"
    r"[Ee]ach law (tuned|with the literature))\b"
)


def test_retired_names_are_not_used():
    folders = ("jaxhil", "tuning", "tests", "notebooks")
    paths = [path for folder in folders for path in sorted((ROOT / folder).rglob("*"))]
    wrong = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}"
        for path in paths
        if path.suffix in {".py", ".md", ".ipynb"} and path != Path(__file__)
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if RETIRED_NAMES.search(line)
    ]
    assert not wrong, "\n".join(wrong)
