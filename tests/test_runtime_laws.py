"""Compensators of the runtime and their parts, compared with matrix equations and transfer functions."""

import math
from typing import Any

import numpy as np
import pytest
from gain_documents import GAINS, gain_document
from hypothesis import given, settings
from hypothesis import strategies as st
from runtime_readings import Reading, readings, run

from jaxhil.laws.shared.recursive_least_squares.rig import ContactIdentification
from jaxhil.rig import Controller
from jaxhil.rig.filters import DelayLine, LeadFilter, VelocityFilter


def by_matrices(document: dict[str, Any], ticks: list[Reading]) -> tuple[np.ndarray, np.ndarray]:
    """Return force command and estimates of the response-error law per tick, from whole signals and matrices.

    Lead and velocity filter are state-space models discretised by the bilinear transform. The delay is a
    linear interpolation in the whole record. The time in contact within a period is measured on the straight
    lines between the samples. The identification is textbook weighted recursive least squares with bounded
    covariance.
    """
    gain = {name: entry["value"] for name, entry in document["gains"].items()}
    period = document["control_period"]
    clearance = document["mechanism"]["contact"].get("clearance", np.inf)
    force, desired, velocity, measured = np.array(ticks).T
    count = len(force)

    lag, lead = gain["lead_filter"], gain["phase_lead"] + gain["lead_filter"]
    led = bilinear(-1 / lag, 1 - lead / lag, 1 / lag, lead / lag, period, force, 0.0, 0.0)

    def differentiate(signal: np.ndarray) -> np.ndarray:
        tau = gain["velocity_filter"]
        before = signal[0] - period * velocity[0]
        # The steady state of s/(1 + tau s) in uniform motion: x - tau x'.
        state = before - tau * velocity[0]
        return bilinear(-1 / tau, -1 / tau, 1 / tau, 1 / tau, period, signal, state, before)

    times = period * np.arange(count)
    past = period * np.arange(-200, 0)
    aligned = np.interp(
        times - gain["identification_delay"],
        np.concatenate([past, times]),
        np.concatenate([measured[0] + past * velocity[0], measured]),
    )
    measured_velocity, aligned_velocity = differentiate(measured), differentiate(aligned)
    depth = np.where(aligned > 0, aligned, np.where(aligned < -clearance, aligned + clearance, 0.0))
    start = aligned[0] - period * velocity[0]
    contact = triangle(measure(aligned, start, 0.0, np.inf) + measure(aligned, start, -np.inf, -clearance))
    size = np.abs(force)
    weight = contact * triangle(measure(size, 0.0, gain["contact_threshold"], np.inf))

    theta = np.array([gain["initial_stiffness"], gain["initial_damping"]])
    initial = gain["stiffness_covariance"], gain["damping_covariance"]
    covariance = np.diag(initial)
    history = np.empty((count, 2))
    for n in range(count):
        phi = np.array([depth[n], aligned_velocity[n]])
        retained = 1.0 - weight[n] * (1.0 - gain["forgetting"])
        column = weight[n] * covariance @ phi / (retained + weight[n] * phi @ covariance @ phi)
        theta = theta + column * (force[n] - phi @ theta)
        covariance = bounded((covariance - np.outer(column, phi @ covariance)) / retained, initial)
        history[n] = theta
    response = gain["response_error"] * history[:, 0] * (desired - measured)
    response += gain["response_error_damping"] * history[:, 1] * (velocity - measured_velocity)
    return led + contact * response, history


def covariance_of(identification) -> tuple[float, float, float]:
    """Return P_11, P_12 and P_22 of P = U D U'."""
    u, d_1, d_2 = identification.coupling, identification.stiffness_variance, identification.damping_variance
    return d_1 + u * u * d_2, u * d_2, d_2


def bounded(covariance: np.ndarray, most: tuple[float, float]) -> np.ndarray:
    """Return the covariance P with P_11 - P_12^2/P_22 and P_22 limited to their initial values."""
    factor = np.array([[1.0, covariance[0, 1] / covariance[1, 1]], [0.0, 1.0]])
    d_1 = covariance[0, 0] - factor[0, 1] * covariance[0, 1]
    return factor @ np.diag([min(d_1, most[0]), min(covariance[1, 1], most[1])]) @ factor.T


def measure(signal: np.ndarray, start: float, low: float, high: float) -> np.ndarray:
    """Return the share of each period in which the polygon through `start` and signal is in (low, high)."""
    ends = np.stack([np.concatenate([[start], signal[:-1]]), signal])
    bottom, top = ends.min(axis=0), ends.max(axis=0)
    inside = np.maximum(np.minimum(top, high) - np.maximum(bottom, low), 0.0)
    still = (signal > low) & (signal < high)
    return np.divide(inside, top - bottom, out=still.astype(float), where=top > bottom)


