"""Oracle compared with closed forms and with a brute-force integration of the hybrid system."""

from itertools import pairwise
from math import atan2, exp, factorial, pi, sqrt

import numpy as np
import pytest
from brute_force import brute_force
from oracle import simulate
from oracle_motion import simulator_matrices
from scipy.linalg import expm
from scipy.optimize import brentq

MASS, VELOCITY = 350.0, 0.005


class PhaseLead:
    """Compensator (1 + T1 s)/(1 + T2 s), discretised by Tustin at period T, with states starting at 0."""

    def __init__(self, T1, T2, T):
        self.lead, self.lag = 2.0 * T1 / T, 2.0 * T2 / T
        self.reset()

    def reset(self):
        self.force, self.output = 0.0, 0.0

    def step(self, force_measured, x_desired, v_desired, x_measured):
        numerator = (1.0 + self.lead) * force_measured + (1.0 - self.lead) * self.force
        self.output = (numerator - (1.0 - self.lag) * self.output) / (1.0 + self.lag)
        self.force = force_measured
        return self.output


def mechanism(T=1e-3, *, contact, simulator=None, force_delay=0.0, sensor=None, approach=None, **rig):
    return {
        "bodies": {"equivalent_mass": MASS},
        "approach": {"velocity": VELOCITY, **(approach or {})},
        "contact": contact,
        "rig": {
            "control_period": T,
            "simulator": simulator or {"model": "ideal"},
            "force_sensor": {"delay": force_delay, **(sensor or {})},
            **rig,
        },
    }


def linear(omega):
    return {"law": "linear", "stiffness": [MASS * omega**2]}


def delayed_restitution(phase):
    """Return e of x'' = -x(t - phase) by its series; phase = omega tau (T -> 0, pure force delay)."""

    def series(t, derivative):
        terms = range(int(t / phase) + 1)
        power = 2 if derivative else 1
        return sum(
            (-1) ** n * (t - n * phase) ** (2 * n + 2 - power) / factorial(2 * n + 2 - power)
            for n in terms
            if n < 40
        )

    separation = brentq(lambda t: series(t, False), 2.5, 4.0, xtol=1e-14)
    return abs(series(separation + phase, True))


@pytest.mark.parametrize("phase, published", [(0.05, 1.081644885391), (0.2, 1.364341497637)])
def test_oracle_with_pure_force_delay_converges_at_second_order(phase, published):
    assert delayed_restitution(phase) == pytest.approx(published, abs=1e-11)
    tau = 0.0083  # not a multiple of any period
    errors = [
        simulate(mechanism(T, contact=linear(phase / tau), force_delay=tau))[0]["restitution"] - published
        for T in (2e-3, 1e-3, 5e-4, 2.5e-4)
    ]
    for T, error in zip((2e-3, 1e-3, 5e-4, 2.5e-4), errors, strict=True):
        assert abs(error) < 0.2 * (phase / tau * T) ** 2
    assert abs(errors[-1]) < 1e-5


@pytest.mark.parametrize("tension", [False, True])
def test_undelayed_oracle_agrees_with_closed_form_of_damped_separation(tension):
    omega, xi = 2 * pi * 3.0, 0.1
    root = sqrt(1 - xi**2)
    angle = pi if tension else atan2(2 * xi * root, 2 * xi**2 - 1)
    expected = exp(-xi / root * angle)
    law = {
        "law": "kelvin_voigt",
        "stiffness": [MASS * omega**2],
        "damping": [2 * xi * omega * MASS],
        "tension": tension,
    }
    values = np.array([simulate(mechanism(T, contact=law))[0]["restitution"] for T in (1e-3, 5e-4, 2.5e-4)])
    assert abs(values[-1] - expected) < 5e-4
    # The error is of first order in T: the onset of a damped contact jumps between two ticks.
    assert abs(2 * values[-1] - values[-2] - expected) < 1e-4


@pytest.mark.parametrize(
    "integrator, periods", [("semi_implicit_euler", 0.0), ("zoh", 0.5), ("explicit_euler", 1.0)]
)
@pytest.mark.parametrize("latency", [0, 1])
def test_oracle_includes_delays_of_integrator_and_command_latency(integrator, periods, latency):
    T, omega = 5e-4, 2 * pi * 3.0
    rig = {"integrator": integrator, "command_latency": latency}
    value = simulate(mechanism(T, contact=linear(omega), **rig))[0]["restitution"]
    net = (periods + latency) * T
    expected = delayed_restitution(omega * net) if net else 1.0
    assert value == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("latency", [0, 1])
def test_zero_order_hold_delays_half_a_period_less_than_linear_hold(latency):
    T, omega = 5e-4, 2 * pi * 3.0
    simulator = {"model": "second_order", "natural_frequency": 20.0, "damping_ratio": 0.8}
    zoh = mechanism(
        T,
        contact=linear(omega),
        command_hold="zoh",
        command_latency=latency,
        simulator={**simulator, "delay": 2e-3 + T / 2},
    )
    line = mechanism(
        T, contact=linear(omega), command_latency=latency, simulator={**simulator, "delay": 2e-3}
    )
    difference = simulate(zoh)[0]["restitution"] - simulate(line)[0]["restitution"]
    assert abs(difference) < 1e-5


