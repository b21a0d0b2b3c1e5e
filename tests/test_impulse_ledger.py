"""Impulse ledger with unknown force delay: estimates, errors and status.

`pytest -m slow -s tests/test_impulse_ledger.py` prints the remaining errors.
"""

import numpy as np
import pytest
from c99_cases import ROW
from law_contacts import run
from rig_lock_step import controller

from jaxhil.laws.compensators import literature_gains
from jaxhil.laws.impulse_ledger.contact_model.rig import (
    DAMPING,
    DELAY,
    DEPTH_DAMPING,
    PARAMETERS,
    ContactModel,
    features,
    slope,
)
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import build_scenarios

LAW = "impulse_ledger"
UNCERTAIN = 'uncertainty."rig.force_sensor.delay"={distribution="normal",std=0.001}'
SPREADS = (80.0, 120.0, 1.0, 0.12, 0.5, 0.0, 1.0)


def fitted(delay: float, damping: float, delay_spread: float) -> ContactModel:
    """Return the model of a contact of 3 Hz whose force delay exceeds the specified value by `delay` [s]."""
    model = ContactModel()
    model.restart(10.0, SPREADS, delay_spread**2)
    omega, deepest = 2 * np.pi * 3, 0.0
    for tick in range(2, 165):
        time = 1e-3 * tick
        depth, speed = np.sin(omega * time) / omega, np.cos(omega * time)
        deepest = max(deepest, depth)
        then = time - delay
        force = omega**2 * np.sin(omega * then) / omega + omega**2 * delay + damping * np.cos(omega * then)
        phi = features(depth, speed, deepest, slope(model.mean, depth) * (1 - speed))
        model.learn(phi, force, 0.02**2)
    return model


@pytest.mark.parametrize("delay", [-1e-3, -2e-4, 5e-4, 1e-3])
def test_impulse_ledger_estimates_delay_from_elastic_contact(delay):
    mean, variance = fitted(delay, 0.0, 1e-3).estimate_delay(0.0, 0.1)
    assert mean == pytest.approx(delay, abs=1e-4)
    assert 0 < variance < (3e-4) ** 2


def test_impulse_ledger_does_not_mistake_damper_for_delay():
    mean, variance = fitted(0.0, 3.0, 1e-3).estimate_delay(0.0, 0.1)
    assert abs(mean) < 5e-4 < 2 * np.sqrt(variance)


def test_impulse_ledger_does_not_change_delay_if_delay_spread_is_zero():
    model = fitted(1e-3, 0.0, 0.0)
    assert model.estimate_delay(0.0, 0.1) == (0.0, 0.0)
    model.conclude(0.0)
    assert model.mean[DELAY] == model.theta[DELAY] == 0.0
    assert all(model.covariance[DELAY][j] == 0.0 for j in range(PARAMETERS))


def test_impulse_ledger_corrects_damping_if_depth_damping_is_zero():
    """With depth damping 0, the damping is the mean of the normal distribution under this condition."""
    model, correlation = ContactModel(), -0.95
    model.restart(10.0, SPREADS, 0.0)
    model.mean[DAMPING], model.mean[DEPTH_DAMPING] = 0.4, -0.2
    for row, column, share in (
        (DAMPING, DAMPING, 1.0),
        (DEPTH_DAMPING, DEPTH_DAMPING, 1.0),
        (DAMPING, DEPTH_DAMPING, correlation),
        (DEPTH_DAMPING, DAMPING, correlation),
    ):
        model.covariance[row][column] = share * 0.1**2
    model.conclude(0.0)
    assert model.theta[DEPTH_DAMPING] < 1e-3
    assert model.theta[DAMPING] == pytest.approx(0.4 + correlation * 0.2, rel=0.03)


def restitution(mechanism, law, contact: int = 0) -> float:
    velocity = run(mechanism, law, contact).rows[:, ROW.index("velocity")]
    return abs(velocity[-1]) / velocity[0]


def test_impulse_ledger_uses_estimated_delay_in_second_contact():
    changes = ["rig.force_sensor.noise_std=0.0"]
    mechanism = load("suite-noisy", changes).mechanism
    late = load("suite-noisy", [*changes, "rig.force_sensor.delay=0.009"]).mechanism
    gains = literature_gains(mechanism, LAW)
    assert restitution(late, controller(mechanism, LAW, gains | {"delay_spread": 0.0})) > 1.02
    law = controller(mechanism, LAW, gains | {"delay_spread": 1e-3})
    assert restitution(late, law) == pytest.approx(1, abs=8e-3)
    law.next_contact()
    assert law.force_delay == pytest.approx(0.009, abs=1e-4)
    assert restitution(late, law, 1) == pytest.approx(1, abs=2e-3)


@pytest.mark.parametrize("plane", [0.0, 2e-3])
def test_impulse_ledger_counts_force_below_noise_in_soft_damped_contact(plane):
    """The specified noise is 10 % of the peak force, so that the contact is detected late."""
    mass, stiffness, ratio = 350.0, 1000.0, 0.05
    damping = 2 * ratio * np.sqrt(stiffness * mass)
    changes = [f"contact.stiffness=[{stiffness}]", f"contact.damping=[{damping}]"]
    mechanism = load("suite-long", [*changes, f"rig.contact_plane={plane}"]).mechanism
    peak = mechanism.approach.velocity * np.sqrt(stiffness * mass)
    gains = literature_gains(mechanism, LAW) | {"force_noise": 0.1 * float(peak)}
    # Closed form of a contact without tension, which ends where the force returns to zero.
    ideal = np.exp(-ratio * (np.pi - 2 * np.arcsin(ratio)) / np.sqrt(1 - ratio**2))
    assert restitution(mechanism, controller(mechanism, LAW, gains)) == pytest.approx(ideal, abs=0.002)


def test_impulse_ledger_status_is_unexplained_for_damped_contact_with_delay():
    mechanism = load("suite-damped", ["contact.damping=[600.0]", UNCERTAIN]).mechanism
    gains = literature_gains(mechanism, LAW)
    assert gains["delay_spread"] == 1e-3
    for spread, status in ((1e-3, "unexplained"), (0.0, "identified")):
        law = controller(mechanism, LAW, gains | {"delay_spread": spread})
        run(mechanism, law)
        law.next_contact()
        assert law.last_contact.status == status


@pytest.mark.slow
@pytest.mark.parametrize(
    ("suite", "first", "eighth"),
    [("noisy", 0.8, 0.3), ("hertz", 1.5, 0.3), ("hardening", 2.0, 0.5), ("damped", 1.65, 1.8)],
)
def test_impulse_ledger_error_due_to_unknown_delay_decreases_with_each_contact(suite, first, eighth, capsys):
    mechanism = load(f"suite-{suite}", ["approach.contacts=8", UNCERTAIN]).mechanism
    scenarios = build_scenarios(mechanism, draw(mechanism, 200, 77), 77)
    outcome = evaluate(build_loop(mechanism, LAW, scenarios), literature_gains(mechanism, LAW), scenarios)
    rms = 100 * np.sqrt(np.mean(np.asarray(outcome.error)[:8] ** 2, axis=1))
    with capsys.disabled():
        print(f"\n{suite:10s} delay +-1 ms: rms [%], contacts 1, 2, 4, 8:", *np.round(rms[[0, 1, 3, 7]], 2))
    assert rms[0] <= first and rms[7] <= eighth