def triangle(share: np.ndarray) -> np.ndarray:
    """Return, for each tick, the time beyond a threshold, weighted with a triangle over the last two periods.

    `share` is the share of each period beyond the threshold.
    """
    before = np.concatenate([[0.0], share[:-1]])
    return (share**2 + before**2) / 2 + share * before * (2 - share - before)


def bilinear(
    a: float,
    b: float,
    c: float,
    d: float,
    period: float,
    signal: np.ndarray,
    state: float,
    before: float,
) -> np.ndarray:
    """Return the trapezoidal simulation of z' = a z + c u, y = b z + d u, from uniform motion.

    For the lead, (1 + T_1 s)/(1 + T_2 s) = T_1/T_2 + (1 - T_1/T_2)/(1 + T_2 s); for the filtered derivative,
    1/tau - (1/tau)/(1 + tau s).
    """
    output = np.empty(len(signal))
    previous = before
    for n, value in enumerate(signal):
        state = ((1 + a * period / 2) * state + c * period / 2 * (previous + value)) / (1 - a * period / 2)
        previous = value
        output[n] = b * state + d * value
    return output


def test_no_compensation_returns_the_measured_force():
    ticks = readings(50)
    controller = Controller.from_dict(gain_document("none"))
    assert run(controller, ticks) == [tick[0] for tick in ticks]
    assert controller.identified == (0.0, 0.0)


def test_phase_lead_frequency_response_matches_tustin_transfer_function():
    lead, lag, period, omega = 0.008, 0.001, 0.001, 40.0
    controller = Controller.from_dict(gain_document("phase_lead", phase_lead=lead, lead_filter=lag))
    output = [controller.step(math.sin(omega * n * period), 0.0, 0.0, 0.0) for n in range(400)]
    s = 2 / period * complex(0.0, math.tan(omega * period / 2))
    transfer = (1 + (lead + lag) * s) / (1 + lag * s)
    for n in range(300, 400):
        expected = (transfer * complex(math.cos(omega * n * period), math.sin(omega * n * period))).imag
        assert output[n] == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.0004, 0.001, 0.008, 0.0083])
@pytest.mark.parametrize("clearance", [None, 0.001])
def test_response_error_agrees_with_matrix_equations(delay, clearance):
    document = gain_document(clearance=clearance, identification_delay=delay)
    ticks = readings(400, two_sided=clearance or 0.0)
    controller = Controller.from_dict(document)
    expected, theta = by_matrices(document, ticks)
    forces, identified = [], []
    for tick in ticks:
        forces.append(controller.step(*tick))
        identified.append(controller.identified)
    assert not np.allclose(theta[-1], theta[0], rtol=1e-3)
    np.testing.assert_allclose(forces, expected, atol=1e-9 * np.abs(expected).max(), rtol=0)
    np.testing.assert_allclose(np.array(identified), theta, rtol=1e-8)
    assert controller.status == "ok"


@pytest.mark.parametrize("name", sorted(set(GAINS) - {"position_lead"}))
def test_force_compensators_command_the_model_position_unchanged(name):
    controller = Controller.from_dict(gain_document(name))
    controller.step(0.0, 0.25, 3.0, 0.25)
    assert controller.position_command(0.25, 3.0, -7.0) == 0.25


def test_response_error_term_acts_only_while_aligned_position_is_in_contact():
    controller = Controller.from_dict(gain_document(identification_delay=0.0, initial_stiffness=1e5))
    # Without force nothing is identified: only the side of the surface counts, and the time spent there.
    for measured, stiffness in [(-1e-4, 0.0), (1e-4, 9e4), (-1e-9, 0.0), (0.0, 0.0), (1e-9, 9e4)]:
        controller.reset()
        forces = [controller.step(0.0, measured + 1e-5, 0.0, measured) for _ in range(4)]
        expected = stiffness * 1e-5 * np.array([0.5, 1.0, 1.0, 1.0])
        assert forces == pytest.approx(expected, rel=1e-12)


def test_response_error_term_fades_with_time_since_surface_was_left():
    document = gain_document(identification_delay=0.0, initial_stiffness=1e5, response_error_damping=0.0)
    for left in (0.0, 0.25, 0.5, 1.0):  # share of the period after the last tick in contact
        controller = Controller.from_dict(document)
        places = [1e-6, 1e-6, left * 1e-6, (left - 1) * 1e-6, -1e-6, -1e-6]
        forces = [controller.step(0.0, x + 1e-5, 0.0, x) for x in places]
        expected = [1 - (1 - left) ** 2 / 2, left**2 / 2, 0.0]
        assert forces[3:] == pytest.approx([9e4 * 1e-5 * gate for gate in expected], rel=1e-12)


