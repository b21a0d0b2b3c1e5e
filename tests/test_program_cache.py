"""Compiled programs cached in files: same numbers, traced once, rebuilt if a dependency changes."""

import os
import sys
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import is_quick
from jax.sharding import AxisType, PartitionSpec

from jaxhil.contact.laws import HuntCrossley, KelvinVoigt
from jaxhil.files import read_checksummed
from tuning.caches import program_cache

pytestmark = pytest.mark.users_options


class Sums(NamedTuple):
    total: jax.Array
    parts: jax.Array


traced = []


def sums(static, arguments) -> Sums:
    traced.append(static)
    factor = 2.0 if isinstance(static[0], KelvinVoigt) else 3.0

    def one_device(values):
        return factor * values

    mesh = jax.make_mesh((2,), ("device",), axis_types=(AxisType.Auto,), devices=jax.devices()[:2])
    sharding = PartitionSpec("device")
    parts = jax.shard_map(one_device, mesh=mesh, in_specs=sharding, out_specs=sharding)(arguments["values"])
    return Sums(jnp.sum(parts) + static[1], parts)


STATIC = (KelvinVoigt(), 1)
VALUES = {"values": np.array([1.0, 2.0, 4.0, 8.0])}


@pytest.fixture(autouse=True)
def forgetful():
    program_cache._load_or_build_program.cache_clear()
    traced.clear()


def run(folder, static=STATIC, arguments=VALUES):
    """Run the program as a new process would."""
    program_cache._load_or_build_program.cache_clear()
    result = program_cache.run_program(sums, static, arguments, folder)
    return float(result.total), np.asarray(result.parts)


def test_cached_programs_are_those_that_users_run():
    assert not is_quick()
    assert "xla_cpu_small_while_loop_byte_threshold" in os.environ["XLA_FLAGS"]


def test_program_is_traced_once_and_gives_same_numbers(tmp_path):
    plain = run(None)
    assert len(traced) == 1
    first, second = run(tmp_path), run(tmp_path)
    assert len(traced) == 2 and len(list(tmp_path.iterdir())) == 1
    for total, parts in (plain, first, second):
        assert total == 31.0
        np.testing.assert_array_equal(parts, 2 * VALUES["values"])


@pytest.mark.parametrize("spoil", [lambda content: b"", lambda content: content[:-1000], lambda c: b"no" + c])
def test_damaged_program_file_is_rebuilt(tmp_path, spoil):
    run(tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    file.write_bytes(spoil(whole))
    assert run(tmp_path)[0] == 31.0
    assert len(traced) == 2 and file.stat().st_size == len(whole)


def check_flips(folder, number, seed):
    run(folder)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    for bit in np.random.default_rng(seed).integers(0, 8 * len(whole), number):
        traced.clear()
        harmed = bytearray(whole)
        harmed[bit // 8] ^= 1 << int(bit % 8)
        file.write_bytes(harmed)
        total, parts = run(folder)
        assert total == 31.0 and traced
        np.testing.assert_array_equal(parts, 2 * VALUES["values"])
        assert read_checksummed(file) is not None


def test_program_file_with_flipped_bit_costs_only_tracing_time(tmp_path):
    check_flips(tmp_path, 10, seed=0)


@pytest.mark.slow
def test_program_file_with_thousand_flipped_bits_costs_only_tracing_time(tmp_path):
    check_flips(tmp_path, 1000, seed=1)


def test_program_is_another_for_other_statics_and_shapes(tmp_path):
    assert run(tmp_path)[0] == 31.0
    assert run(tmp_path, (HuntCrossley(), 1))[0] == 46.0
    assert run(tmp_path, (KelvinVoigt(), 2))[0] == 32.0
    assert run(tmp_path, arguments={"values": np.array([1.0, 2.0])})[0] == 7.0
    assert len(list(tmp_path.iterdir())) == 4


def test_program_is_rebuilt_if_sources_change(tmp_path, monkeypatch):
    run(tmp_path)
    package = tmp_path / "package"
    package.mkdir()
    (package / "__init__.py").write_text("changed = True\n")
    monkeypatch.setattr(sys.modules["tuning"], "__file__", str(package / "__init__.py"))
    run(tmp_path)
    assert len(traced) == 2


def test_program_of_user_registered_law_is_not_cached(tmp_path):
    class Mine(KelvinVoigt):
        pass

    class Holder(eqx.Module):
        law: eqx.Module = eqx.field(static=True)

    assert run(tmp_path, (Mine(), 1))[0] == 31.0
    run(tmp_path, (KelvinVoigt(), 1, Holder(KelvinVoigt())))
    assert not list(tmp_path.iterdir())


def test_program_cache_in_unwritable_folder_costs_no_result(tmp_path):
    assert run(tmp_path / "missing")[0] == 31.0
