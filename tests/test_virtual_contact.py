"""Virtual contact: root of its characteristic equation at the stability limit, and the simulated loop."""

import cmath
import math

import numpy as np
import pytest
from endless import OMEGA, STIFFNESS, characteristic_root, decay, growth, persistent, spring
from hypothesis import given
from hypothesis import strategies as st
from lanes import MASS

from jaxhil.laws.compensators import literature_gains
from jaxhil.laws.virtual_contact.simulation import damping_at_the_limit
from jaxhil.mechanism.file import load


@given(
    mass=st.floats(0.1, 1e4),
    frequency=st.floats(0.1, 1e3),
    angle=st.floats(0.0, 0.01) | st.floats(0.0, 1.0) | st.floats(0.0, 50.0),
)
def test_virtual_contact_has_an_imaginary_root_at_the_stability_limit(mass, frequency, angle):
    stiffness, delay = mass * frequency**2, angle / frequency
    damping, critical = damping_at_the_limit(stiffness, frequency, delay)
    root = 1j * critical
    value = mass * root**2 + damping * root + stiffness * cmath.exp(-root * delay)
    assert abs(value) <= 1e-9 * stiffness and damping >= 0 and 0 < critical <= frequency
    # Lowest frequency that satisfies the condition.
    below = critical * np.linspace(0, 0.999, 50)
    assert np.all(np.cos(below * delay) > (below / frequency) ** 2)


def test_nominal_virtual_damping_is_stability_limit_for_total_delay():
    overrides = ["rig.force_sensor.delay=0.003", "rig.force_sensor.time_constant=0.002"]
    simulator = 'rig.simulator={model="first_order", time_constant=0.01, delay=0.004}'
    mechanism = load("rod-100n-mm", [*overrides, simulator, "uncertainty={}"]).mechanism
    gains = literature_gains(mechanism, "virtual_contact")
    [stiffness], mass = mechanism.contact.stiffness, mechanism.bodies.mass
    damping, _ = damping_at_the_limit(stiffness, math.sqrt(stiffness / mass), 0.003 + 0.002 + 0.01 + 0.004)
    assert gains["virtual_damping"] == pytest.approx(damping, rel=1e-12) and damping > 0
    assert gains["virtual_stiffness"] == 0.0


def test_simulated_virtual_contact_is_marginal_at_the_stability_limit():
    """The growth per half-cycle, pi Re s/Im s, is 0 at the limit.

    Semi-implicit Euler delays the velocity by half a period; this first-order error is removed by
    extrapolation to T = 0.
    """
    delay = np.repeat([0.1, 0.2, 0.4], 3) / OMEGA
    share, added = np.tile([0.9, 1.0, 1.1], 3), np.tile([0.0, 0.0, 0.2 * STIFFNESS], 3)
    damping = share * np.array([damping_at_the_limit(STIFFNESS, OMEGA, one)[0] for one in delay])
    gains = {"virtual_damping": np.tile(damping, 2), "virtual_stiffness": np.tile(added, 2)}
    leaves = {"force_sensor__delay": np.tile(delay, 2), "control_period": np.repeat([1e-3, 5e-4], 9)}
    coarse, fine = np.split(growth(persistent(spring(), "virtual_contact", 1.5, gains, **leaves)), 2)
    result = 2 * fine - coarse
    roots = [
        characteristic_root(lambda s, b=b, k=k, t=t: MASS * s**2 + b * s + k + STIFFNESS * cmath.exp(-s * t))
        for b, k, t in zip(damping, added, delay, strict=True)
    ]
    expected = [decay(root) for root in roots]
    print(np.max(np.abs(result - expected)), result)
    np.testing.assert_allclose(result, expected, rtol=0, atol=3e-5)
    assert (
        np.all(np.abs(result[1::3]) < 3e-5) and np.all(result[0::3] > 0.01) and np.all(result[2::3] < -0.01)
    )
