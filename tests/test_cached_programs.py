"""Compiled programs cached in files: same bits, no second tracing, and rebuilt after any change."""

import dataclasses
import errno
import importlib
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import programs_of

from jaxhil.contact.laws import HuntCrossley, KelvinVoigt
from jaxhil.files import read_checksummed
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load, load_any
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation import cached_programs, one_axis, source_fingerprint
from jaxhil.simulation.cached_programs import load_or_lower
from jaxhil.simulation.compile_cache import EXECUTABLE_SUFFIX
from jaxhil.simulation.jax_environment import CACHE_VARIABLE, TICK_OPTIONS, program_folder
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.scenario import build_scenarios
from jaxhil.sixdof.building import build_scenarios as six_axes_scenarios

pytestmark = pytest.mark.users_options
where_kept = pytest.mark.skipif(
    jax.__version_info__ < (0, 10), reason="older ones do not tell of the processor"
)


class Sums(NamedTuple):
    total: jax.Array
    parts: tuple[jax.Array, ...]


class Mine(KelvinVoigt):
    """User-registered compensator."""


traced = []


def sums(static, values, more) -> Sums:
    traced.append(static)
    factor = 2.0 if isinstance(static[0], KelvinVoigt) else 3.0
    return Sums(jnp.sum(factor * values) + static[1], (values * more["factor"],))


def calls_back(static, values):
    traced.append(static)
    return jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((4,), float), values)


STATIC = (KelvinVoigt(), 1)
VALUES = np.array([1.0, 2.0, 4.0, 8.0])


@pytest.fixture(autouse=True)
def as_for_users(monkeypatch):
    monkeypatch.setattr(cached_programs, "load_or_lower", load_or_lower)
    monkeypatch.setattr(cached_programs, "program_folder", program_folder)
    traced.clear()
    yield
    cached_programs._programs.clear()


def run(folder, static=STATIC, values=VALUES, options=TICK_OPTIONS, function=sums):
    """Run the program as a new process would."""
    cached_programs._programs.clear()
    cached_programs.program_folder = lambda: folder
    more = ({"factor": jnp.array(3.0)},) if function is sums else ()
    return cached_programs.run_cached(function, static, jnp.asarray(values), *more, options=options)


def check(result, total=31.0):
    assert isinstance(result, Sums) and float(result.total) == total
    np.testing.assert_array_equal(result.parts[0], 3 * VALUES)


@where_kept
def test_cached_program_is_traced_once_and_gives_results_of_uncached_program(tmp_path):
    check(run(None))
    assert len(traced) == 1
    for _ in range(3):
        check(run(tmp_path))
    assert len(traced) == 2 and len(list(tmp_path.iterdir())) == 1


@where_kept
def test_program_with_code_from_compile_cache_is_also_cached(tmp_path):
    """Guard against a jax limitation: such code cannot be loaded after serialisation."""
    for name in ("first", "second"):
        folder = tmp_path / name
        folder.mkdir()
        check(run(folder))
        check(run(folder))
    assert len(traced) == 2


