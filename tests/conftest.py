"""Environment of every test: float64, strict dtype promotion, two host devices, shape checks.

The fixture `jaxhil` calls the command line.
"""

import json
import os
from pathlib import Path
from typing import NamedTuple

from jaxhil.simulation.jax_environment import (
    CACHE_VARIABLE,
    build_jax_variables,
    build_xla_flags,
    cache_folder,
    prepare_jax,
)

# Use two host devices on every machine, and otherwise the XLA flags that commands set for users.
os.environ["XLA_FLAGS"] = build_xla_flags(
    os.environ.get("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
)
os.environ["NPROC"] = build_jax_variables(os.environ)["NPROC"]
os.environ["COLUMNS"] = "110"  # tables and texts have the same width in every terminal

import hypothesis
import jax
import jaxtyping
import pytest
from compiling import compile_quickly, forget_oldest

# Compiled programs are cached for the next run, other workers, notebook kernels and child processes.
FOLDER = "tests"
if (_cache := cache_folder()) is not None and _cache.name != FOLDER:
    os.environ[CACHE_VARIABLE] = str(_cache / FOLDER)
prepare_jax()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Shapes are checked in modules that compute with arrays. The daily run checks them only in the modules' own
# tests, because tracing with checks takes a quarter longer.
PACKAGES = ("compensators", "contact", "simulation", "sixdof")
# These functions check the caller's arguments themselves.
FRONT_DOOR = ("gain_choice", "gain_file", "jacobian", "registration", "run")
CHECKED = [
    f"{package}.{path.stem}"
    for package in PACKAGES
    for path in sorted((Path(__file__).parent.parent / "jaxhil" / package).glob("[a-z]*.py"))
    if path.stem not in FRONT_DOOR
]
OWN_TESTS = {
    "test_compensators",
    "test_contacts",
    "test_run_limits",
    *(f"test_{name.split('.')[1]}" for name in CHECKED),
}
OWN_TESTS -= {"test_rollout"}  # the longest; other tests check the shapes of the same modules
jaxtyping.install_import_hook([f"jaxhil.{name}" for name in CHECKED], "beartype.beartype")

# Time limits are useless on a shared machine, and a failing test must fail again.
hypothesis.settings.register_profile("jaxhil", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxhil")

KEPT = 1_000_000_000  # bytes of cached programs
# Modules that take longest; each worker begins with them, so that all workers end together.
LONG = ("test_notebooks", "test_rollout", "test_export", "test_c99", "test_cli", "test_identify")
LONG += ("test_sweep_commands", "test_six_axis_bundle", "test_bundle_checking", "test_c99_six_axes")


def pytest_configure(config):
    if (folder := cache_folder()) is not None and not hasattr(config, "workerinput"):
        forget_oldest(folder, KEPT)


def pytest_collection_modifyitems(items):
    """Sort the tests: modules with the same compiler options together, and the longest of these first."""
    items.sort(
        key=lambda item: (item.get_closest_marker("users_options") is None, item.path.stem not in LONG)
    )


@pytest.fixture(scope="module", autouse=True)
def _laws_of_the_package_alone():
    """Remove user-registered laws at the end of each module."""
    import jaxhil.rig
    from jaxhil.contact.laws import CONTACT_LAWS
    from jaxhil.laws.compensators import COMPENSATORS

    tables = (COMPENSATORS, CONTACT_LAWS, jaxhil.rig.COMPENSATORS)
    before = [dict(table) for table in tables]
    yield
    for table, entries in zip(tables, before, strict=True):
        table.clear()
        table.update(entries)


@pytest.fixture(scope="session", autouse=True)
def _traced():
    """Trace programs with shape checks instead of loading programs cached by an earlier process."""
    from jaxhil.simulation import cached_programs

    cached_programs.load_or_lower = lambda identity, build, arguments, folder: build


@pytest.fixture(scope="module", autouse=True)
def _shapes_checked(request):
    everyday = "not slow" in request.config.option.markexpr
    jaxtyping.config.update("jaxtyping_disable", everyday and request.node.path.stem not in OWN_TESTS)


@pytest.fixture(scope="module", autouse=True)
def _compiled(request):
    everyday = "not slow" in request.config.option.markexpr
    compile_quickly(everyday and request.node.get_closest_marker("users_options") is None)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    """Return headless Chromium; skip the test if Chromium is not installed."""
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("no Chromium")
    browser = Browser(tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


# Verdicts of JSON documents by exit code.
VERDICTS = {0: ("good", "unknown"), 1: ("bad",), 2: ("unusable input",), 130: ("interrupted",)}


class Ran(NamedTuple):
    """Exit code, standard output and standard error of a command."""

    code: int
    out: str
    err: str

    @property
    def document(self):
        """Return the JSON document on standard output, and check its schema and verdict."""
        document = json.loads(self.out, parse_constant=pytest.fail)
        if "$schema" not in document:  # a JSON Schema is no result
            assert document["schema"].startswith("jaxhil/"), document["schema"]
            assert document["verdict"] in VERDICTS[self.code], (document["verdict"], self.code)
        return document


@pytest.fixture
def jaxhil(capsys):
    """Return a function that runs `jaxhil ARGUMENTS` in this process."""
    # This import must follow the installation of the import hook for shape checks.
    from tuning.__main__ import main

    def call(*arguments):
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = stop.code
        return Ran(code, *capsys.readouterr())

    return call


@pytest.fixture
def written(tmp_path):
    """Return a function that writes bytes or text to a mechanism file and returns the path."""

    def write(content):
        path = tmp_path / "rig.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write
