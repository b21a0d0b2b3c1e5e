"""Lowering of rollout and derivatives for CUDA, without callbacks; CPU compiler options for CPUs only."""

import re

import jax
import numpy as np
import pytest
from jax import export

from jaxhil.laws.compensators import COMPENSATORS, SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.rig_models import choose_rig_model
from jaxhil.simulation import cached_programs, jax_environment, tile_size
from jaxhil.simulation.evaluation import place_gains, run_tiles
from jaxhil.simulation.jax_environment import ROLLOUT_OPTIONS, build_xla_flags, supported_options
from tuning.gains.multistart_solver import MIN_PROBLEMS_PER_CALL, lower_solver
from tuning.gains.tasks import build_task

LEVEL = "--xla_backend_optimization_level"
CHOLESKY = {"cusolver_potrf_ffi"}
LINEAR_EQUATIONS = {"cusolver_getrf_ffi", "cu_lu_pivots_to_permutation"}
ONE_AXIS = [(name, law) for law in COMPENSATORS for name in ("varying", "suite-rattling")]


def calls(function, *arguments):
    """Return the names of all external functions that a program calls when lowered for CUDA."""
    lowered = export.export(jax.jit(function), platforms=["cuda"])(*arguments)
    assert lowered.platforms == ("cuda",)
    assert not lowered.ordered_effects and not lowered.unordered_effects
    return set(re.findall(r"custom_call @(\w+)", lowered.mlir_module()))


def case(name, compensator):
    mechanism = load_any(name).mechanism
    model = choose_rig_model(mechanism)
    scenarios = model.scenarios(mechanism)
    return (
        model,
        model.loop(mechanism, compensator, scenarios),
        literature_gains(mechanism, compensator),
        scenarios,
    )


def batch(name, compensator):
    """Return the external calls of a rollout batch on all devices, with one tile per device."""
    model, loop, gains, scenarios = case(name, compensator)
    placed = model.place_batch(scenarios, 4096, loop)
    assert placed.scenarios.control_period.shape == (jax.device_count(), 1, 4096 // jax.device_count())
    return calls(
        lambda *parts: run_tiles((model, loop), *parts), *place_gains(placed, gains), placed.scenarios
    )


@pytest.fixture(autouse=True)
def _accelerator(monkeypatch):
    """Divide batches into tiles as on an accelerator, with all lanes of a device in one tile."""
    device = tile_size.DeviceDescription(is_cpu=False, memory=80 << 30)
    monkeypatch.setattr(tile_size, "describe_devices", lambda: device)


def jacobian(name, compensator):
    """Return the external calls in the derivatives of tuning errors with respect to all gains."""
    model, loop, gains, scenarios = case(name, compensator)

    def errors(values, scenarios):
        rig = model.prepared(loop, scenarios)
        return model.outcome(loop, dict(zip(gains, values, strict=True)), rig).error

    return calls(jax.jacfwd(errors), np.array([*gains.values()], float), scenarios)


def test_rollout_batch_lowers_for_cuda_without_external_calls():
    assert batch("varying", "none") == set()


def test_tuning_program_lowers_for_cuda(monkeypatch):
    programs = []
    monkeypatch.setattr(cached_programs, "lower_cached", lambda *program, options: programs.append(program))
    lower_solver([build_task(load_any("varying").mechanism, "phase_lead", 4, 0)], starts=1)
    ((function, static, arguments),) = programs
    assert static[-1] == MIN_PROBLEMS_PER_CALL  # all problems of the call in one tile
    result = calls(lambda arguments: tuple(function(static, arguments)), arguments)
    assert result == CHOLESKY


def test_python_callback_in_lowered_program_is_detected():
    like = jax.ShapeDtypeStruct((), float)
    with pytest.raises(ValueError, match="different from the lowering platform cuda"):
        calls(lambda x: jax.pure_callback(np.sin, like, x), 1.0)
    assert calls(lambda x: jax.scipy.linalg.expm(x), np.eye(2)) != set()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "compensator"), ONE_AXIS)
def test_every_compensator_and_derivatives_lower_for_cuda(name, compensator):
    assert batch(name, compensator) == set()
    assert jacobian(name, compensator) == set()


@pytest.mark.slow
@pytest.mark.parametrize("compensator", SIX_AXIS_COMPENSATORS)
def test_six_axis_rollout_and_derivatives_lower_for_cuda(compensator):
    assert batch("probe-drogue", compensator) <= LINEAR_EQUATIONS
    assert jacobian("probe-drogue", compensator) <= LINEAR_EQUATIONS


def test_cpu_compiler_options_are_passed_only_to_cpu_compiler(monkeypatch):
    assert supported_options(ROLLOUT_OPTIONS) == ROLLOUT_OPTIONS
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert supported_options(ROLLOUT_OPTIONS) == {}


@pytest.mark.parametrize(
    ("plugin", "platforms", "given"), ((None, "", True), ("there", "", False), ("there", "cpu", True))
)
def test_reduced_optimisation_flag_is_set_only_if_jax_uses_cpus_alone(monkeypatch, plugin, platforms, given):
    """An installed jax plugin may provide a graphics card, unless JAX_PLATFORMS excludes it."""
    monkeypatch.setattr(jax_environment, "find_spec", {"jax_plugins": plugin}.get)
    monkeypatch.setenv("JAX_PLATFORMS", platforms)
    assert (LEVEL in build_xla_flags("")) == given
