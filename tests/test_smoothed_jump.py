"""What the readings at the onset tell of a sensor's lag: against exact densities, what is seen and what
cannot be, and what the bank of delays says of it, in Python and in C bit for bit."""

import math

import c99_cases
import numpy as np
import pytest
from c99_cases import RESULT, ROW, assert_same, controller_in_python, packed
from rig_lock_step import controller
from test_law_status import run

from jaxhil.compensators import literature_gains
from jaxhil.mechanism.file import load
from jaxhil.runtime.gain_file import GainFile
from jaxhil.runtime.law_status import IDENTIFIED, UNEXPLAINED
from jaxhil.runtime.laws.onset import STIFFNESS, STIFFNESS_VARIANCE
from jaxhil.runtime.laws.smoothed_jump import LAGS, PLACES, VARIANCE, SmoothedJump
from jaxhil.runtime.limits import NO_LIMITS

LAW, PERIOD, NOISE = "retrospective_delay_bank", 1e-3, 0.08
LAG = "rig.force_sensor.time_constant=0.003"


def readings(stiffness, damping, lag, first=0.0, exponent=1.0):
    """Depths [s] and forces [1/s] without noise, from a tick 8 ms before the surface on."""
    time = first - 0.008 + PERIOD * np.arange(22)
    s = np.maximum(time, 0)
    smooth = np.exp(-s / lag) if lag > 0 else (s <= 0).astype(float)
    if exponent > 1:
        return time, stiffness * 0.02 ** (1 - exponent) * s**exponent
    return time, (damping - stiffness * lag) * (1 - smooth) + stiffness * s


def taught(jump, depths, forces):
    jump.begin(PERIOD, 1.0)
    for depth, force in zip(depths.tolist(), forces.tolist(), strict=True):
        jump.take(depth, 1.0, force, NOISE**2)
    return jump


def test_odds_are_those_of_normal_densities():
    """The sum over the places, of those where the jump has the right sign, of one density of all readings."""
    rng = np.random.default_rng(0)
    for lag in LAGS:
        depths, forces = readings(300.0, 2.0, lag, 0.0003)
        forces = forces + NOISE * rng.standard_normal(len(forces))
        jump = taught(SmoothedJump(), depths, forces)
        inside = depths <= 0.012
        y, exact = forces[inside], np.zeros(len(LAGS))
        for place, each in enumerate(LAGS):
            for step in range(PLACES):
                s = np.maximum(depths[inside] - (step - 6) * PERIOD, 0)
                phi = np.column_stack([1 - np.exp(-s / each) if each else s > 0, s])
                covariance = np.diag([VARIANCE, STIFFNESS_VARIANCE])
                spread = phi @ covariance @ phi.T + NOISE**2 * np.eye(len(y))
                mean = phi @ [0, STIFFNESS]
                found = covariance @ phi.T @ np.linalg.solve(spread, y - mean)
                if each == 0 or found[0] > 0:
                    away = (y - mean) @ np.linalg.solve(spread, y - mean)
                    exact[place] += math.exp(-0.5 * (away + np.linalg.slogdet(2 * math.pi * spread)[1]))
        np.testing.assert_allclose(np.log(jump.odds), np.log(np.mean(exact[1:]) / exact[0]), atol=0.5)


@pytest.mark.parametrize("first", [0.0001, 0.0005, 0.0009])
@pytest.mark.parametrize(
    ("contact", "smoothed"),
    [
        ((300.0, 2.5, 0.003, 1.0), True),  # a damper, the sensor lags
        ((300.0, 1.5, 0.001, 1.0), True),
        ((300.0, 2.5, 0.0, 1.0), False),  # it does not
        ((300.0, 0.0, 0.0, 1.0), False),
        ((300.0, 0.0, 0.003, 1.0), False),  # no damper: the lag is a delay
        ((300.0, 0.9, 0.003, 1.0), False),  # B = K l
        ((300.0, 0.0, 0.0, 1.5), False),  # Hertz
    ],
)
def test_a_damper_behind_a_lag_is_seen(contact, smoothed, first):
    rng, jump, (stiffness, damping, lag, exponent) = np.random.default_rng(1), SmoothedJump(), contact
    depths, forces = readings(stiffness, damping, lag, first, exponent)
    for _ in range(4):
        taught(jump, depths, forces + NOISE * rng.standard_normal(len(forces)))
    assert jump.smoothed == smoothed
    jump.reset()
    assert not jump.smoothed


def test_a_damper_may_be_hidden_by_a_lag():
    """B = K l: what is read is what contact without any damping gives, to the last digit."""
    depths, hidden = readings(300.0, 0.9, 0.003)
    np.testing.assert_allclose(hidden, readings(300.0, 0.0, 0.0)[1], atol=1e-15)
    assert depths[-1] > 0.012


def bank(told, changes=(), **gains):
    """The law's gain file by what it is told of the damped suite, and contacts of the mechanism as it is."""
    mechanism = load("suite-damped", [*told, *changes]).mechanism
    known = load("suite-damped", list(told)).mechanism
    made = GainFile(
        LAW, literature_gains(known, LAW) | gains, known.rig.control_period, known.contact.clearance
    )
    return mechanism, made._replace(limits={**NO_LIMITS, "settling": 0.02, "free_force": 20.0})


STATED = {
    "as told": ((), {}, "identified"),
    "lag": ((LAG,), {}, "unexplained"),
    "1 ms older": (("rig.force_sensor.delay=0.009", "contact.damping=[0.0]"), {}, "unexplained"),
    "delay open": ((), {"delay_spread": 0.004}, "unexplained"),
}


def test_what_the_bank_says_in_both_languages():
    """Contacts that are as told, behind a lag, of a force older than told and of a delay left open, each
    twice; in C to the bit."""
    if c99_cases.COMPILER is None:
        pytest.skip("no C compiler (cc) on this machine")
    in_c, said = c99_cases.loaded(LAW), set()
    for changes, gains, wanted in STATED.values():
        mechanism, made = bank(["contact.damping=[900.0]"], changes, **gains)
        one = controller(mechanism, LAW, made.gains, settling=0.02, free_force=20.0)
        first = run(mechanism, one, 0).rows
        assert one.last_contact.status == wanted
        one.next_contact()
        rows = np.concatenate([first, run(mechanism, one, 1).rows])
        rows[:, ROW.index("timed")] = 0.0
        rows[0, 0], rows[len(first), 0] = c99_cases.RESET, c99_cases.NEXT_CONTACT
        expected = controller_in_python(made, rows)
        assert in_c.begin(packed(LAW, made))
        assert_same(in_c.run(rows, True), expected, rows)
        said |= set(expected[:, RESULT.index("law_status")])
    assert {IDENTIFIED, UNEXPLAINED} <= said
