"""Where a surface was met behind a lag: against exact densities and in JAX; what the bank of delays makes of
a lag, and says of it, in Python and in C bit for bit."""

import c99_cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c99_cases import RESULT, ROW, assert_same, controller_in_python, packed
from rig_lock_step import controller
from test_delay_bank_accuracy import restitution
from test_law_status import run

from jaxhil.compensators import lagged_onset as in_jax
from jaxhil.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.runtime.gain_file import GainFile
from jaxhil.runtime.law_status import IDENTIFIED, UNEXPLAINED
from jaxhil.runtime.laws.hypotheses import LAG_STEP
from jaxhil.runtime.laws.lagged_onset import (
    AFTER,
    BEFORE,
    DAMPING_VARIANCE,
    PLACES,
    WINDOW,
    lagged_onset,
)
from jaxhil.runtime.laws.lagged_onsets import lagged_onsets
from jaxhil.runtime.laws.onset import STIFFNESS, STIFFNESS_VARIANCE
from jaxhil.runtime.limits import NO_LIMITS

LAW, PERIOD, NOISE = "retrospective_delay_bank", 1e-3, 0.08
LAGS = np.array([0.0005, 0.002, 0.004])


def readings(stiffness, damping, lag, place, ticks=WINDOW):
    """Depths [s] beyond where the surface was met by the readings, which lies at `place` [s], and forces
    [1/s] without noise."""
    depths = PERIOD * (np.arange(ticks) - ticks + 9.4)
    s = np.maximum(depths - place, 0)
    smooth = 1 - np.exp(-s / lag)
    return depths, damping * smooth + stiffness * (s - lag * smooth)


def test_places_are_those_of_normal_densities():
    rng = np.random.default_rng(0)
    depths, forces = readings(300.0, 1.5, 0.002, -0.001)
    forces += NOISE * rng.standard_normal(len(forces))
    mean, variance = lagged_onsets(LAGS, depths.tolist(), forces.tolist(), NOISE**2, PERIOD)
    for lag, found, around in zip(LAGS, mean, variance, strict=True):
        places = np.linspace(-lag - BEFORE * PERIOD, AFTER * PERIOD, PLACES)
        likely = np.empty(PLACES)
        for i, place in enumerate(places):
            s = np.maximum(depths - place, 0)
            smooth = 1 - np.exp(-s / lag)
            phi = np.column_stack([smooth, s - lag * smooth])
            covariance = np.diag([DAMPING_VARIANCE, STIFFNESS_VARIANCE])
            spread = phi @ covariance @ phi.T + NOISE**2 * np.eye(len(s))
            away = forces - phi @ [0, STIFFNESS]
            likely[i] = -0.5 * (away @ np.linalg.solve(spread, away) + np.linalg.slogdet(spread)[1])
        weights = np.exp(likely - likely.max()) / np.sum(np.exp(likely - likely.max()))
        step = places[1] - places[0]
        assert found == pytest.approx(weights @ places, abs=0.1 * step)
        exact = weights @ (places - weights @ places) ** 2 + step**2 / 12
        assert around == pytest.approx(exact, rel=0.15)


@pytest.mark.parametrize("damping", [0.0, 2.0])
@pytest.mark.parametrize("lag", LAGS)
def test_a_surface_is_found_behind_its_lag(lag, damping):
    rng, place, errors = np.random.default_rng(1), -0.0012, []
    for _ in range(20):
        depths, forces = readings(400.0, damping, lag, place)
        forces += NOISE * rng.standard_normal(len(forces))
        mean, variance = lagged_onsets(np.array([lag]), depths.tolist(), forces.tolist(), NOISE**2, PERIOD)
        assert variance[0] > 0
        errors.append(mean[0] - place)
    assert np.sqrt(np.mean(np.square(errors))) < 8e-4


def test_one_lag_is_as_many():
    depths, forces = (values.tolist() for values in readings(300.0, 1.5, 0.002, -0.001))
    means, variances = lagged_onsets(LAGS, depths, forces, NOISE**2, PERIOD)
    one = [lagged_onset(lag, depths, forces, NOISE**2, PERIOD) for lag in LAGS.tolist()]
    np.testing.assert_allclose(np.array(one).T, [means, variances], rtol=1e-12)


