"""Whether a lag is told from a damper: spring and damper in closed form, read through a lagging sensor."""

import math

import numpy as np
import pytest

from jaxhil.runtime.laws.contact_plane import Meeting
from jaxhil.runtime.laws.force_depth_map import ForceDepthMap, Prior
from jaxhil.runtime.laws.lag_check import LAG, LIKELIER, MATTERS, LagCheck

PERIOD = 1e-3
RATE = 15.0  # of the spring's motion [1/s]: its peak force, and the root of its stiffness
NOISE = 0.08  # [1/s]
PRIOR = Prior(9.6, 35.8, 29.2, 1.9, 0.03, 0.16, 0.0, 1.0)  # of the law
BEFORE = 8  # readings before the surface is met


def forces(time: np.ndarray, damping: float, lag: float) -> np.ndarray:
    """RATE^2 x + damping v on x = sin(RATE t)/RATE as long as it pushes, through a lag: in closed form."""
    end = (math.pi - math.atan2(damping, RATE)) / RATE
    inside = np.clip(time, 0.0, end)
    # The imaginary part of (RATE + i damping) exp(i RATE t), and what of it the lag lets through.
    through = (RATE + 1j * damping) / (1 + 1j * RATE * lag)
    steady = through * np.exp(1j * RATE * inside)
    if lag == 0.0:
        return np.where((time > 0.0) & (time < end), steady.imag, 0.0)
    started = steady.imag - through.imag * np.exp(-inside / lag)
    return np.where(time > 0.0, started * np.exp(-np.maximum(time - end, 0.0) / lag), 0.0)


def charges(
    damping: float, lag: float, phase: float = 0.5, seed: int = 0, noise: float = NOISE
) -> tuple[float, float]:
    """What the map and what the lag is charged, met the share `phase` of a tick before a reading; readings
    have this noise [1/s], and are taken to have that of `NOISE`."""
    time = PERIOD * (np.arange(-BEFORE, math.ceil(math.pi / RATE / PERIOD) + 6) + phase)
    depth, rate = np.sin(RATE * time) / RATE, np.cos(RATE * time)
    force = forces(time, damping, lag) + noise * np.random.default_rng(seed).standard_normal(len(time))
    # Found after 6 ticks, the surface in the middle of the stretch in which it was met.
    plane = depth[BEFORE] - 0.5 * (depth[BEFORE] - depth[BEFORE - 1])
    meeting = Meeting(plane, plane, PERIOD**2 / 12, 1.0, 1.0, PERIOD, 400.0)
    check, one = LagCheck(PRIOR, PERIOD), ForceDepthMap(PRIOR)
    newest = slice(0, BEFORE + 6)
    check.begin(meeting, (depth[newest] - plane).tolist(), force[newest].tolist(), NOISE**2)
    charged, deepest = 0.0, 0.0
    for x, v, y in zip((depth - plane).tolist(), rate.tolist(), force.tolist(), strict=True):
        variance = NOISE**2 + (0.003 * y) ** 2
        deepest = max(deepest, x)
        check.take(x, v, y, variance, True)
        if x > 0.0:
            charged += one.update(x, v, deepest, y, variance)
        elif x <= -PERIOD:
            charged += y * y / variance
    return charged, check.surprise


def favours_lag(damping: float, lag: float, seed: int, phase: float = 0.5) -> float:
    """By how much less the lag is charged."""
    without, with_lag = charges(damping, lag, phase, seed)
    return without - with_lag


@pytest.mark.parametrize("lag", [1e-4, 1e-3, 3e-3])
def test_forces_through_a_lag_are_the_integral(lag):
    """Against Euler steps of lag y' = f - y, exact as they shrink."""
    fine = np.linspace(0.0, 0.25, 2_500_001)
    step = fine[1]
    straight = forces(fine, 2.0, 0.0)
    read, kept = np.empty_like(fine), math.exp(-step / lag)
    value = 0.0
    for place, force in enumerate(straight.tolist()):
        value = kept * value + (1.0 - kept) * force
        read[place] = value
    np.testing.assert_allclose(forces(fine, 2.0, lag)[::1000], read[::1000], atol=2e-5)


@pytest.mark.parametrize("phase", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("damping", [0.0, 1.0, 3.0])
def test_a_damper_without_a_lag_is_believed(damping, phase):
    found = [favours_lag(damping, 0.0, seed, phase) for seed in range(20)]
    assert np.mean(np.array(found) > LIKELIER) <= 0.05, found


@pytest.mark.parametrize("phase", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("lag", [0.75 * LAG, LAG, 1.5 * LAG])
def test_a_damper_behind_a_lag_is_not(lag, phase):
    """Its onset is that of a lag, and the map's energies are none the worse for it."""
    damping = RATE**2 * lag + 1.5
    found = [favours_lag(damping, lag, seed, phase) for seed in range(20)]
    assert np.mean(np.array(found) > LIKELIER) >= 0.95, found


@pytest.mark.parametrize("phase", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("damping", [0.5, 2.0, 4.0])
def test_a_lag_of_its_own_is_charged_little_but_for_what_the_prior_did_not_expect(damping, phase):
    """Of readings without noise; where the onset is and what is smoothed is known to a fraction of a tick."""
    without, with_lag = charges(damping, LAG, phase, noise=0.0)
    unexpected = ((RATE**2 - PRIOR.stiffness) / PRIOR.common) ** 2 + (damping / PRIOR.damping) ** 2
    assert with_lag - unexpected < 50.0, (without, with_lag)


def test_a_lag_that_takes_all_of_the_damping_looks_like_a_spring():
    """To first order; what is left is less than the noise."""
    found = [favours_lag(RATE**2 * 1e-3, 1e-3, seed) for seed in range(20)]
    assert np.mean(np.array(found) > LIKELIER) <= 0.25, found


@pytest.mark.parametrize(("peak", "pace"), [(MATTERS / (math.pi / 2 * LAG), 1.0), (15.0, 0.53)])
def test_a_lag_matters_by_what_the_restitution_errs(peak, pace):
    """A force older by l takes pi/2 p l; on a contact's slower time l is less."""
    check = LagCheck(PRIOR, PERIOD)
    check.begin(Meeting(0.0, 0.0, 1e-7, 1.0, pace, pace * PERIOD, 400.0), [1e-3], [0.5], NOISE**2)
    assert check.matters(1.01 * peak) and not check.matters(0.99 * peak)


def test_readings_that_the_sensor_does_not_show_count_for_neither():
    check = LagCheck(PRIOR, PERIOD)
    check.begin(Meeting(0.0, 0.0, 1e-7, 1.0, 1.0, PERIOD, 400.0), [1e-3], [0.5], NOISE**2)
    check.take(2e-3, 1.0, 0.8, NOISE**2, False)
    assert check.surprise == 0.0
    check.take(3e-3, 1.0, 0.8, NOISE**2, True)
    assert check.surprise > 0.0
