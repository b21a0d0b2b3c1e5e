"""Low-pass filter of the force sensor: poles, exact response, derivative, rehearsal, rejections."""

import numpy as np
import pytest
from lanes import SECOND_ORDER, mechanism, validated
from oracle import simulate
from rig_lock_step import closed_loop
from scipy import integrate, signal

import jaxhil
from jaxhil.contact.laws import find_contact_law
from jaxhil.errors import InputError
from jaxhil.laws.shared.nominal_values import force_delay
from jaxhil.mechanism.sensor_filter import find_modes
from tuning.bundle.fmu.rig import rig_fmu
from tuning.rig.sensor_lag import MotionState, apply_sensor_filter

FILTERS = [(kind, order) for kind in ("butterworth", "bessel") for order in (1, 2, 3, 4)]


def filtered(kind="bessel", order=4, cutoff=40.0, **contact):
    """Return the mechanism file of a damped contact behind a filter."""
    sensor = {"filter": {"kind": kind, "order": order, "cutoff": cutoff}}
    return mechanism({"damping": [300.0], **contact}, SECOND_ORDER, 0.0023, force_sensor=sensor)


@pytest.mark.parametrize(("kind", "order"), FILTERS)
def test_filter_modes_equal_the_analogue_prototype_of_scipy(kind, order):
    prototype = signal.buttap(order) if kind == "butterworth" else signal.besselap(order, norm="mag")
    modes = find_modes(kind, order)
    s = 1j * np.logspace(-2, 1.5, 15)
    response = 0.0 * s
    for rate, weight in zip(modes.rates, modes.weights, strict=True):
        mode = weight * rate / (s + rate)
        conjugate = np.conj(weight * rate) / (s + np.conj(rate))
        response = response + (0.5 * (mode + conjugate) if rate.imag else mode)
    expected = prototype[2] / np.prod([s - pole for pole in prototype[1]], axis=0)
    np.testing.assert_allclose(response, expected, rtol=0, atol=1e-13)
    assert modes.delay == pytest.approx(-sum(1 / complex(pole) for pole in prototype[1]).real, rel=1e-12)


def test_nominal_force_delay_includes_the_delay_of_the_filter():
    assert force_delay(validated(filtered("butterworth", 2, 250.0))) == pytest.approx(0.0023 + 0.225079 / 250)


def test_filter_of_rehearsal_follows_force_of_a_segment():
    """Press a spring in at constant speed, and compare with numerical integration of the state space."""

    contact = validated(mechanism({"law": "linear"})).contact
    law = find_contact_law("linear").as_float_law(contact, 1e5, 0.0)
    modes, duration, cutoff = find_modes("butterworth", 3), 0.002, 700.0
    start, end = MotionState(-2e-6, 0.005), MotionState(8e-6, 0.005)
    rates = [cutoff * rate for rate in modes.rates]
    outputs = apply_sensor_filter([0j] * 2, law, np.inf, start, end, duration, rates)
    reading = sum((weight * mode).real for weight, mode in zip(modes.weights, outputs, strict=True))
    a, b, c, _ = signal.tf2ss([cutoff**3], np.poly(signal.buttap(3)[1] * cutoff).real)

    def rate(time, state):
        return a @ state + b[:, 0] * 1e5 * max(0.0, -2e-6 + 0.005 * time)

    solution = integrate.solve_ivp(rate, (0, duration), np.zeros(3), rtol=1e-11, atol=1e-14, max_step=1e-5)
    assert reading == pytest.approx((c @ solution.y[:, -1])[0], rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "order"), FILTERS)
def test_simulation_and_rehearsal_with_filter_agree_with_oracle(kind, order):
    raw = filtered(kind, order, 40.0 if order % 2 else 250.0)
    expected, parsed = simulate(raw)[0]["restitution"], validated(raw)
    assert jaxhil.simulate(parsed).contacts[0].restitution == pytest.approx(expected, abs=1e-10)
    contacts, _ = closed_loop(parsed, "none", {})
    assert contacts[0].restitution == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_sensor_filter_of_order_1_equals_first_order_lag():
    lag = {"time_constant": 1 / (2 * np.pi * 40.0)}
    plain = mechanism({"damping": [300.0]}, SECOND_ORDER, 0.0023, force_sensor=lag)
    expected = jaxhil.simulate(validated(plain)).contacts[0].restitution
    for kind in ("butterworth", "bessel"):
        result = jaxhil.simulate(validated(filtered(kind, 1))).contacts[0].restitution
        assert result == pytest.approx(expected, abs=1e-10)


@pytest.mark.slow
def test_restitution_derivative_for_filter_cutoff_equals_central_difference():
    name, step = "rig.force_sensor.filter.cutoff", 0.02
    slope = jaxhil.jacobian(validated(filtered()), by=name)[name][0]
    ends = [simulate(filtered(cutoff=40.0 + sign * step))[0]["restitution"] for sign in (1, -1)]
    assert slope == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-6)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ({"kind": "chebyshev", "order": 2, "cutoff": 9.0}, "rig.force_sensor.filter.kind: found 'chebyshev'"),
        ({"kind": "bessel", "order": 5, "cutoff": 9.0}, "rig.force_sensor.filter.order: found 5"),
        ({"kind": "bessel", "order": 2, "cutoff": 0.0}, "rig.force_sensor.filter.cutoff: found 0.0"),
        ({"kind": "bessel", "order": 2}, "rig.force_sensor.filter.cutoff: found nothing"),
    ],
)
def test_invalid_sensor_filter_is_rejected_with_one_line_message(sensor, message):
    raw = mechanism({}, force_sensor={"filter": sensor})
    with pytest.raises(InputError) as caught:
        validated(raw)
    assert message in str(caught.value) and str(caught.value).isprintable()


def test_sensor_filter_together_with_time_constant_is_rejected():
    sensor = {"time_constant": 0.001, "filter": {"kind": "bessel", "order": 2, "cutoff": 90.0}}
    with pytest.raises(InputError, match=r"time_constant: found 0\.001, expected nothing"):
        validated(mechanism({}, force_sensor=sensor))


def test_fmu_of_rig_rejects_filter():
    with pytest.raises(InputError, match=r"fmu: rig\.force_sensor\.filter: found a filter, expected none"):
        rig_fmu({"mechanism": filtered(), "figures": {}}, 3)
