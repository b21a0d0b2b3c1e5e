"""How the retrospective laws find the surface: the evidence against its definition, and what they find."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from lanes import nominal_gains

from jaxhil.compensators import onset as in_jax
from jaxhil.mechanism.file import load
from jaxhil.runtime.laws import onset as on_the_rig
from jaxhil.runtime.laws.contact_plane import DRIFT, ContactPlane, found_variance
from jaxhil.runtime.laws.onset import AGES, JUMP_VARIANCE, STIFFNESS, STIFFNESS_VARIANCE, Onset, logarithm
from jaxhil.runtime.laws.retrospective_reference import RetrospectiveReference

PERIOD = 1e-3


def density(readings, mean, covariance):
    """ln of a normal density."""
    away = readings - mean
    return -0.5 * (away @ np.linalg.solve(covariance, away) + np.linalg.slogdet(2 * np.pi * covariance)[1])


@pytest.mark.parametrize("age", AGES[:12])
@pytest.mark.parametrize("hidden", [False, True])
def test_evidence_is_the_ratio_of_the_two_densities(age, hidden):
    """y = b + B + K s since the middle of the tick, against y = b, of all readings at once."""
    rng = np.random.default_rng(age)
    number, noise, unknown, rare = 90, 0.09, 8.0, 321.0
    ages = np.arange(number)[::-1]
    since = PERIOD * (age - 0.5 - ages)
    met = since > 0
    readings = 0.3 * rng.standard_normal(number) + 2.0 + met * (1.0 + 350.0 * since)
    shown = rng.random(number) > 0.3 if hidden else np.ones(number, bool)
    onset = Onset(PERIOD)
    for reading, one in zip(readings.tolist(), shown.tolist(), strict=True):
        onset.take(reading, one)
    found = onset.suppose(age, noise, unknown, rare)
    silent = noise * np.eye(number) + unknown
    ramp = met * since
    contact = silent + JUMP_VARIANCE * np.outer(met, met) + STIFFNESS_VARIANCE * np.outer(ramp, ramp)
    seen = np.ix_(shown, shown)
    expected = density(readings[shown], STIFFNESS * ramp[shown], contact[seen])
    expected -= density(readings[shown], 0.0, silent[seen]) + math.log(rare)
    assert found.evidence == pytest.approx(expected, rel=2e-3, abs=2e-3)
    before = readings[shown & ~met]
    assert found.bias == pytest.approx(np.sum(before) / (len(before) + noise / unknown), rel=1e-12)


@pytest.mark.parametrize("age", [7, 13, 20, 47, 119, 200, 224])
def test_every_tick_is_told_apart(age):
    """Of a jump without noise to speak of, also between the ages that are tried first."""
    onset = Onset(PERIOD)
    for tick in range(300):
        onset.take(float(tick >= 300 - age), True)
    found = onset.find(1e-4, 8.0, lambda age: 321.0)
    assert found is not None and found.age == age


def test_logarithm_by_square_roots():
    for value in (1e-12, 0.3, 1.0, 7.0, 1e6, 1e20):
        assert logarithm(value) == pytest.approx(math.log(value), rel=2e-4, abs=1e-12)


def test_both_sides_look_for_the_same():
    names = ("STIFFNESS", "STIFFNESS_VARIANCE", "JUMP_VARIANCE", "CERTAIN", "WAIT", "LONGEST_FLIGHT")
    for name in names:
        assert getattr(in_jax, name) == getattr(on_the_rig, name)
    assert tuple(in_jax.AGES) == AGES
    assert tuple(in_jax.BOUNDS) == on_the_rig.BOUNDS
    assert in_jax.STEPS == on_the_rig.STEPS


class Flight(NamedTuple):
    """Hardware that flies into a surface at 5 mm/s; forces over mass and speed [1/s], slopes [1/s^2]."""

    plane: float = 0.0  # by how much it is deeper than told [m]
    slope: float = 300.0
    jump: float = 0.0
    order: float = 1.0  # of the force in the depth: slope is that of 10 ms
    bias: float = 0.0  # [N]
    noise: float = 0.15  # [N]
    period: float = PERIOD
    side: float = 1.0
    within: float = 3e-3  # of the surface's own time [s], which it is found


FLIGHTS = {
    "linear": Flight(),
    "soft": Flight(slope=60.0, within=7e-3),
    "stiff": Flight(slope=900.0, within=1e-3),
    "damped": Flight(jump=2.0, within=1e-3),
    "Hertz": Flight(order=1.5),
    "1 mm nearer": Flight(plane=-1e-3),
    "1 mm deeper": Flight(plane=1e-3),
    "4 mm deeper": Flight(plane=4e-3),
    "5 N of bias": Flight(bias=5.0),
    "-5 N of bias": Flight(bias=-5.0),
    "without noise": Flight(noise=0.0, within=1e-3),
    "0.25 ms": Flight(period=2.5e-4),
    "4 ms": Flight(period=4e-3, within=5e-3),
    "on the other side": Flight(side=-1.0, plane=3e-4),
}


def fly(law, flight, rng, delay):
    """One flight, from 0.3 s before the surface; until when no command was given, since it was met [s]."""
    mass, speed, clearance = 350.0, 5e-3, 2e-3
    for tick in range(math.ceil((0.3 + flight.plane / speed + 0.1) / flight.period)):
        time = tick * flight.period - 0.3 + 0.37 * flight.period
        depth = speed * (time - delay) - flight.plane
        since = depth / speed
        force = 0.0
        if since > 0:
            force = flight.jump + flight.slope * 0.01 * (since / 0.01) ** flight.order
        force = mass * speed * force * flight.side + flight.bias + flight.noise * rng.standard_normal()
        place = speed * time if flight.side > 0 else -clearance - speed * time
        if law.step(force, place, flight.side * speed, place) != 0.0:
            return since
    return math.inf


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_surface_is_found_where_it_is(name):
    """In each of eight flights with noise of their own, and not before it was met."""
    flight, rng = FLIGHTS[name], np.random.default_rng(1)
    mechanism = load("suite-noisy", [f"rig.control_period={flight.period}"]).mechanism
    gains = nominal_gains(mechanism, "retrospective_reference", force_noise=flight.noise)
    law = RetrospectiveReference(gains, flight.period, 2e-3)
    off = []
    for _ in range(8):
        law.reset()
        assert law.contact_plane == 0.0
        waited = fly(law, flight, rng, gains["identification_delay"])
        assert 0 < waited < 0.03
        off.append((law.contact_plane - flight.plane) / 5e-3)
    print(name, np.sqrt(np.mean(np.square(off))), max(map(abs, off)))
    assert max(map(abs, off)) < flight.within


def test_what_contacts_tell_of_the_surface_adds_up():
    """Of a surface as likely anywhere between two places, met within the same width again and again: the
    product of normal densities. What is far off counts alone."""
    plane, width = ContactPlane(1e-3), 5e-6
    variance = found_variance(width, 7)
    assert variance == pytest.approx(width**2 * (1 / 12 + (0.25 * 7) ** 2))
    precision, place = 1 / 1e-3**2, 0.0
    for tick in (140, 141, 139, 140):
        plane.learn(tick * width, (tick + 1) * width, variance)
        place = (place * precision + (tick + 0.5) * width / variance) / (precision + 1 / variance)
        precision = 1 / (1 / (precision + 1 / variance) + DRIFT**2)
        assert (plane.place, plane.spread) == pytest.approx((place, precision**-0.5), rel=1e-9)
    plane.learn(400 * width, 401 * width, variance)
    assert plane.place == pytest.approx(400.5 * width)


def test_after_some_contacts_the_surface_is_known_to_two_ticks():
    flight, rng = Flight(plane=7e-4), np.random.default_rng(2)
    gains = nominal_gains(load("suite-noisy").mechanism, "retrospective_reference")
    law = RetrospectiveReference(gains, flight.period, math.inf)
    off = []
    for _ in range(12):
        fly(law, flight, rng, gains["identification_delay"])
        off.append(abs(law.contact_plane - flight.plane))
        law.next_contact()
    print(off)
    assert max(off[6:]) < 1e-5
