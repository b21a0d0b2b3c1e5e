"""Passivity controller: the contact never returns more energy than it has received, for any readings."""

import math
from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from lanes import (
    IDEAL,
    MASS,
    PERIOD,
    STIFFNESS,
    VELOCITY,
    first_contact,
    mechanism,
    run_record,
    spread,
    validated,
)

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.simulation.loop_construction import build_loop

LAW = COMPENSATORS["passivity"]
EPSILON = 2.0**-52


def check(forces, velocities, period):
    """Check in exact arithmetic that the energy received by the contact is negative only by rounding."""
    law = ON_THE_RIG["passivity"]({}, period, math.inf)
    energy, moved, least, corrected = Fraction(0), Fraction(0), Fraction(0), 0
    for force, velocity in zip(forces, velocities, strict=True):
        command = law.step(force, 0.0, velocity, 0.0)
        assert math.isfinite(command) and abs(command) <= abs(force) * (1 + 8 * EPSILON)
        assert command * force >= 0
        taken = Fraction(period) * Fraction(command) * Fraction(velocity)
        energy += taken
        moved += abs(taken)
        corrected += command != force
        # Subnormal numbers have no relative precision.
        least += Fraction(5e-324) * (1 + abs(Fraction(force)) + abs(Fraction(velocity)))
        assert energy >= -moved * len(forces) * Fraction(2 * EPSILON) - 2 * least
    return corrected


def test_passivity_observer_energy_stays_nonnegative_for_random_readings():
    rng = np.random.default_rng(3)
    corrected = 0
    for size in (1e-9, 1.0, 1e6):
        for _ in range(10):
            forces, velocities = size * rng.standard_normal(300), 0.01 * rng.standard_normal(300)
            tiny = rng.choice([0.0, -0.0, 5e-324, 1e-300, -1e-20], 300)
            velocities = np.where(rng.random(300) < 0.1, tiny, velocities)
            corrected += check(forces.tolist(), velocities.tolist(), 1e-3)
    assert corrected > 300


ANY = st.floats(-1e120, 1e120) | st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e-160, 1.0, -1.0])


@given(rows=st.lists(st.tuples(ANY, ANY), min_size=1, max_size=30))
def test_passivity_observer_energy_stays_nonnegative_for_hostile_readings(rows):
    check(*zip(*rows, strict=True), 1e-3)


def test_passivity_observer_resets_energy_that_overflows():
    law = ON_THE_RIG["passivity"]({}, 1e-3, math.inf)
    assert law.step(1e308, 0.0, 1e308, 0.0) == 1e308
    # No energy was received, so none is returned.
    assert law.step(5.0, 0.0, -1.0, 0.0) == 0.0


def test_virtual_damping_of_passivity_controller_returns_energy_to_zero():
    """alpha = -E/(T v^2), where E includes the F of this tick."""
    law = ON_THE_RIG["passivity"]({}, 1e-3, math.inf)
    assert law.step(100.0, 0.0, 0.005, 0.0) == 100.0
    energy = 1e-3 * 100.0 * 0.005 + 1e-3 * 150.0 * -0.004
    alpha = -energy / (1e-3 * 0.004**2)
    assert law.step(150.0, 0.0, -0.004, 0.0) == pytest.approx(150.0 + alpha * -0.004, rel=1e-12)
    assert law.step(50.0, 0.0, -0.004, 0.0) == 0.0
    assert law.step(50.0, 0.0, 0.0, 0.0) == 50.0


def test_passivity_energy_is_reset_at_next_contact_but_not_at_other_surface():
    energy, yes = jnp.asarray([1.0, 2.0]), jnp.asarray([True, False])
    assert LAW.restart({}, energy, yes, yes).tolist() == [0.0, 2.0]
    assert LAW.restart({}, energy, yes, ~yes).tolist() == [1.0, 2.0]


@pytest.mark.parametrize("damping", [0.0, 300.0])
def test_passivity_controller_limits_restitution_of_delayed_contact(damping):
    """The observer sees the energy only at ticks, which leaves an excess of (T F_c)^2/(2 M) per tick."""
    parsed = validated(mechanism({"damping": [damping]}, IDEAL))
    delay = np.array([0.001, 0.004, 0.01, 0.02])
    scenario = spread(parsed, len(delay), force_sensor__delay=delay)
    without = first_contact(parsed, scenario, "none")["restitution"]
    metrics, ticks = run_record(build_loop(parsed, "passivity", scenario), {}, scenario, 400)
    result = np.asarray(metrics.restitution)[0]
    force = np.where(ticks.active, ticks.command, 0)
    most = np.sqrt(1 + np.sum((PERIOD * force / MASS) ** 2, axis=0) / VELOCITY**2)
    print(without, result, most)
    assert np.all(without[1:] > 1.02) and np.all(result[1:] > 0.95)
    assert np.all(result <= most + 1e-9) and np.all(result <= without + 1e-12)
    # The undelayed contact leaves 1 + pi omega T/4; a delayed contact is longer and has a larger force.
    assert np.all(most - 1 < 2 * math.pi * math.sqrt(STIFFNESS / MASS) * PERIOD / 4)
