"""Compiled programs that are kept: sealed, read as written or compiled anew, without a word."""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import programs_of
from jax.experimental.compilation_cache import compilation_cache

from jaxhil.files import read_sealed
from jaxhil.simulation.compile_cache import ENDING, keep_sealed

VALUE = 1.75


@pytest.fixture
def folder(tmp_path):
    """What jax compiles is kept there, and nowhere else."""
    before = jax.config.jax_compilation_cache_dir
    assert keep_sealed(tmp_path)
    compilation_cache.reset_cache()
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    yield tmp_path
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()


def kept_sum(x):
    return jnp.sum(jnp.sin(x * jnp.arange(100.0)))


def compute():
    """As a new process would."""
    jax.clear_caches()
    return float(jax.jit(kept_sum)(VALUE))


def flipped(content, bit):
    harmed = bytearray(content)
    harmed[bit // 8] ^= 1 << int(bit % 8)
    return bytes(harmed)


def check_flips(folder, number, seed):
    """Flip a bit, compute, again and again: the same number, and the file is good again."""
    expected = compute()
    (file,) = (path for path in folder.iterdir() if "kept_sum" in path.name)
    whole = file.read_bytes()
    for bit in np.random.default_rng(seed).integers(0, 8 * len(whole), number):
        file.write_bytes(flipped(whole, bit))
        assert read_sealed(file) is None
        assert compute() == expected
        assert read_sealed(file) is not None


def test_a_program_is_kept_sealed_and_found_again(folder):
    expected = compute()
    files = {path: path.stat().st_ino for path in folder.iterdir()}
    assert files and all(path.name.endswith(ENDING) and read_sealed(path) for path in files)
    made = programs_of("kept_sum")
    assert compute() == expected and programs_of("kept_sum") == made + 1
    # Read, not compiled and written.
    assert {path: path.stat().st_ino for path in folder.iterdir()} == files


def test_a_flipped_bit_costs_only_the_time_to_compile(folder):
    check_flips(folder, 10, seed=0)


@pytest.mark.slow
def test_a_thousand_flipped_bits_cost_only_the_time_to_compile(folder):
    check_flips(folder, 1000, seed=1)


def test_no_flipped_bit_of_a_kept_program_is_read(folder):
    compute()
    file = next(folder.iterdir())
    whole = file.read_bytes()
    for bit in np.random.default_rng(2).integers(0, 8 * len(whole), 1000):
        file.write_bytes(flipped(whole, bit))
        assert read_sealed(file) is None


@pytest.mark.parametrize("there", ["link", "pipe", "cut"])
def test_what_is_no_program_is_done_without(folder, tmp_path_factory, there):
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


def test_without_a_place_for_it_nothing_is_kept(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "jax._src.compilation_cache_interface", None)
    assert not keep_sealed(tmp_path)
