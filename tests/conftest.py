"""What every test runs under: float64, strict promotion, two host devices, checked shapes, quick compilation.
The command line, as tests call it."""

import gc
import json
import os
from typing import NamedTuple

from tuning.environment import settings

# Two devices wherever the tests run, and otherwise what users have.
os.environ["XLA_FLAGS"] = settings(
    {"XLA_FLAGS": os.environ.get("XLA_FLAGS", "--xla_force_host_platform_device_count=2")}
)["XLA_FLAGS"]
os.environ["NPROC"] = settings(os.environ)["NPROC"]

import hypothesis
import jax
import pytest
from compiling import compile_quickly
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Shapes are checked where there are shapes: the modules that compute with arrays.
ARRAY_MODULES = ("compensators", "contact", "ring_buffer", "simulation")
install_import_hook([f"jaxhil.{name}" for name in ARRAY_MODULES], "beartype.beartype")

# A shared machine has no deadlines to keep, and a test that fails must fail again.
hypothesis.settings.register_profile("jaxhil", deadline=None, derandomize=True)
hypothesis.settings.load_profile("jaxhil")

# As in a command: tracing makes objects by the million, few of them in cycles.
gc.set_threshold(100_000, 50, 50)


def pytest_collection_modifyitems(items):
    """Modules of a kind side by side, so that they share the programs of single operations."""
    items.sort(key=lambda item: item.get_closest_marker("users_options") is None)


@pytest.fixture(scope="module", autouse=True)
def _compiled(request):
    everyday = "not slow" in request.config.option.markexpr
    compile_quickly(everyday and request.node.get_closest_marker("users_options") is None)


class Ran(NamedTuple):
    """Exit code, standard output, standard error."""

    code: int
    out: str
    err: str

    @property
    def document(self):
        return json.loads(self.out, parse_constant=pytest.fail)


@pytest.fixture
def no_cache(monkeypatch, tmp_path):
    """Compiled programs of tests are not kept: a folder below a file cannot be made."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAXHIL_CACHE", str(tmp_path / "file" / "cache"))


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
