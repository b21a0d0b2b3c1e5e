"""Runtime in a single file: identical results to the package."""

import importlib
import json
import math
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest
from gain_documents import gain_document

from jaxhil.rig import COMPENSATORS, Controller
from tuning.bundle.single_file import build_runtime_source


@pytest.fixture(scope="module", params=sorted(COMPENSATORS))
def exported(request, tmp_path_factory):
    """Write the runtime with one compensator as a single file, and a gain file for it."""
    folder = tmp_path_factory.mktemp("single")
    (folder / "jaxhil_runtime.py").write_text(build_runtime_source(request.param))
    (folder / "gains.json").write_text(json.dumps(gain_document(request.param)))
    return request.param, folder


def loaded(folder):
    namespace = {"__name__": "jaxhil_runtime"}
    exec(compile((folder / "jaxhil_runtime.py").read_text(), "jaxhil_runtime.py", "exec"), namespace)
    return namespace


def test_single_file_runtime_contains_one_compensator_and_only_required_code(exported):
    compensator, folder = exported
    head = (folder / "jaxhil_runtime.py").read_text().partition("# ---- ")[0]
    assert "and no other package" in head
    foreign = {"jax", "jaxhil", "tuning", "numpy"}
    program = (
        "import sys; sys.path.insert(0, sys.argv[1]); import jaxhil_runtime as runtime\n"
        "print(*runtime.COMPENSATORS); runtime.Controller.from_file(sys.argv[1] + '/gains.json')\n"
        f"assert not {foreign} & {{name.split('.')[0] for name in sys.modules}}"
    )
    command = [sys.executable, "-I", "-S", "-c", program, str(folder)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout.split(), ran.stderr) == (0, [compensator], "")


def test_single_file_runtime_has_no_unused_or_missing_name(exported):
    _, folder = exported
    command = [sys.executable, "-m", "ruff", "check", "--isolated", "--select", "F,E9", str(folder)]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout


def test_single_file_runtime_commands_equal_commands_of_package_bit_for_bit(exported):
    compensator, folder = exported
    document = gain_document(compensator)
    ours, other = Controller.from_dict(document), loaded(folder)["Controller"].from_dict(document)
    source = random.Random(1)
    for tick in range(400):
        position = 2e-3 * math.sin(0.02 * tick)
        inputs = (
            max(0.0, 1e5 * position) + source.gauss(0, 1),
            position,
            0.04,
            position + 1e-6 * source.random(),
        )
        assert other.step(*inputs) == ours.step(*inputs)
        motion = position, 0.04, source.gauss(0, 1)
        assert other.position_command(*motion) == ours.position_command(*motion)
    assert other.identified == ours.identified


def test_single_file_runtime_keeps_comments_and_labels_each_module(exported):
    _, folder = exported
    text = (folder / "jaxhil_runtime.py").read_text()
    assert "# ---- jaxhil.rig.controller ---" in text
    assert "# In Python, bool is a subclass of int." in text
    # Examples in docstrings may import the package.
    assert not re.search(r"^\s*(from \.|from jaxhil|import jax)", text, re.MULTILINE)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Create a package with the given modules, which register two compensators, and import it."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def make(**modules):
        name = f"runtime_{tmp_path.name.replace('-', '_')}"
        folder = tmp_path / name
        folder.mkdir()
        for module, text in {**MODULES, **modules}.items():
            (folder / f"{module}.py").write_text(absolute(text, name))
        return importlib.import_module(name)

    yield make
    for name in [name for name in sys.modules if name.startswith("runtime_")]:
        del sys.modules[name]


MODULES = {
    "__init__": (
        "from .first import First\nfrom .second import Second\nfrom .controller import Controller\n"
        "from .registry import COMPENSATORS\n__all__ = ['COMPENSATORS', 'Controller']\n"
    ),
    "registry": (
        "COMPENSATORS = {}\n\ndef register(name):\n    def enter(law):\n        COMPENSATORS[name] = law\n"
        "        return law\n    return enter\n"
    ),
    "first": "from .registry import register\n\n@register('first')\nclass First:\n    number = 1\n",
    "second": "from .registry import register\n\n@register('second')\nclass Second:\n    number = 2\n",
    "controller": "from .registry import COMPENSATORS\n\nclass Controller:\n    laws = COMPENSATORS\n",
}


def absolute(text, package):
    """Return a module's text with relative imports made absolute, except `from . import`."""
    return re.sub(r"from \.(?=\w)", f"from {package}.", text)


def run_source(text):
    namespace = {"__name__": "single"}
    exec(compile(text, "single", "exec"), namespace)
    return namespace


def test_single_file_runtime_contains_only_imports_its_compensator_needs(package):
    made = package(
        shared="import math as m\nSHARED = 4 * m.floor(1.5)  # a comment stays\n",
        second="from .registry import register\nfrom .shared import SHARED\n\n@register('second')\n"
        "class Second:\n    number = SHARED\n",
    )
    assert "SHARED" not in build_runtime_source("first", made)
    text = build_runtime_source("second", made)
    in_one_file = run_source(text)
    assert in_one_file["COMPENSATORS"]["second"].number == 4
    assert "First" not in text and in_one_file["__all__"] == ["COMPENSATORS", "Controller"]
    assert "# a comment stays" in text


@pytest.mark.parametrize(
    "controller, reason",
    [
        ("import scipy\n", "scipy"),
        ("def f():\n    from .registry import COMPENSATORS\n", "within a block"),
        ("from . import registry\n", "a relative import"),
        ("from .registry import register as enter\n", "under another name"),
        ("from .circle import A\n", "import each other"),
        ("def register():\n    pass\n", "register: found in .*registry and in .*controller, expected once"),
        ("import re as register\n", "register: found in .*registry and in import re as register"),
        ("from .same import X\nimport cmath as m\n", "m: found in import math as m and in import cmath as m"),
        ("for register in (): pass\n", "register: found in .*registry and in .*controller"),
    ],
)
def test_single_file_export_rejects_unsupported_code(package, controller, reason):
    made = package()
    folder = Path(made.__file__).parent
    (folder / "circle.py").write_text(f"from {made.__name__}.controller import B\n")
    (folder / "same.py").write_text("import math as m\nX = m.inf\n")
    (folder / "controller.py").write_text(absolute(controller, made.__name__) + "class Controller: pass\n")
    with pytest.raises(ValueError, match=reason):
        build_runtime_source("first", made)


def test_single_file_export_of_unknown_compensator_raises_key_error():
    with pytest.raises(KeyError):
        build_runtime_source("no such law")
