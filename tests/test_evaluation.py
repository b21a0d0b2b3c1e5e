"""Evaluation of batches on every core: order, padding and tiles do not change results."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest
from compiling import programs_of

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.evaluation import TILE_SIZE
from jaxhil.simulation.jax_environment import DEVICE_COUNT_FLAG
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import ONE_AXIS, evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.gains.tune import neutralise_gains

pytestmark = pytest.mark.users_options


def setting(compensator="response_error", lanes=70, name="varying", seed=1, overrides=()):
    mechanism = load(name, overrides).mechanism
    scenarios = build_scenarios(mechanism, draw(mechanism, lanes, seed))
    gains = {g.name: float(g.nominal(mechanism)) for g in COMPENSATORS[compensator].gains}
    return build_loop(mechanism, compensator, scenarios), gains, scenarios


def lanes_of(scenarios, lanes):
    return type(scenarios)(*(take(leaf, lanes) for leaf in scenarios))


def take(leaf, lanes):
    if isinstance(leaf, tuple):
        return type(leaf)(*(take(part, lanes) for part in leaf))
    return None if leaf is None else np.asarray(leaf)[..., lanes]


def test_evaluation_of_a_scenario_does_not_depend_on_its_batch():
    loop, gains, scenarios = setting()
    whole = evaluate(loop, gains, scenarios)
    lanes = np.array([63, 2, 17])
    part = evaluate(loop, gains, lanes_of(scenarios, lanes))
    is_scheduled = part.is_scheduled
    for field in ("error", "reference_restitution", "peak_ratio"):
        ours, theirs = getattr(part, field)[is_scheduled], getattr(whole, field)[..., lanes][is_scheduled]
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-13)
    np.testing.assert_array_equal(part.metrics.status, whole.metrics.status[..., lanes])


def test_evaluation_with_gains_per_scenario_equals_evaluation_with_common_gains():
    loop, gains, scenarios = setting(lanes=20)
    common = evaluate(loop, gains, scenarios)
    per_lane = evaluate(loop, {name: np.full(20, value) for name, value in gains.items()}, scenarios)
    np.testing.assert_allclose(
        per_lane.error[per_lane.is_scheduled], common.error[per_lane.is_scheduled], rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize(
    "compensator", [pytest.param("phase_lead", marks=pytest.mark.slow), "response_error"]
)
def test_neutral_gains_give_the_result_of_no_compensation(compensator):
    loop, gains, scenarios = setting(compensator)
    plain, _, _ = setting("none")
    neutral = evaluate(loop, neutralise_gains(compensator, gains), scenarios)
    none = evaluate(plain, {}, scenarios)
    np.testing.assert_allclose(
        neutral.error[none.is_scheduled], none.error[none.is_scheduled], rtol=1e-10, atol=1e-12
    )


def test_evaluation_reuses_program_for_other_mechanism_seed_and_batch_size():
    loop, gains, scenarios = setting()
    evaluate(loop, gains, scenarios)
    programs = programs_of("run_tiles")
    other, other_gains, other_scenarios = setting(name="claw-350kg", seed=7, lanes=65)
    assert other == loop
    evaluate(other, other_gains, other_scenarios)
    evaluate(*setting(seed=3, lanes=128, overrides=("bodies.equivalent_mass=200",)))
    assert programs_of("run_tiles") == programs > 0


def test_evaluation_compares_every_contact_with_its_own_ideal_contact():
    loop, gains, scenarios = setting("none")
    outcome = evaluate(loop, gains, scenarios)
    damping_ratio = scenarios.contact.damping / (
        2 * np.sqrt(scenarios.contact.stiffness * scenarios.equivalent_mass)
    )
    root = np.sqrt(1 - damping_ratio**2)
    expected = np.exp(-damping_ratio / root * np.arctan2(2 * damping_ratio * root, 2 * damping_ratio**2 - 1))
    is_scheduled = outcome.is_scheduled
    np.testing.assert_allclose(
        outcome.reference_restitution[is_scheduled], expected[is_scheduled], rtol=1e-12
    )
    np.testing.assert_array_equal(is_scheduled.sum(axis=0), scenarios.contacts)
    assert outcome.good[is_scheduled].all()


def tiled(scenarios):
    """Return whole delays and expected durations of the lanes in tile order, (tiles, lanes)."""
    dealt = ONE_AXIS.place_batch(scenarios).scenarios

    def in_turn(leaf):
        rows = np.moveaxis(leaf, (1, 0), (-3, -2))
        return rows.reshape(*rows.shape[:-3], np.prod(rows.shape[-3:]))

    lanes = jax.tree.map(in_turn, dealt)
    return (
        row.reshape(-1, TILE_SIZE)
        for row in (ONE_AXIS.whole_delays(lanes), ONE_AXIS.expected_duration(lanes))
    )


def test_tiles_of_a_batch_contain_scenarios_of_equal_delay_and_similar_duration():
    delays, durations = tiled(setting("none", lanes=4096)[2])
    assert np.sum(np.ptp(delays, axis=-1) > 0) < len(np.unique(delays)) == 2
    assert np.mean(np.ptp(durations, axis=-1)) < 0.1 * np.ptp(durations)
    delays, durations = tiled(setting("none", lanes=512)[2])
    assert np.all(np.ptp(delays, axis=-1) > 0) and np.all(np.diff(durations.ravel()) <= 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["varying", "rattling"])
def test_evaluation_of_a_scenario_is_bit_identical_in_any_batch(name):
    # With a lagging sensor, a tile without contact skips work.
    overrides = ("rig.force_sensor.time_constant=0.002",)
    loop, gains, scenarios = setting(lanes=600, name=name, overrides=overrides)
    whole = evaluate(loop, gains, scenarios)
    for lanes in (np.arange(0, 600, 2), np.array([3]), np.random.default_rng(0).permutation(600)):
        part = evaluate(loop, gains, lanes_of(scenarios, lanes), at_least=600)
        for ours, theirs in zip(part.metrics, whole.metrics, strict=True):
            np.testing.assert_array_equal(ours, theirs[..., lanes])
        np.testing.assert_array_equal(part.error, whole.error[..., lanes])


DIGEST = """
import hashlib, os, sys
if sys.argv[1] == "1" and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
from jaxhil.simulation.jax_environment import prepare_jax
prepare_jax()
import jax
from test_evaluation import evaluate, setting
content = b"".join(leaf.tobytes() for leaf in jax.tree.leaves(evaluate(*setting(lanes=100))))
print(jax.device_count(), hashlib.sha256(content).hexdigest())
"""


@pytest.mark.slow
def test_evaluation_of_a_scenario_is_bit_identical_on_any_number_of_cores():
    digests = {}
    for cores in 1, 2, 3:
        flags = "" if cores == 1 else f"{DEVICE_COUNT_FLAG}={cores}"
        process_environment = {**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [sys.executable, "-c", DIGEST, str(cores)]
        ran = subprocess.run(command, env=process_environment, capture_output=True, text=True, check=True)
        devices, digests[cores] = ran.stdout.split()
        assert int(devices) == max(2, cores)
    assert len(set(digests.values())) == 1
