"""Position lead: the simulator's exact inverse removes its lag; commands are recorded before the limits."""

import functools
from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from continuous import delayed_restitution
from endless import OMEGA, STIFFNESS
from lanes import (
    IDEAL,
    SECOND_ORDER,
    VELOCITY,
    first_contact,
    grid,
    mechanism,
    nominal_gains,
    per_lane,
    run_record,
    spread,
    validated,
)

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.laws.shared.nominal_values import simulator_inverse
from jaxhil.mechanism.file import builtin_names, load
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.simulation.gain_file import check_document
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.recording import nominal_and_draws, record_lanes
from tuning.bundle.vectors import make_vectors
from tuning.gain_file import build_document
from tuning.verification.runtime_replay import verify
from tuning.watchdog.calibration import calibrate
from tuning.watchdog.recording import ScenarioSelection, record_selection

EXACT = {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8}
PERIODS = np.array([2e-3, 1e-3, 5e-4, 2.5e-4])
PHASES = (np.arange(8) + 0.5) / 8
DELAY = 0.005


@functools.cache
def restitutions():
    """Return restitutions, averaged over contact phases, (3, periods).

    The rows are: exact inverse, no lead, and exact inverse with a force delay.
    """
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, EXACT, 0.0, period=PERIODS[-1]))
    gains = nominal_gains(parsed, "position_lead")
    frequency = 2 * pi * 12.0
    assert gains == pytest.approx({"position_lead": 1.6 / frequency, "acceleration_lead": frequency**-2})
    case, period, phase = grid([0, 1, 2], PERIODS, PHASES)
    delay = np.where(case == 2, DELAY, 0.0)
    scenario = spread(parsed, len(case), phase=phase, control_period=period, force_sensor__delay=delay)
    gains = {name: np.where(case == 1, 0.0, value) for name, value in gains.items()}
    result = first_contact(parsed, scenario, "position_lead", gains)["restitution"]
    return result.reshape(3, len(PERIODS), -1).mean(axis=-1)


def test_exact_inverse_position_lead_leaves_error_of_first_order_in_control_period():
    error, without, _ = restitutions() - 1
    # Without position lead the contact diverges for any period.
    assert np.all(without > 0.5)
    # v and a are half a period late: the error halves with the period.
    assert error[-1] < 2e-3 * without[-1]
    np.testing.assert_allclose(error[:-1] / error[1:], 2, rtol=0.1)
    assert abs(2 * error[-1] - error[-2]) < 2e-5


def test_position_lead_does_not_compensate_force_delay():
    result = restitutions()[2]
    expected = delayed_restitution(OMEGA * DELAY)
    assert expected > 1.15
    assert 2 * result[-1] - result[-2] == pytest.approx(expected, abs=2e-4)


def test_simulator_follows_the_model_under_position_lead():
    parsed = validated(mechanism({"stiffness": [STIFFNESS]}, EXACT, 0.0, period=5e-4))
    led, period = np.array([1, 1, 0, 0]), np.tile([1e-3, 5e-4], 2)
    gains = {name: value * led for name, value in nominal_gains(parsed, "position_lead").items()}
    scenario = spread(parsed, 4, control_period=period)
    loop = build_loop(parsed, "position_lead", scenario)
    _, seen = run_record(loop, per_lane(gains, 4), scenario, 500)
    desired, measured = np.asarray(seen.signals.position_desired), np.asarray(seen.signals.position_measured)
    apart = np.max(np.abs(desired - measured)[:250], axis=0) / np.ptp(desired[:250], axis=0)
    assert np.all(apart[2:] > 0.2)
    assert apart[0] < 0.01 and apart[1] == pytest.approx(apart[0] / 2, rel=0.1)


def test_position_lead_derivative_for_each_gain_matches_finite_difference():
    law = COMPENSATORS["position_lead"]
    gains = {"position_lead": jnp.asarray(0.02), "acceleration_lead": jnp.asarray(2e-4)}

    def sent(gains):
        return law.position_command(gains, (), jnp.asarray(1e-3), jnp.asarray(4e-3), jnp.asarray(-0.3))[0]

    assert sent(gains) == pytest.approx(1e-3 + 0.02 * 4e-3 - 2e-4 * 0.3, rel=1e-14)
    assert jax.jacfwd(sent)(gains) == {"position_lead": 4e-3, "acceleration_lead": pytest.approx(-0.3)}


