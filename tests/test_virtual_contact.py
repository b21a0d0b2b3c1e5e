"""Virtual contact and its characteristic equation: a root at the limit, and the simulated loop there."""

import cmath
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lanes import IDEAL, MASS, per_lane, run_record, spread, validated
from lanes import mechanism as plain

from jaxhil.building import build_loop
from jaxhil.compensators import literature_gains
from jaxhil.compensators.virtual_contact import damping_at_the_limit
from jaxhil.mechanism_file import load

OMEGA = 2 * math.pi * 3.0
STIFFNESS = MASS * OMEGA**2


@given(
    mass=st.floats(0.1, 1e4),
    frequency=st.floats(0.1, 1e3),
    angle=st.floats(0.0, 0.01) | st.floats(0.0, 1.0) | st.floats(0.0, 50.0),
)
def test_the_limit_has_an_imaginary_root(mass, frequency, angle):
    stiffness, delay = mass * frequency**2, angle / frequency
    damping, critical = damping_at_the_limit(stiffness, frequency, delay)
    root = 1j * critical
    value = mass * root**2 + damping * root + stiffness * cmath.exp(-root * delay)
    assert abs(value) <= 1e-9 * stiffness and damping >= 0 and 0 < critical <= frequency
    # The least frequency: below it the two sides of the condition do not meet.
    below = critical * np.linspace(0, 0.999, 50)
    assert np.all(np.cos(below * delay) > (below / frequency) ** 2)


def test_nominal_damping_is_the_limit_of_all_delay():
    """That of the force measurement, and of the motion simulator as it follows a uniform motion."""
    overrides = ["rig.force_sensor.delay=0.003", "rig.force_sensor.time_constant=0.002"]
    simulator = ["rig.simulator.model=first_order", "rig.simulator.time_constant=0.01"]
    mechanism = load("rod-100n-mm", [*overrides, *simulator, "rig.simulator.delay=0.004"]).mechanism
    gains = literature_gains(mechanism, "virtual_contact")
    [stiffness], mass = mechanism.contact.stiffness, mechanism.bodies.mass
    damping, _ = damping_at_the_limit(stiffness, math.sqrt(stiffness / mass), 0.003 + 0.002 + 0.01 + 0.004)
    assert gains["virtual_damping"] == pytest.approx(damping, rel=1e-12) and damping > 0
    assert gains["virtual_stiffness"] == 0.0


def growth(period, delay, damping, stiffness):
    """Logarithm of the ratio of successive extrema of x_d in a contact that never lets go, per lane."""
    parsed = validated(plain({"stiffness": [STIFFNESS], "tension": True}, IDEAL, 0.0))
    lanes = len(delay)
    leaves = {"clearance": np.zeros(lanes), "force_sensor__delay": delay, "control_period": period}
    scenario = spread(parsed, lanes, **leaves)
    gains = per_lane({"virtual_damping": damping, "virtual_stiffness": stiffness}, lanes)
    loop = build_loop(parsed, "virtual_contact", scenario)
    ticks = run_record(loop, gains, scenario, 3000)[1]
    rates = []
    for x in np.abs(np.asarray(ticks.signals.position_desired)).T:
        top = np.flatnonzero((x[1:-1] > x[:-2]) & (x[1:-1] >= x[2:])) + 1
        bend = 2 * x[top] - x[top - 1] - x[top + 1]
        heights = x[top] + (x[top + 1] - x[top - 1]) ** 2 / (8 * bend)
        half = len(heights) // 2
        rates.append(np.log(heights[-1] / heights[half]) / (len(heights) - 1 - half))
    return np.array(rates)


def test_the_simulated_loop_is_marginal_at_the_limit():
    """Growth per half-cycle of an endless contact, pi Re s/Im s of the characteristic root: 0 at the limit.

    Semi-implicit Euler has the velocity half a period late: what is of first order in T is extrapolated.
    """
    angle = np.repeat([0.1, 0.2, 0.4], 3)
    delay = angle / OMEGA
    share, stiffness = np.tile([0.9, 1.0, 1.1], 3), np.tile([0.0, 0.0, 0.2 * STIFFNESS], 3)
    limit = np.array([damping_at_the_limit(STIFFNESS, OMEGA, one)[0] for one in delay])
    root = np.full(9, 1j * OMEGA)
    for _ in range(60):
        shifted = STIFFNESS * np.exp(-root * delay)
        value = MASS * root**2 + share * limit * root + stiffness + shifted
        root = root - value / (2 * MASS * root + share * limit - delay * shifted)
    period = np.repeat([1e-3, 5e-4], 9)
    coarse, fine = np.split(growth(period, *np.tile([delay, share * limit, stiffness], 2)), 2)
    found = 2 * fine - coarse
    np.testing.assert_allclose(found, np.pi * root.real / root.imag, rtol=0, atol=2e-4)
    assert np.all(np.abs(found[1::3]) < 2e-4) and np.all(found[0::3] > 0.01) and np.all(found[2::3] < -0.01)
