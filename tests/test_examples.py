"""Examples in the docstrings of public functions, run as they stand."""

import doctest
from importlib import import_module
from pkgutil import resolve_name

import pytest

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.rig.registry import COMPENSATORS as RIG_COMPENSATORS

EVERYDAY = [
    "jaxhil.jacobian",
    "jaxhil.load",
    "jaxhil.register",
    "jaxhil.simulate",
    "jaxhil.laws.built_in_compensators",
    "jaxhil.rig.Controller.from_dict",
    "jaxhil.rig.digest",
    "jaxhil.rig_models.choose_rig_model",
    "tuning.shadow",
    "tuning.sweep",
    "tuning.tune",
    "tuning.verify",
]
SLOW = ["tuning.compare", "tuning.export", "tuning.map", "tuning.report"]


def run_examples(path):
    """Run the examples of a docstring, check that none fails, and return their number."""
    [test] = doctest.DocTestFinder(recurse=False).find(resolve_name(path), path)
    report = []
    result = doctest.DocTestRunner(verbose=False).run(test, out=report.append)
    assert not result.failed, "".join(report)
    return result.attempted


@pytest.fixture(autouse=True)
def keep_registered_compensators():
    """Remove compensators that an example registers."""
    saved = [(table, dict(table)) for table in (COMPENSATORS, RIG_COMPENSATORS)]
    yield
    for table, content in saved:
        table.clear()
        table.update(content)


@pytest.mark.parametrize("path", EVERYDAY)
def test_example_of_public_function_runs(path):
    assert run_examples(path) >= 1


@pytest.mark.slow
@pytest.mark.parametrize("path", SLOW)
def test_example_of_long_running_function_runs(path):
    assert run_examples(path) >= 1


def test_every_public_function_has_an_example():
    names = {
        f"{package}.{name}"
        for package in ("jaxhil", "tuning")
        for name in import_module(package).__all__
        if not isinstance(getattr(import_module(package), name), (type, str))
    }
    assert names <= {*EVERYDAY, *SLOW}
