"""Effect of a dead zone on a contact in closed form, and its removal by the observer."""

import math

import numpy as np
import pytest
from lanes import IDEAL, STIFFNESS, first_contact, mechanism, nominal_gains, spread, validated

from jaxhil.mechanism.file import load
from jaxhil.rig import COMPENSATORS

DEAD_ZONE, DELAY, PERIOD = 12.0, 0.008, 1e-3
MECHANISM = validated(mechanism({}, IDEAL, DELAY, period=PERIOD, force_sensor={"dead_zone": DEAD_ZONE}))
GAINS = nominal_gains(MECHANISM, "dead_zone_observer")


@pytest.fixture(scope="module")
def lead_metrics():
    """Return the metrics of phase lead without an observer, for a negligible and the nominal dead zone."""
    scenario = spread(MECHANISM, 2, force_sensor__dead_zone=np.array([1e-9, DEAD_ZONE]))
    return first_contact(MECHANISM, scenario, "phase_lead", nominal_gains(MECHANISM, "phase_lead"))


def test_force_sensor_dead_zone_shifts_the_apparent_surface(lead_metrics):
    """A dead zone of dz newtons shifts the surface by dz/k; the rebound speed is the same."""
    assert lead_metrics["restitution"][1] == pytest.approx(lead_metrics["restitution"][0], abs=1e-4)
    assert lead_metrics["peak_force"][1] - lead_metrics["peak_force"][0] == pytest.approx(DEAD_ZONE, rel=1e-3)


def test_dead_zone_observer_removes_dead_zone_error(lead_metrics):
    """The error falls to 1 % with the right stiffness, to 10 % with 30 % stiffness error."""
    lag = 1 / (2 * math.pi * GAINS["observer_bandwidth"])
    assert GAINS["identification_delay"] == pytest.approx(DELAY - lag, rel=1e-12)
    stiffness = STIFFNESS * np.array([1.0, 0.7, 1.3, 0.0, 1.0])
    alignment = np.array([*[GAINS["identification_delay"]] * 4, DELAY])
    changed = {"observer_stiffness": stiffness, "identification_delay": alignment}
    result = first_contact(MECHANISM, spread(MECHANISM, 5), "dead_zone_observer", GAINS | changed)
    remaining_error = (result["peak_force"] - lead_metrics["peak_force"][0]) / DEAD_ZONE
    moved = result["restitution"] - lead_metrics["restitution"][0]
    print(remaining_error, moved)
    assert (
        abs(remaining_error[0]) < 0.01
        and np.all(np.abs(remaining_error[1:3]) < 0.1)
        and remaining_error[3] == pytest.approx(1, rel=1e-3)
    )
    assert np.all(np.abs(moved[:4]) < 1e-3) and moved[4] > 0.05


def test_dead_zone_observer_equals_phase_lead_without_dead_zone():
    rng = np.random.default_rng(0)
    without = nominal_gains(load("rig-300kg").mechanism, "dead_zone_observer")
    gains = GAINS | {"observer_limit": without["observer_limit"]}
    assert gains["observer_limit"] == 0.0
    ours = COMPENSATORS["dead_zone_observer"](gains, PERIOD, 0.002)
    other = COMPENSATORS["phase_lead"](gains, PERIOD, 0.002)
    for row in (rng.standard_normal((2000, 4)) * [100, 1e-3, 1e-2, 1e-3]).tolist():
        assert ours.step(*row) == other.step(*row)


@pytest.mark.parametrize("overrides", [[], ["rig.force_sensor.delay=0.002"], ["rig.control_period=0.004"]])
def test_dead_zone_observer_filter_has_gain_near_1_below_15_hz(overrides):
    """|Q| >= 0.9, and the filter's lag does not exceed the force delay."""
    parsed = load("rig-300kg", [*overrides, "rig.force_sensor.dead_zone=12"]).mechanism
    gains, period = nominal_gains(parsed, "dead_zone_observer"), parsed.rig.control_period
    still = gains | {"phase_lead": 0.0, "identification_delay": 0.0, "observer_stiffness": 1.0}
    for frequency in (1.0, 5.0, 15.0):
        law = COMPENSATORS["dead_zone_observer"](still | {"observer_limit": 10.0}, period, math.inf)
        turn = 2 * math.pi * frequency * period
        positions = [2 + math.cos(turn * tick) for tick in range(3000)]
        output = np.array([law.step(0.0, 0.0, 0.0, position) for position in positions])[1000:]
        waves = np.exp(-1j * turn * np.arange(1000, 3000))
        basis = np.stack([waves.real, waves.imag, np.ones(2000)], axis=1)
        cosine, sine, mean = np.linalg.lstsq(basis, output, rcond=None)[0]
        corner = math.pi * gains["observer_bandwidth"] * period
        tangent = 1j * math.tan(turn / 2)
        assert abs(cosine + 1j * sine) == pytest.approx(abs(corner / (corner + tangent)), rel=1e-6)
        assert abs(cosine + 1j * sine) >= 0.9 and mean == pytest.approx(2.0, rel=1e-6)
    lag = 1 / (2 * math.pi * gains["observer_bandwidth"])
    assert lag <= max(parsed.rig.force_sensor.delay, period / 2) * (1 + 1e-12)


@pytest.mark.slow
def test_observer_of_cut_dead_zone_restores_restitution():
    """A cut dead zone changes the restitution itself; an observer of the other kind does not restore it."""
    sensor = {"dead_zone": DEAD_ZONE, "dead_zone_kind": "cut"}
    cut = validated(mechanism({}, IDEAL, DELAY, period=PERIOD, force_sensor=sensor))
    gains = nominal_gains(cut, "dead_zone_observer")
    assert gains["observer_saturation"] == 0.0 and GAINS["observer_saturation"] == 1.0
    # For eight phases: no dead zone, the observer, no observer, and the observer of a continuous dead zone.
    zone, limit = np.repeat(
        [[1e-9, DEAD_ZONE, DEAD_ZONE, DEAD_ZONE], [0.0, DEAD_ZONE, 0.0, DEAD_ZONE]], 8, axis=1
    )
    gains |= {"observer_limit": limit, "observer_saturation": np.repeat([0.0, 0.0, 0.0, 1.0], 8)}
    scenario = spread(cut, 32, phase=np.tile(np.arange(8) / 8, 4), force_sensor__dead_zone=zone)
    result = first_contact(cut, scenario, "dead_zone_observer", gains)
    without, *others = result["restitution"].reshape(4, 8).mean(axis=1)
    observed, alone, other = np.abs(np.array(others) - without)
    print(without, others)
    assert observed < 0.2 * alone and alone < other
