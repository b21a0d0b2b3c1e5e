"""Bounds of gains in the code: they admit gains from tuning, literature and settings for realistic rigs."""

import math

import pytest
from family import family
from hypothesis import given
from hypothesis import strategies as st
from mechanism_table import changed

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import builtin_names, from_plain_data, load, suite_names
from jaxhil.mechanism.structs import Mechanism
from jaxhil.rig import COMPENSATORS as ON_THE_RIG
from jaxhil.rig.bounds import CONTROL_PERIODS, FORCES
from jaxhil.rig.limits import LIMITS


def rejected(mechanism: Mechanism) -> list[tuple]:
    """Return the bounds and nominal values of gains that are not accepted."""
    result = []
    for name, law in COMPENSATORS.items():
        for gain in law.gains:
            admits = ON_THE_RIG[name].gains[gain.name].admits
            values = [bound(mechanism) for bound in (gain.lower, gain.nominal, gain.upper)]
            result += [(name, gain.name, value) for value in values if not admits(value)]
    return result


@pytest.mark.parametrize("mechanism", [*builtin_names(), *suite_names()])
def test_runtime_bounds_accept_nominal_gains_of_every_builtin_mechanism(mechanism):
    assert rejected(load(mechanism).mechanism) == []


def test_runtime_bounds_accept_nominal_gains_of_generated_mechanisms():
    assert [rejected(mechanism) for mechanism in family()] == [[]] * len(family())


def test_runtime_bounds_accept_gains_of_every_compensator_setting():
    for name, law in COMPENSATORS.items():
        for values in law.settings.values():
            assert all(ON_THE_RIG[name].gains[gain].admits(value) for gain, value in values.items())


def log(low: float, high: float) -> st.SearchStrategy[float]:
    """Return numbers of every order of magnitude from `low` to `high`."""
    return st.floats(math.log(low), math.log(high)).map(lambda value: min(max(math.exp(value), low), high))


@given(
    log(*CONTROL_PERIODS),
    log(1e-2, 1e6),
    log(0.05, 50.0),
    log(1e-5, 10.0),
    st.just(0.0) | log(1e-6, 1.0),
    log(1e-4, 1.0),
    log(1e-3, 1.0),
    st.sampled_from(["linear", "zoh"]),
)
def test_runtime_bounds_accept_nominal_gains_of_any_realistic_rig(
    period, mass, frequency, speed, delay, lag, share, hold
):
    omega = 2.0 * math.pi * frequency
    left = 0.99 * FORCES[1] - mass * omega * speed
    if left < 0.0:
        speed, left = 0.99 * FORCES[1] / (mass * omega), 0.0
    raw = changed(
        {
            "bodies": {"equivalent_mass": mass},
            "approach": {"velocity": speed},
            "contact": {"law": "kelvin_voigt", "stiffness": [mass * omega**2], "damping": [mass * omega]},
            "rig.control_period": period,
            "rig.command_latency": 0,
            "rig.command_hold": hold,
            "rig.simulator": {
                "model": "second_order",
                "natural_frequency": 0.8 / (math.pi * share * lag),
                "damping_ratio": 0.8,
                "delay": lag - share * lag,
            },
            "rig.force_sensor": {
                "delay": delay - share * delay,
                "time_constant": share * delay,
                "dead_zone": 0.4 * share * left,
                "noise_std": 0.04 * left,
            },
            "uncertainty": {},
        }
    )
    assert rejected(from_plain_data(raw, "rig")) == []


def test_runtime_bounds_are_finite_and_every_limit_has_a_default():
    for law in ON_THE_RIG.values():
        for gain in law.gains.values():
            assert math.isfinite(gain.lowest) and math.isfinite(gain.highest) and gain.lowest < gain.highest
    for limit in LIMITS.values():
        assert math.isfinite(limit.lowest) and math.isfinite(limit.highest) and limit.admits(limit.default)
