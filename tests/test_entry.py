"""Where a contact was entered: against normal densities, and JAX against the controller's."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from jaxhil.compensators import entry as in_jax
from jaxhil.compensators.force_depth_map import Map
from jaxhil.compensators.lagged_onset import Window
from jaxhil.compensators.meeting import Meeting as MeetingInJax
from jaxhil.compensators.reintegration import Scales
from jaxhil.runtime.laws.contact_plane import Meeting
from jaxhil.runtime.laws.entry import Entry, Readings, agree
from jaxhil.runtime.laws.force_depth_map import DAMPING, FRICTION, PARAMETERS, PRELOAD

SPEED, TICK, NOISE, STIFFNESS, HYPOTHESES = 0.005, 1e-3, 0.1, 500.0, 7
TOLD = (1e-6, 1e-3)  # m: how uncertain it is where the surface was told


def meeting(spread=2.5e-6):
    return Meeting(1e-6, 2e-6, spread**2, SPEED, 1.0, TICK, STIFFNESS)


def readings(rng, jump, begins, number=30):
    """The surface met, by them alone, 8 ticks before the newest; in truth elsewhere by `begins` [s]."""
    depths = TICK * (np.arange(number) - number + 8.5)
    forces = np.where(depths > begins, jump + 300 * (depths - begins), 0)
    forces = forces + NOISE * rng.standard_normal(number)
    return Readings(depths.tolist(), forces.tolist(), NOISE**2)


def maps(rng, jump):
    """Means, (parameters, hypotheses), and covariances of maps that are about right."""
    estimate = np.zeros((PARAMETERS, HYPOTHESES))
    estimate[0] = 300 + 20 * rng.standard_normal(HYPOTHESES)
    estimate[PRELOAD] = 0.1 * rng.standard_normal(HYPOTHESES)
    estimate[DAMPING] = jump + 0.1 * rng.standard_normal(HYPOTHESES)
    covariance = np.zeros((PARAMETERS, PARAMETERS, HYPOTHESES))
    for h in range(HYPOTHESES):
        root = np.diag([20.0, 0.03, 0.05]) + np.tril([[0] * 3, [0.02] * 3, [-0.02] * 3], -1)
        places = np.array([0, DAMPING, PRELOAD])
        covariance[places[:, None], places, h] = root @ root.T
    return estimate, covariance


def entry_of(read, met, told, true=0.0, step=1.25e-4):
    deeper = SPEED * TICK * np.linspace(-0.5, 0.5, HYPOTHESES)
    places = 1e-6 * np.linspace(-1, 1, HYPOTHESES)
    return Entry.of(met, read, deeper, places, told**2, true, step), deeper, places


def exact(entry, estimate, covariance, told, places):
    """How likely, by scipy's normal distribution."""
    began, agreed, greatest = np.empty(HYPOTHESES), np.empty(HYPOTHESES), 0.0
    for h in range(HYPOTHESES):
        slope, preload = estimate[0, h], estimate[PRELOAD, h]
        gradient = np.array([preload / slope**2, -1 / slope])
        part = covariance[[[0], [PRELOAD]], [0, PRELOAD], h]
        place, variance = -preload / slope, gradient @ part @ gradient
        known, at = (told / SPEED) ** 2, -places[h] / SPEED
        there = math.exp(-0.5 * (place - at) ** 2 / (known + variance)) * math.sqrt(
            known / (known + variance)
        )
        if (place - at) ** 2 <= 9 * (known + variance):
            place, variance = (
                (place * known + at * variance) / (known + variance),
                1 / (1 / known + 1 / variance),
            )
        spread = math.sqrt(variance + entry.between)
        x, y = entry.depths + entry.deeper[h], entry.forces
        begun = slope * x + preload + estimate[DAMPING, h] + estimate[FRICTION, h]
        phi = np.zeros((len(x), PARAMETERS))
        phi[:, 0], phi[:, DAMPING], phi[:, PRELOAD] = x, 1, 1
        wide = np.sqrt(NOISE**2 + np.einsum("ia,ab,ib->i", phi, covariance[:, :, h], phi))
        edges = np.concatenate([[-np.inf], x, [np.inf]])
        began[h] = 0.0
        for j in range(len(x) + 1):
            density = np.sum(norm.logpdf(y[j:], begun[j:], wide[j:])) + np.sum(norm.logpdf(y[:j], 0, NOISE))
            began[h] += math.exp(density) * np.ptp(norm.cdf(edges[j : j + 2], place, spread))
            greatest = max(greatest, math.exp(density))
        agreed[h] = max(there, 0.1)
    best = np.max(began)
    return entry.level * agreed * (began / best) * math.sqrt(best / greatest)