def test_position_lead_nominal_gains_are_within_bounds():
    overrides = [
        [],
        ["rig.command_hold=zoh", "rig.command_latency=1"],
        ["rig.simulator.delay=0.08", "contact.clearance=1.0"],
    ]
    for name in builtin_names():
        for override in overrides:
            made = load(name, override).mechanism
            inverse = simulator_inverse(made)
            for gain, expected in zip(COMPENSATORS["position_lead"].gains, inverse, strict=True):
                assert gain.lower(made) <= gain.nominal(made) == expected <= gain.upper(made)
    mechanism_with_hold = validated(mechanism({}, {**IDEAL, "delay": 1e-4}, command_hold="zoh"))
    assert simulator_inverse(mechanism_with_hold)[0] < 0
    for gain in COMPENSATORS["position_lead"].gains:
        assert (
            gain.lower(mechanism_with_hold)
            <= gain.nominal(mechanism_with_hold)
            <= gain.upper(mechanism_with_hold)
        )


# Tests of the runtime on the rig.


def loaded_gains(simulator=SECOND_ORDER, **keys):
    raw = mechanism({"damping": [300.0]}, simulator, contacts=2, period=1e-3, **keys)
    made = validated(raw)
    gains = nominal_gains(made, "position_lead")
    return check_document(build_document("position_lead", gains, made, "0" * 64, {}, {}, 0, {}))


LIMITED = {**SECOND_ORDER, "velocity_limit": 0.008, "acceleration_limit": 0.5}


def test_recorded_position_command_is_the_value_before_simulator_limits():
    loaded = loaded_gains(LIMITED)
    batch = nominal_and_draws(loaded.mechanism, 1, 0)
    _, (lane,) = record_lanes(loaded, batch)
    signals = lane.signals
    same_run = signals.age[1:] == signals.age[:-1] + 1
    x, v = signals.position_desired[1:], signals.velocity_desired[1:]
    acceleration = -np.asarray(lane.command)[:-1] / loaded.mechanism.bodies.mass
    expected = x + loaded.gains["position_lead"] * v + loaded.gains["acceleration_lead"] * acceleration
    assert lane.sent is not None and np.sum(~same_run) == 1
    np.testing.assert_allclose(np.asarray(lane.sent)[:-1][same_run], expected[same_run], rtol=0, atol=1e-15)
    # The sent command leads the model's position during the approach.
    assert np.max(np.abs(np.asarray(lane.sent)[:-1] - x)[same_run]) > 0.02 * VELOCITY


def test_verification_detects_wrong_position_command_of_runtime(monkeypatch):
    loaded = loaded_gains()
    good = verify(loaded, scenarios=1)
    assert good.verdict, good.reasons
    assert good.replay[0].position_difference < 1e-11
    vectors = make_vectors(loaded, seed=1, draws=0)
    assert not vectors.reasons

    class Wrong(ON_THE_RIG["position_lead"]):
        def position_command(self, *motion):
            return super().position_command(*motion) + 1e-12

    monkeypatch.setitem(ON_THE_RIG, "position_lead", Wrong)
    bad = verify(loaded, scenarios=1)
    assert not bad.verdict and bad.replay[0].difference == 0.0
    assert any(reason.startswith("the nominal run: position commands differ") for reason in bad.reasons)
    [reason] = make_vectors(loaded, seed=1, draws=0).reasons
    assert "position command: found" in reason


def test_stroke_and_velocity_limits_apply_to_command_with_position_lead():
    loaded = loaded_gains()
    result = calibrate(loaded, scenarios=8, limit=1.0)
    [chunk] = record_selection(loaded, ScenarioSelection("random", 0, 8))
    sent, position = (np.where(chunk.signals.live, leaf, np.nan) for leaf in chunk.signals[5:0:-4])
    assert np.nanmax(sent) > np.nanmax(position)
    # Limits keep a margin on every fourth run; the other runs test them.
    sent, begins = sent[:, ::4], chunk.signals.begins[1:, ::4]
    speed = np.abs(np.diff(sent, axis=0))[~begins]
    spare = 0.5 * (np.nanmax(sent) - np.nanmin(sent))
    assert result.limits["command_highest"] == pytest.approx(np.nanmax(sent) + spare, rel=1e-12)
    assert result.limits["velocity_limit"] == pytest.approx(1.5 * np.nanmax(speed) / 1e-3, rel=1e-12)
    assert result.rates["false_alarms"]["alarms"] == 0