@where_kept
@pytest.mark.parametrize("spoil", [lambda content: b"", lambda content: content[:-100], lambda c: b"no" + c])
def test_damaged_cached_program_is_rebuilt(tmp_path, spoil):
    run(tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    file.write_bytes(spoil(whole))
    check(run(tmp_path))
    assert len(traced) == 2 and file.read_bytes()[:64] == whole[:64]


@where_kept
@pytest.mark.parametrize("number", [10, pytest.param(1000, marks=pytest.mark.slow)])
def test_corrupted_program_file_is_replaced_and_result_is_unchanged(tmp_path, number):
    run(tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for bit in np.random.default_rng(0).integers(0, 8 * len(whole), number):
        traced.clear()
        harmed = bytearray(whole)
        harmed[bit // 8] ^= 1 << int(bit % 8)
        file.write_bytes(harmed)
        check(run(tmp_path))
        assert traced and read_checksummed(file) is not None


@where_kept
def test_cached_program_without_compiled_code_is_rebuilt(tmp_path):
    run(tmp_path)
    for file in Path(str(program_folder())).glob(f"jit_sums-*{EXECUTABLE_SUFFIX}"):
        file.unlink()
    check(run(tmp_path))
    assert len(traced) == 2
    check(run(tmp_path))
    assert len(traced) == 2


@where_kept
def test_cached_program_is_rebuilt_if_any_dependency_changes(tmp_path, monkeypatch):
    check(run(tmp_path))
    check(run(tmp_path, (HuntCrossley(), 1)), 46.0)
    check(run(tmp_path, (KelvinVoigt(), 2)), 32.0)
    assert float(run(tmp_path, values=VALUES[:2]).total) == 7.0
    check(run(tmp_path, options={}))
    with jax.default_matmul_precision("highest"):
        check(run(tmp_path))
    monkeypatch.setattr(cached_programs, "dependency_versions", lambda: {"jax": "another"})
    check(run(tmp_path))
    monkeypatch.setattr(cached_programs, "dependency_versions", source_fingerprint.dependency_versions)
    monkeypatch.setattr(cached_programs, "active_xla_flags", lambda: "--xla_cpu_enable_fast_min_max=true")
    check(run(tmp_path))
    assert len(traced) == len(list(tmp_path.iterdir())) == 8


@where_kept
@pytest.mark.parametrize("changed", ["jaxhil", "tuning"])
def test_cached_program_is_rebuilt_if_source_code_changes(tmp_path, monkeypatch, changed):
    folder = tmp_path / "kept"
    folder.mkdir()
    importlib.import_module("tuning")
    run(folder)
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("changed = True\n")
    monkeypatch.setattr(importlib.import_module(changed), "__file__", str(package / "__init__.py"))
    check(run(folder))
    assert len(traced) == 2


def test_program_with_user_registered_compensator_is_not_cached(tmp_path):
    for _ in range(2):
        check(run(tmp_path, (Mine(), 1)))
    assert len(traced) == 2 and not list(tmp_path.iterdir())


def test_program_with_callback_into_python_is_not_cached(tmp_path):
    for _ in range(2):
        np.testing.assert_array_equal(run(tmp_path, function=calls_back), 2 * VALUES)
    assert len(traced) == 2 and not list(tmp_path.iterdir())


def test_program_is_not_cached_if_jax_does_not_name_the_processor(tmp_path, monkeypatch):
    def raise_missing(identity):
        raise AttributeError

    monkeypatch.setattr(cached_programs, "_hash_program", raise_missing)
    for _ in range(2):
        check(run(tmp_path))
    assert len(traced) == 2 and not list(tmp_path.iterdir())


def test_program_with_unwritable_cache_folder_still_returns_its_result(tmp_path):
    check(run(tmp_path / "missing"))


def test_cached_program_is_rebuilt_if_jax_settings_change_between_calls(tmp_path, monkeypatch):
    """Use a single process, which keeps the cached program in memory."""
    monkeypatch.setattr(cached_programs, "program_folder", lambda: tmp_path)
    again = partial(cached_programs.run_cached, sums, STATIC, jnp.asarray(VALUES), {"factor": jnp.array(3.0)})
    for precision in ("highest", "default"):
        with jax.default_matmul_precision(precision):
            check(again())
            check(again())
    assert len(traced) == 2


def phases(static, scenarios):
    traced.append(static)
    return 2 * scenarios.duration


@pytest.mark.parametrize("law", [Mine(), pytest.param(HuntCrossley(), marks=where_kept)])
def test_program_with_user_registered_law_in_its_arguments_is_not_cached(tmp_path, monkeypatch, law):
    scenarios = six_axes_scenarios(load_any("petals").mechanism)
    groups = tuple(dataclasses.replace(group, law=law) for group in scenarios.groups)
    monkeypatch.setattr(cached_programs, "program_folder", lambda: tmp_path)
    for _ in range(2):
        cached_programs._programs.clear()
        cached_programs.run_cached(phases, 1, scenarios._replace(groups=groups))
    assert (len(traced), len(list(tmp_path.iterdir()))) == ((2, 0) if isinstance(law, Mine) else (1, 1))


def test_user_defined_named_tuple_counts_as_user_object_in_program_arguments():
    assert cached_programs.has_user_objects((1, Sums(1, (2,))))  # pyright: ignore[reportArgumentType]
    assert not cached_programs.has_user_objects((1, ("two", None, KelvinVoigt())))


def test_all_external_calls_of_a_program_are_found():
    text = """%0 = stablehlo.custom_call @lapack_dpotrf_ffi(%1)
    %2 = stablehlo.custom_call @xla.sdy.Sharding(%0)
    %3 = stablehlo.custom_call @"my-own, one"(%2) %4 = stablehlo.custom_call @cu$other(%3)"""
    assert cached_programs.find_calls(text) == {
        "lapack_dpotrf_ffi",
        "xla.sdy.Sharding",
        "my-own, one",
        "cu$other",
    }


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "full"), TypeError("cannot pickle"), KeyError("private")]
)
@pytest.mark.parametrize("step", ["remove_stale", "_serialise_program", "write_checksummed"])
def test_program_that_cannot_be_cached_still_returns_its_result(tmp_path, monkeypatch, step, error):
    def fails(*arguments, **named):
        raise error

    monkeypatch.setattr(cached_programs, step, fails)
    check(run(tmp_path))
    assert not list(tmp_path.iterdir())


SOLVES = """
import sys
from functools import partial
from pathlib import Path
from jaxhil.simulation.jax_environment import prepare_jax
prepare_jax()
import jax, jax.numpy as jnp, numpy as np
from jaxhil.simulation import cached_programs
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
def solved(static, matrix):
    print("traced")
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), jnp.ones(2))
print(cached_programs.run_cached(solved, 1, np.diag([4.0, 0.5])))
"""


@pytest.mark.slow
@where_kept
def test_cached_linear_solve_runs_in_process_that_traces_nothing(tmp_path):
    script = tmp_path / "solves.py"
    script.write_text(SOLVES)
    run = partial(subprocess.run, [sys.executable, str(script)], capture_output=True, text=True, check=True)
    outputs = [run(env={**os.environ, CACHE_VARIABLE: str(tmp_path)}).stdout for _ in range(2)]
    assert outputs == ["traced\n[0.25 2.  ]\n", "[0.25 2.  ]\n"]


@where_kept
@pytest.mark.parametrize("lanes", [(), (20,)])
def test_batch_from_cached_program_is_bit_identical_and_not_recompiled(tmp_path, monkeypatch, lanes):
    mechanism = load("varying").mechanism
    scenarios = build_scenarios(mechanism, draw(mechanism, 20, 0))
    loop = build_loop(mechanism, "phase_lead", scenarios)
    gains = {name: np.full(lanes, value) for name, value in literature_gains(mechanism, "phase_lead").items()}
    wanted = one_axis.evaluate(loop, gains, scenarios)
    monkeypatch.setattr(cached_programs, "program_folder", lambda: str(tmp_path))
    made = []
    for _ in range(3):
        cached_programs._programs.clear()
        outcome = one_axis.evaluate(loop, gains, scenarios)
        jax.tree.map(np.testing.assert_array_equal, outcome, wanted)
        made.append(programs_of("run_tiles"))
    assert made[0] == made[1] == made[2] > 0
