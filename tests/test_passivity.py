"""Passivity controller: the contact returns at most the energy that it has received, except for one tick."""

import itertools
import math

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
from jaxhil.laws.passivity.simulation import ObservedEnergy
from jaxhil.laws.simulation_base import KnownConstants, Signals
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.simulation.integrators import INTEGRATORS
from jaxhil.simulation.loop_construction import build_loop

LAW = COMPENSATORS["passivity"]
KNOWN = KnownConstants(jnp.asarray(1e-3), jnp.asarray(math.inf))


def run_model(forces, mass, velocity, period=1e-3):
    """Return the velocities [m/s] of a model under the commands for these readings; check the commands."""
    law = ON_THE_RIG["passivity"]({}, period, math.inf)
    velocities = [velocity]
    for force in forces:
        command = law.step(force, 0.0, velocities[-1], 0.0)
        assert math.isfinite(command) and abs(command) <= abs(force)
        velocities.append(velocities[-1] - period * command / mass)
    return np.array(velocities)


def test_passivity_bounds_energy_of_model_by_one_tick_for_random_readings():
    """The model gains at most (T F)^2/(2 M), however many ticks it runs."""
    rng = np.random.default_rng(3)
    for mass, velocity in itertools.product((1.0, 300.0, 1e5), (1e-4, 0.01, -0.3)):
        forces = 500.0 * mass * abs(velocity) * rng.standard_normal(2000)
        speeds = run_model(forces.tolist(), mass, velocity)
        gained = 0.5 * mass * (speeds**2 - velocity**2)
        assert gained.max() <= np.max((1e-3 * forces) ** 2) / (2 * mass) * (1 + 1e-9)
        assert np.std(speeds) > 0.1 * abs(velocity)


ANY = st.floats(-1e120, 1e120) | st.sampled_from([0.0, -0.0, 5e-324, -5e-324, 1e-160, 1.0, -1.0])


@given(rows=st.lists(st.tuples(ANY, ANY), min_size=1, max_size=30))
def test_passivity_command_is_finite_and_at_most_the_reading_for_hostile_readings(rows):
    law = ON_THE_RIG["passivity"]({}, 1e-3, math.inf)
    for force, velocity in rows:
        assert abs(law.step(force, 0.0, velocity, 0.0)) <= abs(force)


def test_passivity_observer_ignores_energy_that_overflows():
    law = ON_THE_RIG["passivity"]({}, 1e-3, math.inf)
    assert law.step(1e308, 0.0, 1e308, 0.0) == 1e308
    # No energy was received, so none is returned.
    assert law.step(5.0, 0.0, -1e308, 0.0) == 0.0
    assert law.step(5.0, 0.0, -1.0, 0.0) == 0.0


def test_virtual_damping_of_passivity_controller_returns_energy_to_zero():
    """alpha = -(E + T F v)/(T v^2), where E contains the mean velocity of each past period."""
    law = ON_THE_RIG["passivity"]({}, 1e-3, math.inf)
    assert law.step(100.0, 0.0, 0.005, 0.0) == 100.0
    energy = 1e-3 * 100.0 * (0.005 + 0.001) / 2
    assert law.step(20.0, 0.0, 0.001, 0.0) == 20.0
    energy += 1e-3 * 20.0 * (0.001 - 0.004) / 2
    alpha = -(energy + 1e-3 * 150.0 * -0.004) / (1e-3 * 0.004**2)
    assert law.step(150.0, 0.0, -0.004, 0.0) == pytest.approx(150.0 + alpha * -0.004, rel=1e-12)
    assert law.step(50.0, 0.0, -0.004, 0.0) == pytest.approx(0.0, abs=1e-12)
    assert law.step(50.0, 0.0, 0.0, 0.0) == 50.0


@pytest.mark.parametrize("integrator", ["semi_implicit_euler", "zoh", "explicit_euler"])
def test_passivity_observer_equals_energy_that_the_model_has_lost(integrator):
    """Without the integrator's part, the observed energy would be too large by (T F_c)^2/(2 M) per tick."""
    period, mass, velocity, position = 1e-3, 300.0, 0.005, 0.0
    law = ON_THE_RIG["passivity"]({}, period, math.inf)
    state, start = LAW.init({}, KNOWN, 0), 0.5 * mass * velocity**2
    for tick in range(170):
        force = 1e5 * max(position, 0.0)
        command = law.step(force, position, velocity, 0.0)
        signals = Signals(*map(jnp.asarray, (force, position, velocity, 0.0, tick)))
        simulated, state = LAW.step(period, state, signals, jnp.asarray(tick))
        assert float(simulated) == pytest.approx(command, rel=1e-12, abs=1e-300)
        assert float(state.energy) == pytest.approx(start - 0.5 * mass * velocity**2, abs=1e-15)
        step = INTEGRATORS[integrator]
        position, velocity = step(position, velocity, -command / mass, period)
    # An observer without the integrator's energy would leave 1 + pi omega T/4 = 1.0143.
    assert velocity == pytest.approx(-0.005, rel=2e-3)


def test_passivity_energy_is_reset_at_next_contact_but_not_at_other_surface():
    energy, yes = jnp.asarray([1.0, 2.0]), jnp.asarray([True, False])
    state = ObservedEnergy(energy, 2 * energy, 3 * energy)
    assert LAW.restart({}, state, yes, yes).velocity.tolist() == [0.0, 6.0]
    assert LAW.restart({}, state, yes, ~yes).energy.tolist() == [1.0, 2.0]


@pytest.mark.parametrize("damping", [0.0, 300.0])
def test_passivity_controller_limits_restitution_of_delayed_contact(damping):
    """The contact gains at most (T F_c)^2/(2 M), the energy of one tick, which is of second order in T."""
    parsed = validated(mechanism({"damping": [damping]}, IDEAL))
    delay = np.array([0.001, 0.004, 0.01, 0.02])
    scenario = spread(parsed, len(delay), force_sensor__delay=delay)
    without = first_contact(parsed, scenario, "none")["restitution"]
    metrics, ticks = run_record(build_loop(parsed, "passivity", scenario), {}, scenario, 400)
    result = np.asarray(metrics.restitution)[0]
    force = np.where(ticks.active, ticks.command, 0)
    most = np.sqrt(1 + np.max((PERIOD * force / MASS) ** 2, axis=0) / VELOCITY**2)
    print(without, result, most)
    assert np.all(without[1:] > 1.02) and np.all(result[1:] > 0.95)
    assert np.all(result <= most + 1e-9) and np.all(result <= without + 1e-12)
    # An observer without the integrator's energy leaves 1 + pi omega T/4 and more.
    assert np.all(most - 1 < 0.2 * math.pi * math.sqrt(STIFFNESS / MASS) * PERIOD / 4)
