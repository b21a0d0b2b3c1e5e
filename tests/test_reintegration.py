"""The motion that a contact should have had: against closed forms, of any length, and what economy costs."""

import math

import numpy as np
import pytest
from cases import Case, run_oracle
from lanes import mechanism as plain_mechanism
from test_force_depth_map import curve_of

from jaxhil.compensators import history as history_in_jax
from jaxhil.compensators import reintegration as in_jax
from jaxhil.runtime.laws import history as histories
from jaxhil.runtime.laws import reintegration
from jaxhil.runtime.laws.history import History
from jaxhil.runtime.laws.reintegration import ReferenceMotion, Scales

PERIOD = 1e-3


def reference_motion(since, depth=None, samples=(), period=PERIOD):
    """A reference whose hardware met the surface `since` [ticks] before the first of the `samples`, each
    force, whether it was shown, position and velocity, on scales of 1; the model is `depth` [s] further, or
    as far."""
    history, scales = History(), Scales(math.inf)
    scales.side = 1.0
    history.take(0.0, True, -(1 - since) * period, 1.0)
    for sample in samples:
        history.take(*sample)
    made = ReferenceMotion(history, scales, period)
    made.begin(0, history.recall(0), since, since * period if depth is None else depth)
    return made


def half_sine(rate, last, period=PERIOD, seen=lambda force, speed: True):
    """Samples of the undamped contact of this rate [rad/s], entered half a tick before the first."""
    time = (0.5 + np.arange(last)) * period
    forces, depths, speeds = rate * np.sin(rate * time), np.sin(rate * time) / rate, np.cos(rate * time)
    rows = zip(forces.tolist(), depths.tolist(), speeds.tolist(), strict=True)
    return [(force, bool(seen(force, speed)), depth, speed) for force, depth, speed in rows]


@pytest.mark.parametrize(
    ("damping", "since", "depth"), [(0.0, 0.2, None), (4.0, 0.2, None), (4.0, 0.9, None), (4.0, 0.4, 0.0123)]
)
def test_reference_of_a_known_map_is_the_exact_motion(damping, since, depth):
    """Damped oscillation until its force is 0, however the ticks fall, and however late the hardware met."""
    stiffness = 600.0
    curve = curve_of(np.full(12, stiffness), damping=damping)
    decay = damping / 2
    rate = math.sqrt(stiffness - decay**2)
    ends = math.atan2(2 * decay * rate, 2 * decay**2 - stiffness) / rate
    leaves = math.exp(-decay * ends) * (math.cos(rate * ends) - decay / rate * math.sin(rate * ends))
    reference = reference_motion(since, depth)
    begins = since * PERIOD if depth is None else depth
    for tick in range(200):
        reference.tick(curve)
        time = begins + tick * PERIOD
        if time < ends - PERIOD:
            exact = math.exp(-decay * time) * math.sin(rate * time) / rate
            assert reference.live.depth == pytest.approx(exact, abs=2e-3 / rate)
    assert reference.live.speed == pytest.approx(leaves, abs=2e-3)


def test_reference_loses_what_the_unloading_takes():
    """Unloading r times as steep as loading leaves the share 1/r of the energy: e = r^(-1/2)."""
    ratio, stiffness = 1.44, 600.0
    reference = reference_motion(0.5)
    curve = curve_of(np.full(12, stiffness), unloading=(ratio - 1) * stiffness)
    for _ in range(200):
        reference.tick(curve)
    assert reference.live.speed == pytest.approx(-1 / 1.2, abs=2e-3)


def test_reference_loses_what_preload_and_friction_take():
    """F_0 + k d + F_r sign(v): each way an oscillation about a centre outside the surface."""
    stiffness, preload, friction = 600.0, 3.0, 1.5
    reference = reference_motion(0.5)
    curve = curve_of(np.full(12, stiffness), preload, friction=friction)
    for _ in range(200):
        reference.tick(curve)
    inward, outward = (preload + friction) / stiffness, (preload - friction) / stiffness
    deepest = math.sqrt(inward**2 + 1 / stiffness) - inward
    speed = math.sqrt(stiffness * ((deepest + outward) ** 2 - outward**2))
    # The friction turns over a range of speeds.
    assert reference.live.speed == pytest.approx(-speed, abs=5e-3)


