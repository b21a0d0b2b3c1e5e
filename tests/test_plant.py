"""Rig plant in plain Python, compared with the oracle, the JAX simulation and closed forms."""

import math
import time

import numpy as np
import pytest
from cases import CASES, oracle_contacts
from lanes import as_arrays, join, nominal_gains, run_rollout, validated
from rig_lock_step import closed_loop

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import builtin_names, from_plain_data, load
from jaxhil.rig import COMPENSATORS
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.scenario import build_scenarios
from tuning.rig.discretisation import split_delay
from tuning.rig.plant import RigHardware

# One of each motion simulator, hold, law and sensor fault, and several contacts.
AGAINST_THE_ORACLE = (
    *("delays of whole periods", "delays that make a whole period together", "overdamped", "tension"),
    *("zoh hold and integrator", "transfer function with latency", "third order with latency"),
    *("first order", "ideal with transport delay", "ideal with zoh hold", "hunt-crossley", "damped layers"),
    *("response error, gains off nominal", "late position", "dead zone", "quantum", "range"),
    *("cut dead zone", "velocity limit", "damped, lag", "rattling, lag", "rattling against layers"),
    *("rattling behind a long transport delay", "damped hardening", "depth-damped", "elastoplastic"),
    *("preloaded", "more friction than preload"),
    *("depth-damped, linear spring, lag", "elastoplastic, lag", "rattling, elastoplastic"),
    *("contact plane deeper", "rattling, contact plane nearer", "elastoplastic, contact plane nearer"),
)
# Cases whose oracle takes seconds.
LONG = ("elastoplastic, lag", "rattling, elastoplastic", "rattling, contact plane nearer")
# The oracle uses parabolas for the output of a lagging sensor.
LAGGED = 1e-7


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in AGAINST_THE_ORACLE],
)
def test_rig_plant_agrees_with_oracle_in_every_contact(name):
    case = CASES[name]
    mechanism = validated(case.mechanism)
    gains = nominal_gains(mechanism, case.compensator, **case.gains)
    result, shortfalls = closed_loop(mechanism, case.compensator, gains)
    expected = oracle_contacts(name)
    assert len(result) == len(expected) == mechanism.approach.contacts
    # The oracle uses a cubic for the motion near the deepest point.
    case_lags = mechanism.rig.force_sensor.time_constant > 0
    accuracy = LAGGED if case_lags or "elastoplastic" in name else 1e-11
    for number, (mine, other) in enumerate(zip(result, expected, strict=True)):
        assert mine.status == "ok"
        assert mine.restitution == pytest.approx(other["restitution"], abs=accuracy)
        assert mine.approach_velocity == pytest.approx(other["approach_velocity"], rel=1e-7)
        assert mine.peak_force == pytest.approx(other["peak_force"], rel=3e-3)
        assert shortfalls[number] == pytest.approx(other["position_shortfall"], rel=1e-8, abs=1e-17)


# Each form of loop takes some seconds to compile.
BUILT_IN = [
    name if name == "varying" else pytest.param(name, marks=pytest.mark.slow) for name in builtin_names()
]


@pytest.mark.parametrize("name", [*BUILT_IN, "limited", "suite-elastoplastic"])
def test_rig_plant_agrees_with_jax_simulation_for_every_builtin_mechanism(name):
    overrides = ()
    if name == "suite-elastoplastic":
        assert load(name).mechanism.rig.force_sensor.delay == 0.008  # both delays are whole periods
        overrides = ("rig.force_sensor.noise_std=0",)
    if name == "limited":
        name = "rattling"
        overrides = ("rig.simulator.acceleration_limit=0.1", "rig.simulator.velocity_limit=0.01")
        overrides += ('uncertainty."approach.velocity".factor=[0.8, 1.0]',)
        overrides += ("approach.contacts=3", "rig.command_latency=1")
    mechanism = load(name, overrides).mechanism
    gains = literature_gains(mechanism, "response_error")
    scenario = join([build_scenarios(mechanism)])
    loop = build_loop(mechanism, "response_error", scenario)
    expected = run_rollout(loop, as_arrays(gains), scenario)
    result, shortfalls = closed_loop(mechanism, "response_error", gains)
    assert len(result) == mechanism.approach.contacts
    for slot, mine in enumerate(result):
        assert mine.status == "ok" and expected.status[slot, 0] == OK
        assert mine.restitution == pytest.approx(float(expected.restitution[slot, 0]), abs=1e-9)
        assert mine.duration == pytest.approx(float(expected.duration[slot, 0]), abs=1e-9)
        assert mine.peak_force == pytest.approx(float(expected.peak_force[slot, 0]), rel=1e-3)
        assert shortfalls[slot] == pytest.approx(
            float(expected.position_shortfall[slot, 0]), rel=1e-6, abs=1e-17
        )
    if mechanism.rig.simulator.velocity_limit < math.inf:
        assert max(shortfalls.values()) > 1e-7


SIMULATORS = {
    "ideal": ({"model": "ideal"}, 0.0),
    "first order": ({"model": "first_order", "time_constant": 0.009}, 0.009),
    "second order": (
        {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8},
        0.8 / (math.pi * 12.0),
    ),
    "third order": ({"model": "third_order", "coefficients": [0.02, 1.6e-4, 5e-7]}, 0.02),
    "transfer function": (
        {"model": "transfer_function", "numerator": [0.004, 1.0], "denominator": [1.5e-4, 0.02, 1.0]},
        0.016,
    ),
}


