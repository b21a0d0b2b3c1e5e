"""The rig's six-axis compensators agree with the JAX compensators for recorded and random readings."""

import functools
import math

import numpy as np
import pytest
from six_axis_ranges import NOISE, POSE_NOISE
from six_axis_records import (
    RING,
    random_readings,
    recorded,
    relative_difference,
    rig_commands,
    rounding_spread,
    simulated_alone,
)

from jaxhil.laws import built_in_compensators
from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.laws.impulse_ledger.six_axes.tangent_model.rig import SPREADS, TangentModel
from jaxhil.mechanism.file import load_any, six_axis_names
from jaxhil.rig.law_status import IDENTIFIED, OUT_OF_CONTACT, STATUS_NAMES
from jaxhil.rig.six_axes import SIX_AXIS_COMPENSATORS as ON_THE_RIG
from jaxhil.rig.six_axes import ModelConstants
from jaxhil.rig.six_axes.vectors import coordinate_rates
from jaxhil.sixdof.loop_state import SETTLING_TICKS

LIMIT = 1e-9  # maximum difference, divided by the commands' range
NOISY = "probe-drogue"  # mechanism whose force and pose readings have noise
LANES = 3
MECHANISMS = six_axis_names()


@functools.cache
def of_ledger(name):
    """Record drawn runs of a mechanism with the impulse ledger."""
    changes = {}
    if name == NOISY:
        changes = {"rig.force_sensor.noise_std": NOISE, "rig.position_sensor.noise_std": POSE_NOISE}
    return recorded(load_any(name, changes).mechanism, "impulse_ledger", LANES)


def test_every_built_in_compensator_has_a_rig_class_with_the_same_gains():
    assert {*ON_THE_RIG} == {*built_in_compensators(6)}
    mechanism = load_any("probe-drogue").mechanism
    for name, law in SIX_AXIS_COMPENSATORS.items():
        if name not in ON_THE_RIG:
            continue  # a different test has registered it
        specified = ON_THE_RIG[name].gains
        assert {gain.name: gain.unit for gain in law.gains} == {k: gain.unit for k, gain in specified.items()}
        for gain in law.gains:
            for value in (gain.lower(mechanism), gain.nominal(mechanism), gain.upper(mechanism)):
                assert specified[gain.name].admits(value), (name, gain.name, value)


@pytest.mark.parametrize("name", ["phase_lead", "phase_lead_per_axis", "response_error"])
def test_six_axis_lead_can_be_twice_as_long_as_the_delay_of_the_loop(name):
    """Tuned leads of contacts with a latch are longer than this delay."""
    mechanism = load_any("ring-capture").mechanism
    delay = 0.0037 + max(0.8 / (np.pi * 14.0) + 4e-3, 0.8 / (np.pi * 11.0) + 5e-3)
    uppers = [gain.upper(mechanism) for gain in SIX_AXIS_COMPENSATORS[name].gains if "phase" in gain.name]
    np.testing.assert_allclose(uppers, 2 * delay, rtol=1e-12)


def check_agreement(name, gains, constants, period, readings, expected):
    """Compare the rig's commands with expected commands; return whether the difference is due to rounding."""
    found, _ = rig_commands(name, gains, constants, period, readings)
    difference = relative_difference(found, expected)
    if difference <= LIMIT:
        return False
    spread = rounding_spread(name, gains, constants, period, readings)
    assert difference <= 10 * spread, f"{name}: {difference}: rounding explains {spread}"
    return True


@pytest.mark.slow
@pytest.mark.parametrize("name", MECHANISMS)
def test_rig_and_jax_commands_agree_on_recorded_readings(name):
    """Compare the ledger with its record, and each rig compensator with JAX for the same readings."""
    records = of_ledger(name)
    period = records.mechanism.rig.control_period
    for lane, record in enumerate(records.lanes):
        readings, constants = record[:4], records.on_the_rig(lane)
        assert np.any(record.command != 0)
        commands, sent = rig_commands("impulse_ledger", records.gains, constants, period, readings)
        assert relative_difference(commands, record.command) <= LIMIT
        # A recorded pose command belongs to the motion after its tick.
        np.testing.assert_allclose(sent[1:], record.sent[:-1], rtol=0, atol=1e-13)
        for other in built_in_compensators(6):
            gains = literature_gains(records.mechanism, other)
            expected = simulated_alone(other, gains, constants, period, readings)
            check_agreement(other, gains, constants, period, readings, expected)


@pytest.mark.slow
def test_rig_and_jax_commands_agree_if_a_contact_begins_within_the_loop_delay_of_the_start():
    """Use a hexapod whose delay line is longer than the settling time, and noise above the threshold."""
    changes = {"rig.control_period": 2.5e-4, "rig.force_sensor.noise_std": {"force": 100.0, "torque": 10.0}}
    mechanism = load_any("hydraulic-hexapod", changes).mechanism
    records = recorded(mechanism, "impulse_ledger", 1, changes={"force_noise": 0.0, "torque_noise": 0.0})
    assert records.longest_delay > SETTLING_TICKS * 2.5e-4
    [record] = records.lanes
    assert np.any(record.command[: int(0.02 / 2.5e-4)] != 0)
    commands, _ = rig_commands("impulse_ledger", records.gains, records.on_the_rig(0), 2.5e-4, record[:4])
    assert relative_difference(commands, record.command) <= LIMIT


