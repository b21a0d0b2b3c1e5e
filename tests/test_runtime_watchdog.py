"""Watchdog of the runtime: audit of each contact before the next one, causes of trips, and energies."""

import itertools
import math

import pytest
from gain_documents import gain_document, sign

from jaxhil.rig import Controller
from jaxhil.rig.faults import CONTACT_TOO_LONG, ENERGY_BALANCE, RESTITUTION
from jaxhil.rig.limits import LIMITS
from jaxhil.rig.watchdog import Expectation

PERIOD, MASS, STIFFNESS, SPEED = 1e-3, 300.0, 1e5, 5e-3
WATCHED = {
    "settling": 0.005,
    "free_force": 0.0,
    "equivalent_mass": MASS,
    "longest_contact": 1.0,
    "energy_balance": 1e-9,
    "restitution_margin": 0.02,
    "reference_stiffness": STIFFNESS,
    "reference_velocity": SPEED,
}


def watched(clearance: float | None = None, **limits: float) -> Controller:
    document = gain_document("none")
    if clearance is not None:
        document["mechanism"]["contact"]["clearance"] = clearance
    document["limits"] = {
        name: {"value": value, "unit": LIMITS[name].unit} for name, value in {**WATCHED, **limits}.items()
    }
    return Controller.from_dict(sign(document))


def bounce(
    controller: Controller, *, late: int = 0, damping: float = 0.0, clearance: float = math.inf, ticks=3000
) -> tuple[int, list[float], list[float]]:
    """Simulate an ideal rig with compensator `none` and a force delay of `late` ticks.

    Return the tick of the trip, positions and velocities.
    """
    position, velocity = -1e-4, SPEED
    forces = [0.0] * (late + 1)
    positions, velocities = [], []
    for n in range(ticks):
        positions.append(position)
        velocities.append(velocity)
        depth = position if position > 0 else min(position + clearance, 0.0)
        forces.append(STIFFNESS * depth + (damping * velocity if depth else 0.0))
        force = controller.step(forces[-1 - late], position, velocity, position, n * PERIOD)
        if controller.tripped:
            return n, positions, velocities
        velocity -= PERIOD * force / MASS
        position += PERIOD * velocity
        controller.position_command(position, velocity, -force / MASS)
    return ticks, positions, velocities


def restitution_of(late: int) -> float:
    """Return the restitution of one contact without a watchdog."""
    controller = Controller.from_dict(gain_document("none"))
    _, positions, velocities = bounce(controller, late=late, ticks=400)
    assert positions[-1] < 0
    return abs(velocities[-1]) / SPEED


def test_watchdog_does_not_trip_on_good_contacts():
    controller = watched()
    n, positions, _ = bounce(controller)
    assert n == 3000 and positions[-1] < 0 and controller.seen == 0
    watchdog = controller._watchdog
    assert (watchdog.contacts, watchdog.expected) == (1, 1.0)
    assert watchdog.restitution == pytest.approx(1.0, abs=2e-3)
    # M v' = -F_c holds to rounding.
    assert abs(watchdog.balance) < 1e-13 * MASS * SPEED**2


def test_watchdog_stops_divergence_once_the_contact_has_ended():
    divergence = restitution_of(3)
    assert divergence > 1.08
    controller = watched()
    n, positions, velocities = bounce(controller, late=3)
    assert controller.cause == RESTITUTION
    assert f"contact 1: restitution {divergence:.4g}, expected 1" in controller.status
    assert velocities[-1] == pytest.approx(-divergence * SPEED, rel=1e-12)
    # Out of contact for 5 ms; the force is 3 ticks late.
    release = next(n for n in range(len(positions)) if velocities[n] < 0 and positions[n] < 0)
    assert n - release in (4, 5, 6)


def test_watchdog_trips_only_if_error_exceeds_margin():
    for late in (1, 2, 3):
        error = restitution_of(late) - 1.0
        assert error > 0.01
        for margin, caught in ((0.9 * error, True), (1.1 * error, False)):
            controller = watched(restitution_margin=margin)
            bounce(controller, late=late, ticks=500)
            assert (controller.cause == RESTITUTION) is caught


def test_watchdog_audits_every_contact_between_two_surfaces():
    controller = watched(2e-3, restitution_margin=0.5)
    _, _, velocities = bounce(controller, clearance=2e-3, late=1, ticks=6000)
    turns = sum(a * b < 0 for a, b in itertools.pairwise(velocities))
    assert turns > 5 and controller._watchdog.contacts in (turns - 1, turns)
    # Each contact is 3 % faster than the last; the first is stopped before the far surface.
    controller = watched(2e-3)
    _, positions, _ = bounce(controller, clearance=2e-3, late=1)
    assert controller.cause == RESTITUTION and controller._watchdog.contacts == 1
    assert min(positions) > -2e-3