def test_replayed_force_makes_up_for_a_wrong_map():
    """With rho = 1 and all of the hardware's motion known, the reference is that motion, whatever the map."""
    wrong, rate = curve_of(np.full(12, 350.0)), 20.0
    last = math.floor(math.pi / rate / PERIOD)
    samples = half_sine(rate, last)
    found = {}
    for replay in (0.0, 1.0):
        reference = reference_motion(0.5, samples=samples)
        reference.replay = replay
        for _ in range(last):
            reference.tick(wrong)
        found[replay] = abs(reference.live.depth - samples[-1][2]) * rate
    assert found[1.0] < 2e-3 and found[0.0] > 0.1


@pytest.mark.parametrize("told", [True, False])
def test_what_a_dead_zone_hides_is_left_to_the_map(told):
    """With rho = 1 and the true map, the way in, on which no force is read at first, does no harm; taken for
    no force, it does."""
    rate = 20.0
    right, last = curve_of(np.full(12, rate**2)), math.floor(math.pi / rate / PERIOD)
    samples = half_sine(rate, last, seen=lambda force, speed: force > 0.7 * rate or speed < 0.0)
    if not told:
        samples = [(force if seen else 0.0, True, *motion) for force, seen, *motion in samples]
    reference = reference_motion(0.5, samples=samples)
    reference.replay = 1.0
    for _ in range(last):
        reference.tick(right)
    error = abs(reference.live.speed - samples[-1][3])
    assert error < 2e-3 if told else error > 0.1


def test_a_contact_of_many_ticks_is_followed_as_well():
    """6000 of them, of which each eventually 256th is kept; with a wrong map, whose misses are replayed."""
    period, rate = 1e-3, math.pi / 6.0
    samples = half_sine(rate, 5990, period)
    reference = reference_motion(0.5, period=period)
    reference.replay = 1.0
    wrong = curve_of(np.full(12, 0.9 * rate**2))
    for sample in samples:
        reference._history.take(*sample)
        reference.tick(wrong)
    assert reference.live.speed == pytest.approx(samples[-1][3], abs=2e-3)


def test_both_sides_keep_and_go_as_far():
    assert (histories.SLOTS, histories.LEVELS) == (history_in_jax.SLOTS, history_in_jax.LEVELS)
    assert (reintegration.STRIDE, reintegration.COARSE) == (in_jax.STRIDE, in_jax.COARSE)


def quiet_case(stiffness, **rig):
    """A contact of the standard suites without noise."""
    simulator = {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8, "delay": 0.004}
    raw = plain_mechanism({"stiffness": [stiffness]}, simulator, 0.008, **{"period": PERIOD, **rig})
    return Case(raw, "retrospective_reference", {})


@pytest.mark.parametrize("stiffness", [4e4, 2.5e5])
def test_economical_reference_costs_little(monkeypatch, stiffness):
    """Against integrating the reference over again from the entry, sample by sample, at every tick."""
    case = quiet_case(stiffness)
    economical = run_oracle(case)[0]["restitution"]
    monkeypatch.setattr(reintegration, "STRIDE", 10**6)
    monkeypatch.setattr(reintegration, "COARSE", 0.0)
    plain = run_oracle(case)[0]["restitution"]
    print(stiffness, plain - 1, economical - 1)
    assert plain != economical
    assert abs(plain - 1) < 1.5e-3 and abs(economical - plain) < 5e-4


@pytest.mark.parametrize("frequency", [0.12, pytest.param(0.06, marks=pytest.mark.slow)])
def test_slow_contact_is_followed_on_a_slower_scale_of_time(frequency):
    """The contact's half period is 4 or 8 s: more than a thousand ticks of 4 ms, and slopes far below
    usual."""
    stiffness = 350.0 * (2 * math.pi * frequency) ** 2
    contact = run_oracle(quiet_case(stiffness, period=4e-3))[0]
    print(frequency, contact["restitution"] - 1)
    assert contact["restitution"] == pytest.approx(1.0, abs=1e-3)
