"""Compiler options that other XLA versions may lack, and use of half of the cores."""

import os

import jax
import numpy as np
import pytest

from jaxhil.simulation import jax_environment
from jaxhil.simulation.jax_environment import ROLLOUT_OPTIONS, supported_options, use_half_the_cores


def test_compiler_options_unknown_to_xla_are_omitted():
    unknown = {"xla_cpu_no_such_option": 1}
    assert supported_options({**ROLLOUT_OPTIONS, **unknown}) == ROLLOUT_OPTIONS
    assert supported_options(unknown) == {}
    # With the unknown option, compilation fails.
    with pytest.raises(jax.errors.JaxRuntimeError):
        jax.jit(lambda x: x + 1, compiler_options=unknown)(np.ones(3))


def test_llvm_option_is_set_only_for_jaxlib_versions_that_support_it(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    for version, expected in (("0.10.7", True), ("0.11.0", False), ("0.100.0", False)):
        monkeypatch.setattr(jax_environment, "version", lambda name, version=version: version)
        assert (jax_environment.FULL_UNROLL_OPTION in jax_environment.build_xla_flags("")) == expected


AFFINITY = pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the system cannot be told")


@AFFINITY
def test_cpu_affinity_is_restored_after_use_of_half_the_cores():
    usable = os.sched_getaffinity(0)
    halves = []
    for half in (0, 1):
        with pytest.raises(ZeroDivisionError), use_half_the_cores(half):
            halves.append(os.sched_getaffinity(0))
            raise ZeroDivisionError
        assert os.sched_getaffinity(0) == usable
    assert halves[0] | halves[1] == usable
    assert len(usable) == 1 or not halves[0] & halves[1]


@AFFINITY
def test_all_cores_are_used_if_cpu_affinity_cannot_be_set(monkeypatch):
    def forbidden(*_):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setaffinity", forbidden)
    with use_half_the_cores(0):
        pass