@pytest.mark.parametrize(
    "contact",
    [
        {"law": "linear", "stiffness": [124355.0]},
        {"law": "kelvin_voigt", "stiffness": [124355.0], "damping": [800.0]},
        {"law": "hunt_crossley", "stiffness": [3e6], "damping": [20.0]},
        {
            "law": "piecewise_linear",
            "stiffness": [[1e5, 3e5]],
            "depths": [1e-4],
            "damping": [500.0],
        },
    ],
    ids=lambda contact: contact["law"],
)
def test_oracle_work_equals_energy_change_without_delay(contact):
    errors = []
    for T in (1e-3, 2.5e-4):
        result = simulate(mechanism(T, contact=contact))[0]
        ratio = result["work_out"] / result["work_in"]
        energy = result["work_in"] / (0.5 * MASS * VELOCITY**2) - 1.0
        errors.append((result["restitution"] ** 2 - ratio, energy))
    assert np.abs(errors[-1]).max() < 2e-3
    assert np.abs(errors[-1]).max() <= 0.5 * np.abs(errors[0]).max() or np.abs(errors[0]).max() < 1e-4


@pytest.mark.parametrize(
    "simulator",
    [
        {"model": "first_order", "time_constant": 0.01},
        {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 1.0},
        {"model": "third_order", "coefficients": [0.02, 2e-4, 1e-6]},
        {"model": "transfer_function", "numerator": [0.004, 1.0], "denominator": [1e-4, 0.02, 1]},
    ],
    ids=lambda simulator: simulator["model"],
)
@pytest.mark.parametrize("hold", ["linear", "zoh"])
def test_oracle_starts_in_steady_state_of_uniform_approach(simulator, hold):
    law = {"law": "linear", "stiffness": [1e5]}
    rig = {"command_hold": hold, "command_latency": 1}
    simulator = {**simulator, "delay": 0.0013}
    run = simulate(mechanism(contact=law, simulator=simulator, **rig), record=True)[0]
    signals = run["signals"]
    free = signals["force_command"][:20] == 0.0
    assert free.all()
    offset = (signals["x_actual"] - signals["x_desired"])[:20]
    assert np.ptp(offset) < 1e-11 * np.abs(offset).max()
    matrices = simulator_matrices(simulator)
    assert matrices is not None
    A, B, C = matrices
    assert float(-C @ np.linalg.solve(A, B)) == pytest.approx(1.0, abs=1e-12)
    # Compute the offset by brute force: a long staircase (or ramp) from rest through the same system.
    T, delay, z = 1e-3, simulator["delay"], np.zeros(len(B))
    ticks = np.arange(-2000, 1)
    steps = np.append((ticks * T + delay)[ticks * T + delay < 0.0], 0.0)
    system = np.zeros((len(B) + 2, len(B) + 2))
    system[: len(B), : len(B)], system[: len(B), len(B)], system[-2, -1] = A, B, 1.0
    whole, last = expm(system * T), expm(system * (steps[-1] - steps[-2]))
    for a in steps[:-1]:
        n = round((a - delay) / T)  # latency 1: [t_n, t_n+1) holds x_d(n), or goes there from x_d(n - 1)
        start, slope = (n * T, 0.0) if hold == "zoh" else ((n - 1) * T, 1.0)
        step = last if a == steps[-2] else whole
        z = (step @ [*z, VELOCITY * start, VELOCITY * slope])[: len(B)]
    assert offset[0] == pytest.approx(float(C @ z), rel=1e-10)


@pytest.mark.parametrize(
    "contact, hold, latency",
    [
        ({"law": "kelvin_voigt", "stiffness": [4e5], "damping": [2500.0]}, "linear", 1),
        ({"law": "hunt_crossley", "stiffness": [4e7], "damping": [10.0]}, "zoh", 0),
    ],
    ids=["kelvin_voigt-linear-1", "hunt_crossley-zoh-0"],
)
def test_oracle_agrees_with_brute_force_integration_of_hybrid_loop(contact, hold, latency):
    T = 2e-3
    case = mechanism(
        T,
        contact=contact,
        simulator={
            "model": "second_order",
            "natural_frequency": 15.0,
            "damping_ratio": 0.8,
            "delay": 0.0037,
        },
        force_delay=0.0031,
        sensor={"time_constant": 0.0015},
        command_hold=hold,
        command_latency=latency,
    )
    result = simulate(case, PhaseLead(0.004, 0.001, T), record=True)[0]
    count = len(result["signals"]["tick"])
    speeds = brute_force(case, PhaseLead(0.004, 0.001, T), count, MASS, VELOCITY)
    difference = np.abs(speeds - result["signals"]["v_desired"]).max() / VELOCITY
    assert result["status"] == "over" and result["restitution"] > 0.5
    assert difference < 1e-10


