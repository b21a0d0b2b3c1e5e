"""Comparison of the C++ baseline with the JAX simulation: equal contacts, so that speeds are comparable."""

import os
import subprocess

import jax
import numpy as np
import pytest
from baseline import FLAGS, KINDS, RESULTS, SOURCE, compile_baseline

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop import build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import NOT_REACHED, OK
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios

pytestmark = pytest.mark.benchmark

LANES = 61  # not a multiple of any block size


@pytest.fixture(scope="module")
def baseline():
    built = compile_baseline()
    if built is None:
        pytest.skip("no g++ on this machine: the C++ baseline cannot be built")
    return built


def case(compensator, overrides=()):
    mechanism = load("varying", overrides).mechanism
    scenario = build_scenarios(mechanism, draw(mechanism, LANES, seed=3))
    generator = np.random.default_rng(5)
    gains = {
        gain.name: gain.nominal(mechanism) * generator.uniform(0.9, 1.1, LANES)
        for gain in COMPENSATORS[compensator].gains
    }
    if "forgetting" in gains:
        gains["forgetting"] = generator.uniform(0.95, 1.0, LANES)
        gains["initial_stiffness"] = generator.uniform(0, 5e4, LANES)
        gains["initial_damping"] = generator.uniform(0, 20, LANES)
    loop = build_loop(mechanism, compensator, scenario)
    return loop, gains, scenario, jax.jit(build_rig_constants, static_argnums=0)(loop, scenario)


@pytest.mark.parametrize("compensator", ["none", "phase_lead", "response_error"])
@pytest.mark.parametrize("threads", [1, 2])
def test_cpp_baseline_contacts_agree_with_jax_simulation(baseline, compensator, threads):
    loop, gains, scenario, rig = case(compensator)
    expected = jax.jit(rollout, static_argnums=0)(loop, gains, scenario)
    result = baseline.run(loop, rig, gains, scenario, int(np.max(expected.ticks)), threads)
    np.testing.assert_array_equal(result["status"], expected.status)
    # A contact that sticks until its timeout is dominated by rounding, so its numbers are not compared.
    ended = np.asarray(expected.status) == OK
    assert np.mean(ended[: scenario.contacts[0]]) > 0.85
    for name in RESULTS:
        np.testing.assert_allclose(
            result[name][ended],
            np.asarray(getattr(expected, name))[ended],
            rtol=1e-11,
            err_msg=name,
        )


def test_cpp_baseline_has_the_same_first_contact_in_modes_of_one_and_many_contacts(baseline):
    loop, gains, scenario, rig = case("response_error")
    contacts = baseline.run(loop, rig, gains, scenario, 3000)
    bare = baseline.run_ticks(loop, rig, gains, scenario, 3000)
    for name in RESULTS:
        np.testing.assert_allclose(bare[name][0], contacts[name][0], rtol=1e-12, err_msg=name)
    assert np.all(bare["status"][1:] == NOT_REACHED)


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="the report is that of g++ on Linux")
def test_cpp_baseline_is_vectorised_for_every_compensator():
    source = SOURCE.read_text().splitlines()
    (line,) = (n for n, text in enumerate(source, 1) if "const double x = b.position[l], v" in text)
    report = subprocess.run(
        ["g++", *FLAGS, "-fopt-info-vec-optimized", "-c", str(SOURCE), "-o", os.devnull],
        capture_output=True, text=True, check=True,
    ).stderr  # fmt: skip
    loops = [
        one for one in report.splitlines() if f"{SOURCE.name}:{line - 1}:" in one and "loop vectorized" in one
    ]
    assert len(loops) == len(KINDS)


def test_cpp_baseline_rejects_zero_order_hold(baseline):
    loop, gains, scenario, rig = case("none", ["rig.command_hold=zoh"])
    with pytest.raises(ValueError, match="linear hold"):
        baseline.run(loop, rig, gains, scenario, 10)


def test_cpp_baseline_rejects_delay_longer_than_its_delay_lines(baseline):
    loop, gains, scenario, rig = case("response_error")
    gains["identification_delay"] = np.asarray(loop.ring * scenario.control_period)
    with pytest.raises(ValueError, match=f"delays: found {loop.ring} periods"):
        baseline.run(loop, rig, gains, scenario, 10)
