"""The retrospective reference: its map, its motion, what economy costs it, and the errors it leaves."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, run_oracle
from lanes import as_arrays, join, nominal_gains, run_rollout
from lanes import mechanism as plain_mechanism
from scipy import stats

from jaxhil.building import build_loop
from jaxhil.compensators import force_depth_map as in_jax
from jaxhil.evaluation import compare_with_reference
from jaxhil.mechanism_file import load
from jaxhil.runtime import reference_motion
from jaxhil.runtime.force_depth_map import KNOTS, ForceDepthMap, positive_mean
from jaxhil.runtime.reference_motion import ReferenceMotion
from jaxhil.runtime.retrospective_reference import (
    IDENTIFIED,
    OUT_OF_CONTACT,
    SATURATED,
    UNSURE,
    RetrospectiveReference,
)
from jaxhil.scenario import build_scenarios
from jaxhil.uncertainty import draw

NAME, PERIOD = "retrospective_reference", 1e-3
PRIOR = {"stiffness": 254.0, "common": 2.63, "wandering": 0.979, "damping": 0.063, "damping_spread": 0.879}
MAP_AND_REFERENCE = {
    "prior_stiffness": 277.0,
    "prior_stiffness_spread": 2.98,
    "prior_slope_spread": 2.77,
    "prior_damping": 0.333,
    "prior_damping_spread": 1.09,
    "force_noise_floor": 0.06,
    "reference_frequency": 96.7,
    "reference_damping_ratio": 0.656,
    "force_replay": 0.0,
}
FORCE_LIMITED = {
    "prior_stiffness": 434.0,
    "prior_stiffness_spread": 0.581,
    "prior_slope_spread": 0.154,
    "prior_damping": 0.096,
    "prior_damping_spread": 2.18,
    "force_noise_floor": 0.331,
    "reference_frequency": 164.0,
    "reference_damping_ratio": 2.08,
    "correction_limit": 15.2,
}


def features(depth, speed):
    """The regressor, as the equation has it."""
    widths = np.append(np.diff(KNOTS), np.inf)
    return np.append(np.clip(depth - np.array(KNOTS), 0, widths), speed)


def prior():
    """Mean and covariance, as the equation has them."""
    knots = np.array(KNOTS)
    covariance = np.zeros((13, 13))
    stiffness = PRIOR["stiffness"]
    covariance[:12, :12] = (PRIOR["common"] * stiffness) ** 2
    covariance[:12, :12] += (PRIOR["wandering"] * stiffness) ** 2 * np.minimum.outer(knots, knots) / 0.03
    covariance[12, 12] = PRIOR["damping_spread"] ** 2
    return np.append(np.full(12, stiffness), PRIOR["damping"]), covariance


def some_readings(number=120):
    """Depths, speeds and forces of a contact that stiffens, noisy."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0.02, math.pi - 0.02, number)
    depths, speeds = 0.06 * np.sin(phase), np.cos(phase)
    forces = 250 * depths + 400 * np.maximum(depths - 0.03, 0) + 1.5 * speeds + 2.0
    return depths, speeds, forces + 0.05 * rng.standard_normal(number)


