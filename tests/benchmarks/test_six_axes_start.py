"""CPU time until the first six-axis result: the first `jaxhil simulate`, and programs of many shape pairs.

Run with `pytest -m benchmark -s tests/benchmarks/test_six_axes_start.py`.
"""

import os
import resource
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxhil.mechanism.file import load_any
from jaxhil.simulation.jax_environment import SINGLE_RUN_OPTIONS, supported_options
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.metrics import evaluate

pytestmark = pytest.mark.benchmark
COLD, WARM = 12.0, 4.0  # s
FORWARD, DERIVATIVES = 15.0, 45.0  # s
BUILT_IN = ("probe-drogue", "petals", "ring-capture", "claw-two-arms", "hydraulic-hexapod")


def seconds_of(name, folder):
    """Return the CPU time [s] of one command."""
    ours = {key: value for key, value in os.environ.items() if key not in ("XLA_FLAGS", "NPROC")}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "tuning", "simulate", name]
    subprocess.run(command, env=ours | {"JAXHIL_CACHE": str(folder)}, stdout=subprocess.DEVNULL, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize("name", BUILT_IN)
def test_first_six_axis_simulate_command_is_within_time_limit(name, tmp_path, capsys):
    cold, warm = (seconds_of(name, tmp_path) for _ in range(2))
    with capsys.disabled():
        print(f"\n{name}: first simulate {cold:.1f} s, then {warm:.1f} s of the processor")
    assert cold <= COLD and warm <= WARM


@pytest.fixture
def no_compile_cache():
    """Disable the compile cache."""
    folder = jax.config.jax_compilation_cache_dir
    for now in (None, folder):
        jax.config.update("jax_compilation_cache_dir", now)
        compilation_cache.reset_cache()
        if now is None:
            yield


@pytest.mark.usefixtures("no_compile_cache")
def test_six_axis_program_of_twelve_shape_pairs_compiles_within_time_limit(capsys):
    """Compile pairs of two kinds, first without, then with derivatives with respect to six leads."""
    mechanism = load_any("petals", []).mechanism
    scenario = build_scenarios(mechanism)
    assert sum(group.parameters.damping.shape[0] for group in scenario.groups) == 12
    loop = make_loop(mechanism, "phase_lead_per_axis", scenario)

    def errors(leads):
        axes = ("x", "y", "z", "rx", "ry", "rz")
        gains = {f"phase_lead_{axis}": leads[index] for index, axis in enumerate(axes)}
        gains |= {f"lag_lead_{axis}": jnp.array(0.0) for axis in axes} | {"lead_filter": jnp.array(1e-3)}
        metrics = evaluate(loop, gains, scenario).metrics
        return jnp.stack([metrics.energy_error, metrics.twist_error])

    for what, function, bar in (
        ("figures", errors, FORWARD),
        ("with derivatives", jax.jacfwd(errors), DERIVATIVES),
    ):
        started = time.process_time()
        jax.jit(function, compiler_options=supported_options(SINGLE_RUN_OPTIONS)).lower(
            jnp.full(6, 2e-3)
        ).compile()
        took = time.process_time() - started
        with capsys.disabled():
            print(f"\ntwelve candidates, {what}: compiled in {took:.1f} s of the processor")
        assert took <= bar
