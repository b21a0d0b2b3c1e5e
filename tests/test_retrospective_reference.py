"""The retrospective reference: the errors it leaves, its settings, derivatives, what it says of itself."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK, as_arrays, join, nominal_gains, run_rollout

from jaxhil.compensators import COMPENSATORS, literature_gains
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.runtime.law_status import (
    DISPLACED,
    IDENTIFIED,
    OUT_OF_CONTACT,
    SATURATED,
    TOO_SHORT,
    UNSURE,
)
from jaxhil.runtime.laws.retrospective_reference import RetrospectiveReference
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import compare_with_reference
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios

NAME, PERIOD = "retrospective_reference", 1e-3
compared = jax.jit(compare_with_reference, static_argnums=0, compiler_options=QUICK)


# What is set, what is left, root mean square and worst [%]; the published law, tuned to each suite, leaves 2
# to 6 rms.
SUITES = {
    "noisy": ("noisy", [], 0.5, 1.5),
    "damped": ("damped", [], 0.5, 1.5),
    "hertz": ("hertz", [], 0.6, 2.0),
    "elastoplastic": ("elastoplastic", [], 1.5, 5.0),
    "fast": ("fast", [], 1.5, 5.0),
    "dead zone": ("dead-zone", [], 2.5, 8.0),
    "dead zone, little noise": ("noisy", ["rig.force_sensor.dead_zone=12.0"], 0.8, 2.5),
    "plane": ("plane", [], 0.5, 1.5),
    "5 N of bias": ("noisy", ["rig.force_sensor.bias=5.0", "rig.contact_plane=1e-3"], 0.5, 1.5),
    "preload": ("preload", [], 0.8, 2.0),
    "friction": ("friction", [], 0.8, 2.0),
}


# Each a program of its own.
SELDOM = ("hertz", "elastoplastic", "dead zone", "5 N of bias", "preload", "friction")


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow if case in SELDOM else ()) for case in SUITES]
)
def test_errors_of_the_standard_suites(case):
    suite, changes, rms, worst = SUITES[case]
    mechanism = load(f"suite-{suite}", changes).mechanism
    scenario = join([build_scenarios(mechanism, draw(mechanism, 64, 3), 3)])
    loop = build_loop(mechanism, NAME, scenario)
    metrics = run_rollout(loop, as_arrays(nominal_gains(mechanism, NAME)), scenario)
    outcome = compared(loop, scenario, metrics)
    assert np.all(np.asarray(outcome.good)[0])
    error = 100 * np.asarray(outcome.error)[0]
    print(case, np.sqrt(np.mean(error**2)), np.max(np.abs(error)))
    assert np.sqrt(np.mean(error**2)) < rms and np.max(np.abs(error)) < worst


def test_settings_are_gains_within_bounds_and_gentle_commands_less():
    mechanism = load("suite-damped").mechanism
    law = COMPENSATORS[NAME]
    assert list(law.settings) == ["sharp", "gentle"]
    assert literature_gains(mechanism, NAME, "sharp") == literature_gains(mechanism, NAME)
    peaks = {}
    scenario = join([build_scenarios(mechanism, draw(mechanism, 64, 3), 3)])
    loop = build_loop(mechanism, NAME, scenario)
    for name, chosen in law.settings.items():
        gains = literature_gains(mechanism, NAME, name)
        assert gains.items() >= chosen.items() and set(gains) == {gain.name for gain in law.gains}
        outcome = compared(loop, scenario, run_rollout(loop, as_arrays(gains), scenario))
        peaks[name] = np.percentile(np.asarray(outcome.peak_ratio)[0], 99)
        assert np.sqrt(np.mean(np.asarray(outcome.error)[0] ** 2)) < 0.005
    print(peaks)
    assert peaks["gentle"] - 1 < 0.85 * (peaks["sharp"] - 1) and peaks["sharp"] < 2.7
    # A slow rig gets no more than its period allows.
    slow = load("suite-damped", ["rig.control_period=0.008"]).mechanism
    assert literature_gains(slow, NAME, "sharp")["velocity_gain"] == pytest.approx(125.0)
    with pytest.raises(KeyError):
        literature_gains(mechanism, "phase_lead", "gentle")


@pytest.mark.slow
def test_derivatives_against_differences():
    """By every gain that tuning moves, of every scenario's restitution error."""
    mechanism = load("suite-damped").mechanism
    lanes = 8
    scenario = jax.tree.map(jnp.asarray, build_scenarios(mechanism, draw(mechanism, lanes, 3), 3))
    loop = build_loop(mechanism, NAME, scenario)
    nominal = nominal_gains(mechanism, NAME)
    names = [gain.name for gain in COMPENSATORS[NAME].gains if gain.tuned(mechanism)]

    @jax.jit
    def errors(change):
        gains = {name: jnp.full(lanes, value) for name, value in nominal.items()}
        gains |= {name: gains[name] * jnp.exp(change[i]) for i, name in enumerate(names)}
        return compare_with_reference(loop, scenario, rollout(loop, gains, scenario)).error[0]

    nowhere, step = jnp.zeros((len(names), 1)), 1e-4
    slope = jax.jit(lambda towards: jax.jvp(errors, (nowhere,), (towards,))[1])
    for place, name in enumerate(names):
        towards = nowhere.at[place].set(1.0)
        exact = np.asarray(slope(towards))
        between = np.asarray(errors(step * towards) - errors(-step * towards)) / (2 * step)
        assert np.max(np.abs(exact)) > 1e-6, name
        # Where a decision falls within the step, the two have to part: not in more than one lane.
        apart = np.abs(exact - between) > 1e-4 * np.max(np.abs(between))
        assert np.sum(apart) <= 1, (name, exact, between)


