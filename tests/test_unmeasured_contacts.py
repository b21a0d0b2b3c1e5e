"""Contacts without a measured force have status not_reached, for any cause of the model's reversal.

A virtual spring on the numerical model's own motion represents a compensator that acts without hardware
contact.
"""

import math

import numpy as np
import pytest
from lanes import STIFFNESS, mechanism, validated
from rig_lock_step import closed_loop

import jaxhil
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.gain_choice import choose_gains

MASS, SPEED, VIRTUAL = 350.0, 5e-3, 1.2e5  # m/s, N/m [kg]
DEEPEST = SPEED * math.sqrt(MASS / VIRTUAL)  # depth at which the virtual spring alone reverses the model [m]


def rig(plane: float = 0.0, simulator: dict | None = None, **sensor: float) -> Mechanism:
    """Return a contact whose surface lies deeper by `plane` [m]."""
    made = mechanism(
        {}, simulator or {"model": "ideal"}, 0.004, 2, force_sensor=sensor, period=1e-3, contact_plane=plane
    )
    return validated(made)


def run(made: Mechanism, seed: int = 0):
    """Return statuses and peak forces of the contacts, from the simulation and from the rig's watchdog."""
    _, gains = choose_gains(made, "virtual_contact", {"virtual_stiffness": VIRTUAL, "virtual_damping": 0.0})
    simulated = jaxhil.simulate(made, "virtual_contact", gains, seed=seed)
    watched, _ = closed_loop(made, "virtual_contact", gains)
    assert watched[0].status == simulated.contacts[0].status
    return simulated


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_contact_that_hardware_never_touches_ends_as_not_reached(noise):
    result = run(rig(1.2 * DEEPEST, noise_std=noise))
    assert result.status == "not reached"
    for contact in result.contacts:
        assert contact.status == "not reached"
        assert all(math.isnan(number) for number in contact[:9])


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_contact_ends_as_not_reached_if_only_sensor_bias_reverses_model(noise):
    """Use a bias of 70 N or 40 N.

    The first reverses the model 0.09 mm before it reaches the surface, the second 0.2 mm beyond the surface.
    """
    for bias in (70.0, 40.0):
        result = run(rig(1.2 * DEEPEST, bias=bias, noise_std=noise))
        assert result.status == "not reached" and math.isnan(result.contacts[0].restitution)


def test_contact_hidden_by_dead_zone_ends_as_not_reached():
    largest = STIFFNESS * 0.5 * DEEPEST
    hidden = run(rig(0.5 * DEEPEST, dead_zone=1.01 * largest))
    assert hidden.contacts[0].status == "not reached"
    almost = run(rig(0.5 * DEEPEST, dead_zone=0.99 * largest))
    assert almost.contacts[0].status == "ok"


def test_single_force_reading_counts_as_contact():
    result = run(rig(0.99996 * DEEPEST))
    assert result.contacts[0].status == "ok" and 0 < result.contacts[0].duration < 2e-3
    assert np.count_nonzero(result.force_measured[result.contact == 0]) == 1


def test_run_waits_for_delayed_contact_of_hardware():
    """The virtual spring reverses the model at 85 ms; the hardware touches at 91 ms."""
    result = run(rig(0.3 * DEEPEST, {"model": "ideal", "delay": 0.075}))
    assert result.contacts[0].status == "ok" and result.contacts[0].peak_force > 0


@pytest.mark.slow
def test_impulse_ledger_does_not_act_without_hardware_contact():
    made = jaxhil.load("suite-noisy", {"rig.contact_plane": 0.1})
    result = jaxhil.simulate(made, "impulse_ledger")
    assert result.status in ("not reached", "timeout") and math.isnan(result.contacts[0].restitution)