def test_oracle_applies_sensor_effects_in_documented_order():
    noise = np.random.default_rng(1).normal(0.0, 2.0, 4000)
    sensor = {"noise_std": 2.0, "bias": 1.5, "quantum": 0.5, "dead_zone": 3.0, "range": 25.0}
    case = mechanism(contact={"law": "linear", "stiffness": [1e5]}, sensor=sensor)
    signals = simulate(case, force_noise=noise, record=True)[0]["signals"]
    raw = 0.5 * np.round((signals["force"] + 1.5 + noise[: len(signals["tick"])]) / 0.5)
    expected = np.clip(np.sign(raw) * np.maximum(0.0, np.abs(raw) - 3.0), -25.0, 25.0)
    assert np.array_equal(signals["force_measured"], expected)
    assert expected.max() == 25.0


def test_oracle_samples_position_before_ideal_simulator_steps_to_held_command():
    case = mechanism(contact={"law": "linear", "stiffness": [1e5]}, command_hold="zoh")
    signals = simulate(case, record=True)[0]["signals"]
    # In [t_{n-1}, t_n) the drives hold x_d(n): the sensor at tick n reads k x_d(n), not k x_d(n + 1).
    expected = 1e5 * np.maximum(0.0, signals["x_desired"])
    assert np.allclose(signals["force_measured"], expected, rtol=0.0, atol=1e-12)


def test_oracle_with_ideal_simulator_has_exact_readings_and_peak_force():
    case = mechanism(
        contact={"law": "linear", "stiffness": [1e5]},
        force_delay=0.00237,
        position_sensor={"delay": 0.00341},
    )
    result = simulate(case, record=True)[0]
    signals = result["signals"]
    time, x = signals["tick"], signals["x_desired"]
    # With linear hold, x_a is the polygon through the values of x_d, and moves uniformly before t = 0.
    past = np.arange(-10.0, 0.0)
    time, x = np.append(past, time), np.append(x[0] + VELOCITY * 1e-3 * past, x)
    late = np.interp(signals["tick"] - 3.41, time, x)
    assert np.allclose(signals["x_measured"], late, rtol=0.0, atol=1e-17)
    force = 1e5 * np.maximum(0.0, np.interp(signals["tick"] - 2.37, time, x))
    assert np.allclose(signals["force_measured"], force, rtol=0.0, atol=1e-11)
    assert result["peak_force"] == pytest.approx(1e5 * x.max(), rel=1e-13)


def test_oracle_applies_velocity_limit_before_latency_and_delay():
    case = mechanism(
        contact={"law": "linear", "stiffness": [1e5]},
        simulator={"model": "ideal", "delay": 0.002, "velocity_limit": 0.0051},
        force_delay=0.02,
    )
    signals = simulate(case, record=True)[0]["signals"]
    steps = np.diff(signals["x_actual"])
    assert np.abs(steps).max() == pytest.approx(0.0051e-3, rel=1e-9)
    assert np.abs(signals["v_desired"]).max() > 0.0055


def test_oracle_uses_successive_stiffnesses_at_alternating_surfaces():
    law = {
        "law": "kelvin_voigt",
        "stiffness": [1e5, 2e5, 3e5],
        "damping": [500.0],
        "clearance": 0.002,
    }
    case = mechanism(5e-4, contact=law, force_delay=0.001)
    results = simulate(case, contacts=3)
    for index, result in enumerate(results):
        alone = mechanism(
            5e-4,
            contact={**law, "stiffness": law["stiffness"][index], "clearance": None},
            force_delay=0.001,
            approach={"velocity": result["approach_velocity"]},
        )
        # The contact phase differs, which changes the restitution slightly.
        assert result["restitution"] == pytest.approx(simulate(alone)[0]["restitution"], abs=4e-3)
    speeds = [r["restitution"] * r["approach_velocity"] for r in results]
    assert [r["approach_velocity"] for r in results[1:]] == pytest.approx(speeds[:-1], rel=1e-12)


def test_successive_oracle_runs_use_next_stiffness_and_previous_rebound_speed():
    law = {"law": "linear", "stiffness": [1e5, 2e5]}
    results = simulate(mechanism(contact=law, force_delay=0.003), contacts=3)
    for before, after in pairwise(results):
        speed = before["restitution"] * before["approach_velocity"]
        assert after["approach_velocity"] == pytest.approx(speed, rel=1e-14)
    assert results[1]["restitution"] == pytest.approx(results[2]["restitution"], rel=1e-9)
    assert results[0]["restitution"] < results[1]["restitution"]


def test_oracle_rejects_damped_contact_with_ideal_zero_order_hold():
    law = {"law": "kelvin_voigt", "stiffness": [1e5], "damping": [100.0]}
    with pytest.raises(ValueError, match="damped"):
        simulate(mechanism(contact=law, command_hold="zoh"))
