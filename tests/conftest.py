"""What every test runs under: float64, strict promotion, two host devices, checked shapes, quick compilation.
The command line, as tests call it."""

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

# Two devices wherever the tests run, and otherwise what users have.
os.environ["XLA_FLAGS"] = build_xla_flags(
    os.environ.get("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
)
os.environ["NPROC"] = build_jax_variables(os.environ)["NPROC"]

import hypothesis
import jax
import jaxtyping
import pytest
from compiling import compile_quickly, forget_oldest

# Compiled programs are kept: for the next run, for other workers, for kernels and commands that tests start.
FOLDER = "tests"
if (_cache := cache_folder()) is not None and _cache.name != FOLDER:
    os.environ[CACHE_VARIABLE] = str(_cache / FOLDER)
prepare_jax()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Shapes are checked in the modules that compute with arrays; every day, in their own tests alone: checked
# programs take a quarter longer to trace.
PACKAGES = ("compensators", "contact", "simulation", "sixdof")
# What a caller gives them, these check themselves.
FRONT_DOOR = ("gain_choice", "gain_file", "jacobian", "registration", "run")
CHECKED = [
    f"{package}.{path.stem}"
    for package in PACKAGES
    for path in sorted((Path(__file__).parent.parent / "jaxhil" / package).glob("[a-z]*.py"))
    if path.stem not in FRONT_DOOR
]
OWN_TESTS = {"test_compensators", "test_contacts", *(f"test_{name.split('.')[1]}" for name in CHECKED)}
OWN_TESTS -= {"test_rollout"}  # the longest; others run the same modules
jaxtyping.install_import_hook([f"jaxhil.{name}" for name in CHECKED], "beartype.beartype")

# A shared machine has no deadlines to keep, and a test that fails must fail again.
hypothesis.settings.register_profile("jaxhil", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxhil")

KEPT = 1_000_000_000  # bytes of programs
LONG = ("test_notebooks", "test_rollout")


def pytest_configure(config):
    if (folder := cache_folder()) is not None and not hasattr(config, "workerinput"):
        forget_oldest(folder, KEPT)


def pytest_collection_modifyitems(items):
    """The longest first, so that workers end together; then modules of a kind, which share programs."""
    items.sort(
        key=lambda item: (item.path.stem not in LONG, item.get_closest_marker("users_options") is None)
    )


@pytest.fixture(scope="module", autouse=True)
def _laws_of_the_package_alone():
    """What a module registers is gone when it is done."""
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
    """What is tested is traced, its shapes checked, and not run as a process before compiled it."""
    from jaxhil.simulation import cached_programs

    cached_programs.load_or_compile = lambda identity, build, arguments, folder: build()


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
    """Chromium without a screen; skips where there is none."""
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("no Chromium")
    browser = Browser(tmp_path_factory.mktemp("browser"))
    yield browser
    browser.close()


class Ran(NamedTuple):
    """Exit code, standard output, standard error."""

    code: int
    out: str
    err: str

    @property
    def document(self):
        return json.loads(self.out, parse_constant=pytest.fail)


@pytest.fixture
def jaxhil(capsys):
    """`jaxhil ARGUMENTS` in this process."""
    # After the import hook.
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
    """Writes bytes or text to a mechanism file and returns its path."""

    def write(content):
        path = tmp_path / "rig.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write