def driven(gains, stiffness, lag=30, plane=0.0, ticks=400):
    """Statuses of a law on a contact that the hardware follows so many ticks late; the law. The surface is at
    the `plane` [m]."""
    law = RetrospectiveReference(gains, PERIOD, math.inf)
    position, velocity, seen = -1.015e-4, 5e-3, []
    path = [position - tick * PERIOD * velocity for tick in range(lag + 8, 0, -1)]
    for _ in range(ticks):
        path.append(position)
        command = law.step(stiffness * max(path[-9 - lag] - plane, 0.0), position, velocity, path[-1 - lag])
        velocity -= PERIOD * command / 350.0
        position += PERIOD * velocity
        seen.append(law.status)
    return seen, law


def test_status_says_what_stands_behind_the_command():
    values = nominal_gains(load("suite-noisy").mechanism, NAME)
    seen, law = driven(values, 2.5e5)
    met = 20.3 + 38  # tick of the hardware's surface, as the force tells of it
    first = next(tick for tick, status in enumerate(seen) if status != OUT_OF_CONTACT)
    assert met < first < met + 8 and seen[first] == UNSURE
    assert {IDENTIFIED, SATURATED} & set(seen[70:140]) and seen[-1] == OUT_OF_CONTACT
    assert not {TOO_SHORT, DISPLACED} & set(seen)
    # A contact of 8 Hz, into which the hardware comes when half of it is over.
    seen, law = driven(values, 9e5)
    assert TOO_SHORT in seen
    # A surface that is farther from where it was told than ever expected.
    seen, law = driven(values | {"plane_spread": 1e-5}, 2.5e5, plane=1e-4)
    assert DISPLACED in seen and law.contact_plane == pytest.approx(1e-4, abs=5e-6)
    # A run that begins in contact: nothing to scale by, so that the measured force is passed on.
    law.reset()
    assert law.step(31.0, 1e-3, 0.0, 1e-3) == pytest.approx(31.0, rel=1e-15)
    assert law.status == UNSURE


def test_a_known_dead_zone_is_added_to_what_is_read():
    """The first reading that comes through counts for all of it, on either surface."""
    values = nominal_gains(load("suite-noisy").mechanism, NAME, dead_zone=12.0)
    law = RetrospectiveReference(values, PERIOD, 0.002)
    assert law.step(3.0, 1e-3, 0.0, 1e-3) == pytest.approx(15.0, rel=1e-15)
    law.reset()
    assert law.step(-3.0, -3e-3, 0.0, -3e-3) == pytest.approx(-15.0, rel=1e-15)
    law.reset()
    assert law.step(0.0, 1e-3, 0.0, 1e-3) == 0