@pytest.mark.parametrize("told", TOLD)
@pytest.mark.parametrize(("jump", "behind"), [(0.0, 0.0), (1.5, 0.0), (1.5, 0.4e-3)])
def test_entries_are_as_likely_as_normal_densities_say(jump, behind, told):
    """The last of maps that expect what is read of a surface that by them lies deeper, as behind a lag."""
    rng = np.random.default_rng(int(10 * jump))
    estimate, covariance = maps(rng, jump)
    estimate[PRELOAD] -= behind * estimate[0]
    estimate[DAMPING] += behind * estimate[0]
    entry, _, places = entry_of(readings(rng, jump, 0.2e-3), meeting(), told)
    found = np.log(agree(entry, estimate, covariance).likely)
    wanted = np.log(exact(entry, estimate, covariance, told, places))
    assert 4 <= len(entry.depths) <= 8 and np.ptp(wanted) > 0.3
    np.testing.assert_allclose(found, wanted, atol=0.15)


def test_a_surface_that_is_not_where_readings_begin_makes_all_less_likely():
    likely = []
    for behind in (0.0, 2e-3):
        rng = np.random.default_rng(4)
        estimate, covariance = maps(rng, 1.5)
        estimate[PRELOAD] -= behind * estimate[0]
        estimate[DAMPING] += behind * estimate[0]
        entry, _, _ = entry_of(readings(rng, 1.5, 0.0), meeting(), 1e-3)
        likely.append(np.max(agree(entry, estimate, covariance).likely) / entry.level)
    assert likely[1] < 0.01 * likely[0]


def test_a_true_preload_that_may_be_tells_of_no_place():
    rng = np.random.default_rng(2)
    estimate, covariance = maps(rng, 0.5)
    estimate[PRELOAD] += 1.0
    read = readings(rng, 0.5, 0.0)
    bare, may_be = (entry_of(read, meeting(), 1e-3, true)[0] for true in (0.0, 100.0))
    places = [np.abs(agree(one, estimate, covariance).place) for one in (bare, may_be)]
    assert np.all(places[1] < 0.1 * places[0])


@pytest.mark.parametrize("told", TOLD)
@pytest.mark.parametrize("jump", [0.0, 1.5])
def test_the_law_in_jax_agrees(jump, told):
    rng = np.random.default_rng(3)
    estimate, covariance = maps(rng, jump)
    read, met, zero, unasked = readings(rng, jump, 0.0), meeting(), jnp.zeros(()), None
    entry, deeper, places = entry_of(read, met, told, 0.1)
    like: Any = unasked
    scales = Scales(zero + 1, zero + met.plane, zero + SPEED, zero + 1, zero, zero)
    ours = MeetingInJax(
        found=jnp.asarray(True), scales=scales, planes=like, start=like, index=like, since=like,
        place=zero + met.place, variance=zero + met.variance, stiffness=zero + met.stiffness,
    )  # fmt: skip
    shown = jnp.ones(len(read.depths), dtype=bool)
    window = Window(jnp.asarray(read.depths), jnp.asarray(read.forces), shown, zero + read.variance)
    scale = zero + SPEED, zero + TICK
    of_jax = in_jax.enter(
        ours,
        window,
        *scale,
        jnp.asarray(deeper),
        jnp.asarray(places),
        zero + told**2,
        zero + 0.1,
        zero + 1.25e-4,
    )
    found, wanted = (
        in_jax.agree(of_jax, Map(jnp.asarray(estimate), jnp.asarray(covariance))),
        agree(entry, estimate, covariance),
    )
    np.testing.assert_allclose(found.likely, wanted.likely, rtol=1e-9)
    np.testing.assert_allclose(found.place, wanted.place, rtol=1e-9, atol=1e-15)