def on_rig(simulator, **rig):
    return from_plain_data(
        {
            "schema": "jaxhil/mechanism/1",
            "name": "case",
            "bodies": {"equivalent_mass": 350.0},
            "approach": {"velocity": 0.005},
            "contact": {"law": "linear", "stiffness": [1e5]},
            "rig": {"control_period": 0.001, "simulator": simulator, **rig},
        },
        "case",
    )


@pytest.mark.parametrize("model", SIMULATORS)
@pytest.mark.parametrize("latency", [0, 1])
def test_rig_plant_follows_uniform_motion_with_constant_lag(model, latency):
    simulator, lag = SIMULATORS[model]
    mechanism = on_rig(
        {**simulator, "delay": 0.0037}, command_latency=latency, position_sensor={"delay": 0.0009}
    )
    plant, velocity = RigHardware(mechanism), 0.005
    plant.begin(-1.0, velocity, -1.0, 0)
    lag += 0.0037 + 0.0009 + latency * 0.001
    for tick in range(300):
        position = -1.0 + tick * 0.001 * velocity
        assert plant.read()[1] == pytest.approx(position - velocity * lag, abs=1e-12)
        plant.move(position + 0.001 * velocity)


def test_rig_plant_follows_staircase_command_in_steady_state():
    mechanism = on_rig({**SIMULATORS["second order"][0], "delay": 0.0037}, command_hold="zoh")
    plant, velocity = RigHardware(mechanism), 0.005
    plant.begin(-1.0, velocity, -1.0, 0)
    readings = []
    for tick in range(200):
        readings.append(plant.read()[1])
        plant.move(-1.0 + (tick + 1) * 0.001 * velocity)
    np.testing.assert_allclose(np.diff(readings), 0.001 * velocity, rtol=0, atol=1e-13)


@pytest.mark.parametrize("delay, intervals, place", [(0.0, 0, 1.0), (0.003, 3, 1.0), (0.0032, 3, 0.8)])
def test_rig_plant_splits_delay_into_whole_and_fractional_ticks(delay, intervals, place):
    assert split_delay(delay, 0.001) == (intervals, pytest.approx(place, abs=1e-12))
    assert split_delay(0.1 + 0.2, 0.1)[0] == 3


def test_rig_plant_sensors_in_free_flight_have_stated_bias_and_noise():
    sensor = {"noise_std": 0.5, "bias": 2.0}
    mechanism = on_rig({"model": "ideal"}, force_sensor=sensor, position_sensor={"noise_std": 1e-6})
    plant = RigHardware(mechanism, seed=3)
    plant.begin(-1.0, 0.0, -1.0, 0)
    readings = np.array([plant.read() for _ in range(20_000)])
    assert np.mean(readings[:, 0]) == pytest.approx(2.0, abs=5 * 0.5 / 20_000**0.5)
    assert np.std(readings[:, 0]) == pytest.approx(0.5, rel=0.03)
    assert np.std(readings[:, 1]) == pytest.approx(1e-6, rel=0.03)
    again = RigHardware(mechanism, seed=3)
    again.begin(-1.0, 0.0, -1.0, 0)
    assert [again.read() for _ in range(3)] == [tuple(row) for row in readings[:3]]


@pytest.mark.parametrize("name", ["rig-300kg", "rattling"])
def test_mean_restitution_of_noisy_plant_contacts_equals_noiseless_restitution(name):
    mechanism = load(name, ("rig.force_sensor.noise_std=0.2", "approach.contacts=1")).mechanism
    quiet = load(name, ("approach.contacts=1",)).mechanism
    gains = literature_gains(mechanism, "phase_lead")
    (expected,), _ = closed_loop(quiet, "phase_lead", gains)
    result = [closed_loop(mechanism, "phase_lead", gains, seed)[0][0].restitution for seed in range(8)]
    spread = np.std(result)
    assert 1e-6 < spread < 0.02
    assert np.mean(result) == pytest.approx(expected.restitution, abs=4 * spread / 8**0.5 + 1e-3)


def test_runtime_has_every_compensator_used_with_rig_plant():
    assert {case.compensator for case in CASES.values()} <= set(COMPENSATORS)


@pytest.mark.benchmark
@pytest.mark.parametrize("name", [*builtin_names(), "lag"])
def test_rig_plant_time_per_tick_is_within_limit(name):
    overrides = ("rig.force_sensor.time_constant=0.002",) if name == "lag" else ()
    mechanism = load("varying" if name == "lag" else name, overrides).mechanism
    plant, velocity = RigHardware(mechanism), mechanism.approach.velocity
    times = []
    for _ in range(20):
        plant.begin(-0.02 * velocity, velocity, -0.02 * velocity, 0)
        for tick in range(300):
            # Alternate contact and flight.
            phase = math.pi * (tick - 20) / 250
            begun = time.thread_time_ns()
            plant.read()
            plant.move(velocity * 0.25 / math.pi * math.sin(phase))
            times.append(1e-3 * (time.thread_time_ns() - begun))
    print(f"\n{name}: plant's tick {np.median(times):.1f} us, 99 % {np.percentile(times, 99):.1f} us")
    assert np.median(times) < 150