def test_pose_commands_are_extrapolated_by_lag_leads():
    records = of_ledger(NOISY)
    record = records.lanes[0]
    leads = np.array([records.gains[f"lag_lead_{axis}"] for axis in ("x", "y", "z", "rx", "ry", "rz")])
    assert np.max(leads) > 1e-3
    rates = np.array(
        [
            coordinate_rates(*row)
            for row in zip(record.pose_desired.tolist(), record.twist_desired.tolist(), strict=True)
        ]
    )
    expected = record.pose_desired[1:] + leads * rates[1:]
    np.testing.assert_allclose(record.sent[:-1], expected, rtol=0, atol=1e-13)


def test_ledger_reports_delay_status_and_unpaid_impulse():
    records = of_ledger(NOISY)
    law = ON_THE_RIG["impulse_ledger"](records.gains, records.on_the_rig(0), 1e-3)
    statuses = []
    for row in zip(*(column.tolist() for column in records.lanes[0][:4]), strict=True):
        law.step(*row)
        statuses.append(law.status)
    acting = [status for status in statuses if status != OUT_OF_CONTACT]
    assert acting.count(IDENTIFIED) > 0.6 * len(acting) > 20
    assert statuses[0] == OUT_OF_CONTACT and {*statuses} <= {*STATUS_NAMES}
    # The loop's delay is the sum of force delay, axes' delays, and axes' lag in uniform motion.
    assert 0.02 < law.loop_delay < 0.035
    assert 0 < law.unpaid_impulse < 0.05
    law.reset()
    assert law.loop_delay == 0.0


def random_gains(rng, mechanism, name):
    gains = {}
    for gain in SIX_AXIS_COMPENSATORS[name].gains:
        lower, upper, share = gain.lower(mechanism), gain.upper(mechanism), rng.random()
        inside = lower * (upper / lower) ** share if gain.logarithmic else lower + share * (upper - lower)
        gains[gain.name] = (lower, upper, gain.nominal(mechanism), inside)[rng.integers(4)]
    # With larger gains most contacts end before detection is allowed, or are too weak to be detected.
    most = {"settle": 0.05, "force_noise": 1.0, "torque_noise": 0.1, "pose_filter": 0.005}
    return {gain: min(value, most.get(gain, value)) for gain, value in gains.items()}


def random_constants(rng):
    """Draw a tool, and a mass matrix as well conditioned as those of mechanisms."""
    size = np.diag(np.sqrt([300.0, 300.0, 300.0, 90.0, 90.0, 90.0]))
    mixed = np.eye(6) + 0.1 * rng.standard_normal((6, 6))
    mass = size @ mixed @ mixed.T @ size
    tool = np.diag([12.0, 12.0, 12.0, 0.3, 0.3, 0.3]) * rng.uniform(0, 1)
    correction = np.linalg.inv(np.eye(6) - tool @ np.linalg.inv(mass))
    matrices = (mass.tolist(), np.linalg.inv(mass).tolist(), correction.tolist())
    return ModelConstants(*matrices, (RING - 2) * 1e-3, 1.0, [0.0] * 6)


@pytest.mark.parametrize("runs", [4, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", built_in_compensators(6))
def test_rig_and_jax_commands_agree_on_random_readings(name, runs):
    """Compare commands for random readings, few of which magnify rounding errors."""
    ticks, period = 1000, 1e-3
    mechanism = load_any("probe-drogue").mechanism
    magnified, acting = 0, 0
    for run in range(runs):
        rng = np.random.default_rng([run, runs])
        readings, constants = random_readings(rng, ticks, period), random_constants(rng)
        gains = random_gains(rng, mechanism, name)
        expected = simulated_alone(name, gains, constants, period, readings)
        acting += bool(np.any(expected != 0))
        magnified += check_agreement(name, gains, constants, period, readings, expected)
    assert acting > 0.9 * runs
    assert magnified <= (0.25 * runs if name == "impulse_ledger" else 0)


@pytest.mark.parametrize("curvature", [1e7, -1e7])
def test_ledger_prediction_with_a_wrong_estimate_is_finite(curvature):
    gains = dict.fromkeys(SPREADS, 1.0) | {"forgetting": 1.0}
    model = TangentModel(gains, 0.001)
    model.stiffness, model.curvature = 1e6, curvature
    model.bridge(force=1e3, least=-1e3, deeper=0.01, velocity=1.0, duration=0.3)
    assert math.isfinite(model.impulse) and math.isfinite(model.force)