def test_both_agree_and_hidden_readings_do_not_count():
    depths, forces = readings(300.0, 1.5, 0.002, -0.001)
    shown = np.arange(WINDOW) % 7 != 3
    ours = lagged_onsets(LAGS, depths[shown].tolist(), forces[shown].tolist(), NOISE**2, PERIOD)
    zero = jnp.zeros(())
    window = in_jax.Window(jnp.asarray(depths), jnp.asarray(forces), jnp.asarray(shown), zero + NOISE**2)
    theirs = jax.jit(in_jax.lagged_onsets)(jnp.asarray(LAGS), window, zero + PERIOD)
    np.testing.assert_allclose(theirs, ours, rtol=1e-9)


def bank(told, changes=(), **gains):
    """The law's gain file by what it is told of the damped suite, and contacts of the mechanism as it is."""
    mechanism = load("suite-damped", [*told, *changes]).mechanism
    known = load("suite-damped", list(told)).mechanism
    made = GainFile(
        LAW, literature_gains(known, LAW) | gains, known.rig.control_period, known.contact.clearance
    )
    return mechanism, made._replace(limits={**NO_LIMITS, "settling": 0.02, "free_force": 20.0})


def lag_of(seconds):
    return (f"rig.force_sensor.time_constant={seconds}",)


STATED = {
    "as told": (lag_of(0.0), {}, "identified"),
    "a lag that is told": (lag_of(0.003), {"identification_delay": 0.011, "sensor_lag": 0.003}, "identified"),
    "a lag longer than any": (lag_of(0.006), {}, "unexplained"),
    "1 ms newer": (("rig.force_sensor.delay=0.007", "contact.damping=[0.0]"), {}, "unexplained"),
    "delay open": ((), {"delay_spread": 0.004}, "unexplained"),
}


def test_what_the_bank_says_in_both_languages():
    """Contacts that are as told, behind a lag that is told or not, of a force newer than told and of a delay
    left open, each twice; in C to the bit."""
    if c99_cases.COMPILER is None:
        pytest.skip("no C compiler (cc) on this machine")
    in_c, said = c99_cases.loaded(LAW), set()
    for changes, gains, wanted in STATED.values():
        mechanism, made = bank(["contact.damping=[900.0]"], changes, **gains)
        one = controller(mechanism, LAW, made.gains, settling=0.02, free_force=20.0)
        first = run(mechanism, one, 0).rows
        one.next_contact()
        rows = np.concatenate([first, run(mechanism, one, 1).rows])
        assert one.last_contact.status == wanted
        rows[:, ROW.index("timed")] = 0.0
        rows[0, 0], rows[len(first), 0] = c99_cases.RESET, c99_cases.NEXT_CONTACT
        expected = controller_in_python(made, rows)
        assert in_c.begin(packed(LAW, made))
        assert_same(in_c.run(rows, True), expected, rows)
        said |= set(expected[:, RESULT.index("law_status")])
    assert {IDENTIFIED, UNEXPLAINED} <= said


@pytest.mark.parametrize("damping", [0.0, 900.0])
def test_a_lag_that_is_not_told_is_found(damping):
    """It counts as a delay; the contact is that in space."""
    mechanism, made = bank([f"contact.damping=[{damping}]"], lag_of(0.003))
    one = controller(mechanism, LAW, made.gains)
    for contact in range(3):
        velocity = run(mechanism, one, contact).rows[:, ROW.index("velocity")]
        one.next_contact()
    told = mechanism.rig.force_sensor.delay
    assert one.force_delay == pytest.approx(told + 0.003, abs=3 * LAG_STEP)
    assert abs(velocity[-1]) / velocity[0] == pytest.approx(restitution(mechanism), abs=0.015)


@pytest.mark.parametrize("lag", [0.0004, 0.001, 0.003])
@pytest.mark.parametrize("damping", [0.0, 900.0])
def test_a_lag_that_is_told_leaves_little(lag, damping):
    """Whether it is not half a millisecond longer, some contacts leave open."""
    mechanism, made = bank([f"contact.damping=[{damping}]", *lag_of(lag)])
    one = controller(mechanism, LAW, made.gains, settling=0.02, free_force=20.0)
    for contact in range(2):
        velocity = run(mechanism, one, contact).rows[:, ROW.index("velocity")]
        one.next_contact()
    told = mechanism.rig.force_sensor.delay
    assert one.force_delay == pytest.approx(told + lag, abs=2 * LAG_STEP)
    assert abs(velocity[-1]) / velocity[0] == pytest.approx(restitution(mechanism), abs=0.007)
    assert one.last_contact.status == "identified" or lag != 0.003
