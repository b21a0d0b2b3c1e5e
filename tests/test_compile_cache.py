"""Cache of compiled programs: a checksummed file is read unchanged or silently recompiled."""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import programs_of
from jax.experimental.compilation_cache import compilation_cache

from jaxhil.files import read_checksummed
from jaxhil.simulation.compile_cache import EXECUTABLE_SUFFIX, use_checksummed_cache

VALUE = 1.75


@pytest.fixture
def folder(tmp_path):
    """Set the folder of JAX's compile cache."""
    before = jax.config.jax_compilation_cache_dir
    assert use_checksummed_cache(tmp_path)
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def kept_sum(x):
    return jnp.sum(jnp.sin(x * jnp.arange(100.0)))


def compute():
    """Compute `kept_sum(VALUE)` as in a new process."""
    jax.clear_caches()
    return float(jax.jit(kept_sum)(VALUE))


def flipped(content, bit):
    harmed = bytearray(content)
    harmed[bit // 8] ^= 1 << int(bit % 8)
    return bytes(harmed)


def check_flips(folder, number, seed):
    """Repeatedly flip a bit and check that the value is unchanged and the file is repaired."""
    expected = compute()
    (file,) = (path for path in folder.iterdir() if "kept_sum" in path.name)
    whole = file.read_bytes()
    for bit in np.random.default_rng(seed).integers(0, 8 * len(whole), number):
        file.write_bytes(flipped(whole, bit))
        assert read_checksummed(file) is None
        assert compute() == expected
        assert read_checksummed(file) is not None


def test_compile_cache_stores_and_reuses_checksummed_programs(folder):
    expected = compute()
    files = {path: path.stat().st_ino for path in folder.iterdir()}
    assert files and all(path.name.endswith(EXECUTABLE_SUFFIX) and read_checksummed(path) for path in files)
    made = programs_of("kept_sum")
    assert compute() == expected and programs_of("kept_sum") == made + 1
    # The program was read, not compiled and written again.
    assert {path: path.stat().st_ino for path in folder.iterdir()} == files


def test_compile_cache_recompiles_after_a_flipped_bit(folder):
    check_flips(folder, 10, seed=0)


@pytest.mark.slow
def test_compile_cache_recompiles_after_each_of_1000_flipped_bits(folder):
    check_flips(folder, 1000, seed=1)


def test_compile_cache_rejects_every_flipped_bit(folder):
    compute()
    file = next(folder.iterdir())
    whole = file.read_bytes()
    for bit in np.random.default_rng(2).integers(0, 8 * len(whole), 1000):
        file.write_bytes(flipped(whole, bit))
        assert read_checksummed(file) is None


@pytest.mark.parametrize("there", ["link", "pipe", "cut"])
def test_compile_cache_ignores_links_pipes_and_truncated_files(folder, tmp_path_factory, there):
    expected = compute()
    (file,) = (path for path in folder.iterdir() if "kept_sum" in path.name)
    whole = file.read_bytes()
    file.unlink()
    if there == "pipe":
        os.mkfifo(file)
    elif there == "cut":
        file.write_bytes(whole[: len(whole) // 2])
    else:
        elsewhere = tmp_path_factory.mktemp("elsewhere") / "thesis"
        elsewhere.write_bytes(b"years")
        file.symlink_to(elsewhere)
    assert compute() == expected
    if there == "link":
        assert file.is_symlink() and elsewhere.read_bytes() == b"years"


def test_compile_cache_is_disabled_without_jax_interface(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "jax._src.compilation_cache_interface", None)
    assert not use_checksummed_cache(tmp_path)
