"""Jitter, lost frames and missed ticks of six-axis rigs: files, state of compensators, batches.

`test_six_axis_oracle.py` and `test_six_axis_acceptance.py` compare runs with an independent implementation,
`test_six_axis_udp.py` the rehearsal with `simulate`.
"""

import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gain_documents import sign

import jaxhil
import tuning
from jaxhil import InputError
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.simulation.timing import hold_compensator
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.plausibility import check_scenario
from jaxhil.sixdof.six_axes import SIX_AXES
from tuning.gain_file import build_document
from tuning.rig.rig_task import build_simulated_rig

JITTER, LOSS = "rig.force_sensor.jitter", "rig.force_sensor.loss_probability"
MISSED = "rig.missed_tick_probability"
ALL = {JITTER: 0.001, LOSS: 0.02, MISSED: 0.02}
AVERAGE = {
    "rig.simulator.model": "moving_average",
    "rig.simulator.window": 0.0144,
    "rig.simulator.natural_frequency": None,
    "rig.simulator.damping_ratio": None,
}


@pytest.mark.parametrize(
    ("name", "overrides", "reason"),
    [
        ("probe-drogue", {JITTER: 0.004}, "expected at most 0.0037 s, the smallest rig.force_sensor.delay"),
        ("probe-drogue", {JITTER: 1e-3, "rig.force_sensor.time_constant": 1e-3}, "with a time_constant"),
        ("petals", {JITTER: 1e-3}, "found 0.001, expected 0, because jitter is not supported with bristle"),
        ("ring-capture", {JITTER: 1e-3}, "not supported with a latch"),
        ("ring-capture", {LOSS: 0.95}, "expected a number from 0 to 0.9"),
        ("petals", {MISSED: 0.6}, "expected a number from 0 to 0.5"),
    ],
)
def test_six_axis_file_rejects_unsupported_timing_effect(name, overrides, reason):
    with pytest.raises(InputError, match=re.escape(reason)) as caught:
        load_any(name, overrides)
    assert "\n" not in str(caught.value)


def test_six_axis_rehearsal_rejects_missed_ticks_in_one_line():
    with pytest.raises(InputError, match=r"found 0[.]05, expected 0 for a rehearsal"):
        build_simulated_rig(load_any("probe-drogue", {MISSED: 0.05}).mechanism)


def test_compensator_keeps_its_state_at_missed_ticks_and_its_delay_lines_move_on():
    """A delay line may have several rows for each sample."""
    ring = 8
    before = {"number": jnp.zeros(2), "line": jnp.arange(8.0 * 3 * 2).reshape(ring, 3, 2)}
    after = jax.tree.map(lambda leaf: leaf - 100.0, before)
    state = hold_compensator(jnp.array([True, False]), before, after, ring)
    np.testing.assert_array_equal(state["number"], [0.0, -100.0])
    np.testing.assert_array_equal(state["line"][..., 0], np.roll(before["line"][..., 0], 1, axis=0))
    np.testing.assert_array_equal(state["line"][..., 1], after["line"][..., 1])


@pytest.mark.slow
def test_six_axis_jitter_of_fast_motion_simulator_is_rejected_in_one_line():
    fast = {JITTER: 1e-3, "rig.simulator.natural_frequency": [200.0] * 6}
    mechanism = load_any("probe-drogue", fast).mechanism
    with jax_context():
        scenario = build_scenarios(mechanism)
    with pytest.raises(InputError, match=re.escape("at most 1 / control_period for rig.force_sensor.jitter")):
        check_scenario(mechanism, scenario)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("probe-drogue", {"rig.command_latency": 1}),
        ("probe-drogue", AVERAGE),
        ("hydraulic-hexapod", {"rig.command_hold": "zoh"}),
        ("claw-two-arms", {}),
    ],
)
def test_six_axis_run_with_tiny_jitter_equals_run_without_jitter(name, overrides):
    """Readings with jitter come from a power series of the motion, those without jitter from fixed rows."""
    plain, late = (
        np.array(jaxhil.simulate(load_any(name, overrides | change).mechanism).final.twist)
        for change in ({}, {JITTER: 1e-12})
    )
    print(name, np.max(np.abs(late - plain)) / np.max(np.abs(plain)))
    np.testing.assert_allclose(late, plain, rtol=0, atol=1e-8 * np.max(np.abs(plain)))


@pytest.mark.slow
def test_six_axis_derivatives_with_timing_effects_equal_central_differences():
    mechanism = load_any("probe-drogue", ALL).mechanism
    with jax_context():
        names = (JITTER, "rig.force_sensor.delay", "contact.tip.stiffness")
        nominal = [jnp.array([value]) for value in (0.001, 0.0037, 3e6)]
        scenario = build_scenarios(mechanism, dict(zip(names, nominal, strict=True)))
        loop = SIX_AXES.loop(mechanism, "phase_lead", scenario)
        gains = {
            name: jnp.asarray(value) for name, value in jaxhil.simulate(mechanism, "phase_lead").gains.items()
        }

        @jax.jit
        def errors(*values):
            drawn = build_scenarios(mechanism, dict(zip(names, values, strict=True)))
            return SIX_AXES.run(loop, gains, drawn).error[:, 0]

        for index, value in enumerate(nominal):
            unit = [value if other == index else 0 * value for other in range(len(nominal))]
            _, slope = jax.jvp(errors, tuple(nominal), tuple(unit))
            steps = [
                errors(*(v + sign * 1e-5 * u for v, u in zip(nominal, unit, strict=True))) for sign in (1, -1)
            ]
            print(names[index], slope, (steps[0] - steps[1]) / 2e-5)
            np.testing.assert_allclose(slope, (steps[0] - steps[1]) / 2e-5, rtol=1e-4, atol=1e-6)

    uncertain = {MISSED: {"distribution": "uniform", "low": 0.0, "high": 0.5}}
    mechanism = load_any("probe-drogue", ALL | {"uncertainty": uncertain}).mechanism
    result = tuning.tune(mechanism, "phase_lead", scenarios=2, starts=1, steps=1, validation=2, seed=0)
    study = tuning.sweep(result, scenarios=16, limit=0.05)
    assert study.failure_probability > 0.1
    again = tuning.sweep(result, scenarios=16, limit=0.05)
    assert again.table.equals(study.table)
    # The controller is compared with the simulation without missed ticks.
    assert tuning.verify(result).good


def save_gains(folder, compensator, overrides):
    """Write a gain file with the literature's gains; return its path."""
    loaded = load_any("probe-drogue", overrides)
    gains = literature_gains(loaded.mechanism, compensator)
    document = sign(build_document(compensator, gains, loaded.mechanism, loaded.sha256, {}, {}, 0, {}))
    (folder / "gains.json").write_text(json.dumps(document))
    return str(folder / "gains.json")


@pytest.mark.slow
def test_six_axis_sweep_with_timing_effects_states_that_the_rig_is_unsafe(tmp_path):
    uncertain = {MISSED: {"distribution": "uniform", "low": 0.0, "high": 0.5}}
    gains = save_gains(tmp_path, "impulse_ledger", ALL | {"uncertainty": uncertain})
    study = tuning.sweep(gains, scenarios=16, limit=0.05)
    assert study.failure_probability > 0.1
    assert tuning.sweep(gains, scenarios=16, limit=0.05).table.equals(study.table)


@pytest.mark.slow
def test_six_axis_gains_of_rig_with_timing_effects_are_verified(tmp_path):
    """The controller is compared with the simulation without missed ticks."""
    assert tuning.verify(save_gains(tmp_path, "phase_lead", ALL)).good