def test_map_is_the_posterior_of_all_readings():
    """Normal equations in extended precision against both recursions."""
    depths, speeds, forces = some_readings()
    variance = 0.14**2
    phi = np.array([features(*pair) for pair in zip(depths, speeds, strict=True)])
    mean, covariance = prior()
    spread = phi @ covariance @ phi.T + variance * np.eye(len(phi))
    share = np.linalg.solve(spread, phi @ covariance).T
    expected, left = mean + share @ (forces - phi @ mean), covariance - share @ phi @ covariance

    contact = ForceDepthMap(*PRIOR.values())
    like = jnp.zeros(())
    before = in_jax.prior(*(like + value for value in PRIOR.values()))
    np.testing.assert_allclose(before.mean, mean, rtol=1e-14)
    np.testing.assert_allclose(before.covariance, covariance, rtol=1e-13)
    ours = in_jax.Map(before.mean, before.covariance)
    for depth, speed, force in zip(depths, speeds, forces, strict=True):
        contact.update(float(depth), float(speed), float(force), variance)
        regressor = in_jax.features(like + depth, like + speed)
        ours = in_jax.update(ours, regressor, like + force, like + variance, jnp.asarray(True))
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(ours.mean, expected, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(contact.slopes, expected[:12], rtol=0, atol=1e-9 * scale)
    assert contact.damping == pytest.approx(expected[12], rel=1e-6)
    for depth, speed in ((0.004, 0.9), (0.03, -0.2), (0.2, 0.5)):
        regressor = features(max(depth, 0.01), speed)
        learnt = 1 - (regressor @ left @ regressor) / (regressor @ covariance @ regressor)
        assert contact.learnt(depth, speed) == pytest.approx(learnt, abs=1e-9)
        assert float(in_jax.learnt(ours, before, like + depth, like + speed)) == pytest.approx(
            learnt, abs=1e-9
        )
        assert contact.force(depth, speed) == pytest.approx(
            features(depth, speed) @ [*expected[:12], contact.damping], rel=1e-9
        )


@pytest.mark.parametrize("ratio", [-30.0, -3.0, -0.5, 0.0, 0.3, 1.0, 2.5, 8.0])
def test_damping_that_counts_is_the_truncated_mean(ratio):
    density, share = stats.norm.pdf(ratio), stats.norm.cdf(ratio)
    expected = ratio + density / share if ratio > -20 else -1 / ratio
    assert positive_mean(0.4 * ratio, 0.16) == pytest.approx(0.4 * expected, rel=0.03)


def test_reference_of_a_known_map_is_the_exact_motion():
    """Damped oscillation until its force is 0, however the ticks fall."""
    stiffness, damping = 600.0, 4.0
    contact = ForceDepthMap(stiffness, 0.0, 0.0, damping, 0.0)
    decay = damping / 2
    rate = math.sqrt(stiffness - decay**2)
    ends = math.atan2(2 * decay * rate, 2 * decay**2 - stiffness) / rate
    leaves = math.exp(-decay * ends) * (math.cos(rate * ends) - decay / rate * math.sin(rate * ends))
    for first in (0.2 * PERIOD, 0.9 * PERIOD):
        reference = ReferenceMotion(1.0, PERIOD)
        reference.restart(first)
        for tick in range(200):
            reference.tick(contact)
            time = first + tick * PERIOD
            if time < ends - PERIOD:
                exact = math.exp(-decay * time) * math.sin(rate * time) / rate
                assert reference.depth == pytest.approx(exact, abs=2e-3 / rate)
        assert reference.speed == pytest.approx(leaves, abs=2e-3)


def test_replayed_force_makes_up_for_a_wrong_map():
    """With rho = 1 and all of the hardware's motion known, the reference is that motion, whatever the map."""
    wrong, rate = ForceDepthMap(350.0, 0.0, 0.0, 0.0, 0.0), 20.0
    last = math.floor(math.pi / rate / PERIOD)
    found = {}
    for replay in (0.0, 1.0):
        reference = ReferenceMotion(replay, PERIOD)
        reference.restart(0.5 * PERIOD)
        time = (0.5 + np.arange(last)) * PERIOD
        impulse = (1 - np.cos(rate * time)) * rate / rate / PERIOD
        depths, speeds = np.sin(rate * time) / rate, np.cos(rate * time)
        for index in range(last):
            reference.remember(index, float(impulse[index]), float(depths[index]), float(speeds[index]))
        for _ in range(last):
            reference.tick(wrong)
        found[replay] = abs(reference.depth - depths[-1]) * rate
    assert found[1.0] < 2e-3 and found[0.0] > 0.1


def quiet_case(stiffness, gains, damping=0.0):
    """A contact of the standard suites without noise."""
    raw = plain_mechanism(
        {"stiffness": [stiffness], "damping": [damping]},
        {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8, "delay": 0.004},
        0.008,
        period=PERIOD,
    )
    return Case(raw, NAME, gains)


@pytest.mark.parametrize("gains", [MAP_AND_REFERENCE, {}])
@pytest.mark.parametrize("stiffness", [4e4, 2.5e5])
def test_economical_reference_costs_little(monkeypatch, stiffness, gains):
    """Against integrating the reference over again from the entry, sample by sample, at every tick."""
    case = quiet_case(stiffness, gains)
    economical = run_oracle(case)[0]["restitution"]
    monkeypatch.setattr(reference_motion, "STRIDE", 10**6)
    monkeypatch.setattr(reference_motion, "COARSE", 0.0)
    plain = run_oracle(case)[0]["restitution"]
    print(stiffness, plain - 1, economical - 1)
    assert plain != economical
    assert abs(plain - 1) < 4e-3 and abs(economical - plain) < 1.5e-3


@pytest.mark.parametrize(
    ("gains", "most"),
    [(MAP_AND_REFERENCE, 0.4), ({}, 0.4), (FORCE_LIMITED, 0.5)],
    ids=["map", "replay", "limited"],
)
def test_errors_of_the_standard_suite_of_damped_contact(gains, most):
    """Root mean square [%] of e - e*, where the published law leaves 8 to 10."""
    mechanism = load("suite-damped").mechanism
    scenario = join([build_scenarios(mechanism, draw(mechanism, 64, 3), 3)])
    loop = build_loop(mechanism, NAME, scenario)
    metrics = run_rollout(loop, as_arrays(nominal_gains(mechanism, NAME, **gains)), scenario)
    outcome = compare_with_reference(loop, scenario, metrics)
    assert np.all(np.asarray(outcome.good)[0])
    error = 100 * np.asarray(outcome.error)[0]
    print(np.sqrt(np.mean(error**2)), np.max(np.abs(error)))
    assert np.sqrt(np.mean(error**2)) < most and np.max(np.abs(error)) < 4 * most


def test_status_says_what_stands_behind_the_command():
    values = nominal_gains(load("suite-noisy").mechanism, NAME)
    law = RetrospectiveReference(values, PERIOD, math.inf)
    seen = []
    for tick in range(400):
        time = 0.001 * tick - 0.0203
        motion = [2e-4 * math.sin(25 * (time - late)) for late in (0.0, 0.03, 0.038)]
        force = 2.5e5 * max(motion[2], 0.0)
        law.step(force, motion[0], 5e-3 * math.cos(25 * time), motion[1])
        seen.append(law.status)
    assert seen[0] == OUT_OF_CONTACT and seen[25] == UNSURE
    assert {IDENTIFIED, SATURATED} & set(seen[60:140]) and OUT_OF_CONTACT in seen[160:]
    # A run that begins in contact: nothing to scale by, so that the measured force is passed on.
    law.reset()
    assert law.step(31.0, 1e-3, 0.0, 1e-3) == pytest.approx(31.0, rel=1e-15)
    assert law.status == UNSURE