def test_watchdog_audits_unfinished_contact_when_next_contact_is_announced():
    controller = watched(settling=5.0)
    bounce(controller, late=3, ticks=300)
    assert not controller.tripped
    controller.next_contact()
    assert controller.cause == RESTITUTION
    assert controller.step(0.0, -0.1, SPEED, -0.1) == 0.0 and controller.tripped
    controller = watched(settling=5.0)
    bounce(controller, ticks=300)
    controller.next_contact()
    assert not controller.tripped and controller._watchdog.contacts == 1


def test_watchdog_detects_numerical_model_that_does_not_follow_force_command():
    controller = watched(restitution_margin=1.0)
    position, velocity = -1e-4, SPEED
    for n in range(500):
        force = controller.step(STIFFNESS * max(position, 0.0), position, velocity, position, n * PERIOD)
        velocity -= PERIOD * force / (1.02 * MASS)  # a mass that differs from the watchdog's
        position += PERIOD * velocity
    assert controller.cause == ENERGY_BALANCE


def test_watchdog_trips_on_contact_that_exceeds_maximum_duration():
    controller = watched(longest_contact=0.05)
    n, positions, _ = bounce(controller)
    assert controller.cause == CONTACT_TOO_LONG
    first = next(n for n in range(len(positions)) if positions[n] > 0)
    assert n - first == 50


def test_expected_restitution_depends_on_identified_stiffness():
    # e* = 1 - 0.1 (sqrt(k0/k) - 1): a contact of another stiffness has another expected restitution.
    controller = watched(
        reference_stiffness=4 * STIFFNESS,
        expected_1=0.95,
        expected_p=-0.1,
        softness_lowest=-0.9,
        softness_highest=2.0,
        restitution_margin=1.0,
    )
    bounce(controller, ticks=500)
    assert controller._watchdog.expected == pytest.approx(0.95 - 0.1 * (2 - 1), abs=2e-3)


def test_expected_restitution_is_polynomial_with_inputs_limited_to_stated_ranges():
    terms = ("1", "p", "pp", "ppp", "w", "ww", "pw", "z", "zz", "pz", "wz")
    limits = {f"expected_{term}": 0.01 * (n + 1) for n, term in enumerate(terms)}
    limits |= {"reference_stiffness": 9e4, "reference_velocity": 4e-3}
    for feature in ("softness", "speed", "loss"):
        limits |= {f"{feature}_lowest": -0.5, f"{feature}_highest": 0.75}
    result = Expectation(limits).restitution(1e5, 400.0, 5e-3, 300.0)
    p, w = math.sqrt(9e4 / 1e5) - 1, 5e-3 / 4e-3 - 1
    z = 400.0 / (2 * math.sqrt(1e5 * 300.0))
    values = [1, p, p**2, p**3, w, w**2, p * w, z, z**2, p * z, w * z]
    assert result == pytest.approx(sum(0.01 * (n + 1) * value for n, value in enumerate(values)), rel=1e-12)
    # Beyond the ranges, and for an impossible stiffness, the ends of the ranges are used.
    p, w, z = 0.75, 0.75, -0.5
    values = [1, p, p**2, p**3, w, w**2, p * w, z, z**2, p * z, w * z]
    end = sum(0.01 * (n + 1) * value for n, value in enumerate(values))
    for stiffness in (-1.0, 0.0, math.nan, 5e-324):
        assert Expectation(limits).restitution(stiffness, -1e9, 1.0, 300.0) == pytest.approx(end, rel=1e-12)


def test_watchdog_contact_does_not_end_while_bodies_touch():
    """Without settling time, a zero crossing of the force must not end the contact."""
    controller = watched(settling=0.0, energy_balance=1e9, restitution_margin=1e9)
    position, velocity, audited = -1e-4, SPEED, []
    for n in range(300):
        force = 0.0 if velocity < 0 else STIFFNESS * max(position, 0.0)
        force = controller.step(force, position, velocity, position, n * PERIOD)
        audited.append((controller._watchdog.contacts, position))
        velocity -= PERIOD * force / MASS
        velocity = -SPEED if velocity < 1e-4 else velocity
        position += PERIOD * velocity
    assert audited[-1][0] == 1 and all(position <= 0 for contacts, position in audited if contacts)