def test_lead_filter_passes_constant_unchanged_and_leads_ramp_by_lead_time():
    constant, ramp = LeadFilter(0.02, 0.003, 0.001), LeadFilter(0.02, 0.003, 0.001)
    settled = [(constant.step(7.0), ramp.step(n * 0.001)) for n in range(200)][-1]
    assert settled == pytest.approx((7.0, 0.199 + 0.02), rel=1e-12)


def test_velocity_filter_has_no_transient_in_uniform_motion():
    velocity = VelocityFilter(0.004, 0.001)
    velocity.start(-2.0, 0.5)
    assert [velocity.step(-2.0 + 0.0005 * n) for n in range(50)] == pytest.approx([0.5] * 50, rel=1e-11)


@given(periods=st.floats(0.0, 40.0))
@settings(max_examples=50, deadline=None)
def test_delay_line_interpolates_between_samples(periods):
    period, speed = 0.002, 0.3
    samples = [1.0 + math.sin(0.7 * n) for n in range(60)]
    line = DelayLine(periods * period, period)
    line.start(samples[0], speed)
    delayed = [line.step(sample) for sample in samples]
    index = np.arange(-60, 60)
    record = np.concatenate([samples[0] + index[:60] * period * speed, samples])
    expected = np.interp(np.arange(60) - periods, index, record)
    np.testing.assert_allclose(delayed, expected, atol=1e-8)


def test_delay_line_of_whole_periods_does_not_interpolate():
    # Quotients such as 0.003/0.001 may be rounded up or down.
    for whole in range(40):
        line = DelayLine(whole * 0.001, 0.001)
        line.start(0.0, 0.0)
        delayed = [line.step(float(n % 2)) for n in range(100)]
        assert delayed[whole:] == pytest.approx([float(n % 2) for n in range(100 - whole)], abs=2e-9)


def test_delay_line_rejects_excessive_delay():
    with pytest.raises(ValueError, match="periods"):
        DelayLine(1e9, 1e-3)


@given(seed=st.integers(0, 2**32 - 1), forgetting=st.floats(0.9, 1.0))
@settings(max_examples=30, deadline=None)
def test_runtime_identification_equals_weighted_recursive_least_squares(seed, forgetting):
    rng = np.random.default_rng(seed)
    identification = ContactIdentification(2.0, -1.0, 5.0, 0.5, forgetting)
    theta, covariance = np.array([2.0, -1.0]), np.diag([5.0, 0.5])
    for weight in rng.choice([0.0, 0.3, 1.0], 40):
        phi, force = rng.normal(size=2), rng.normal()
        retained = 1.0 - weight * (1.0 - forgetting)
        column = weight * covariance @ phi / (retained + weight * phi @ covariance @ phi)
        theta = theta + column * (force - phi @ theta)
        covariance = bounded((covariance - np.outer(column, phi @ covariance)) / retained, (5.0, 0.5))
        identification.update(force, phi[0], phi[1], weight)
    result = [identification.stiffness, identification.damping]
    np.testing.assert_allclose(result, theta, rtol=1e-8, atol=1e-10)
    expected = [covariance[0, 0], covariance[0, 1], covariance[1, 1]]
    scale = np.abs(covariance).max()
    np.testing.assert_allclose(covariance_of(identification), expected, rtol=0, atol=1e-9 * scale)


def test_runtime_identification_covariance_stays_bounded():
    """Hold the contact still (damping is unobservable), and at zero depth (stiffness is unobservable)."""
    for deflection, rate in ((2e-4, 0.0), (0.0, 1e-3), (0.0, 0.0)):
        identification = ContactIdentification(1e5, 100.0, 1e12, 1e6, 0.8)
        for _ in range(100_000):
            identification.update(1.5e5 * deflection + 420.0 * rate, deflection, rate, 1.0)
        kk, kb, bb = covariance_of(identification)
        assert 0.0 < kk <= 1e12 and kb == 0.0 and 0.0 < bb <= 1e6
        assert max(kk / 1e12, bb / 1e6) == 1.0


def test_runtime_identification_converges_to_true_stiffness_and_damping():
    identification = ContactIdentification(0.0, 0.0, 1e16, 1e14, 1.0)
    for n in range(100):
        p, v = 1e-4 * math.sin(0.03 * n), 2e-3 * math.cos(0.03 * n)
        identification.update(1.5e5 * p + 420.0 * v, p, v, 1.0)
    assert identification.stiffness == pytest.approx(1.5e5, rel=1e-6)
    assert identification.damping == pytest.approx(420.0, rel=1e-6)
