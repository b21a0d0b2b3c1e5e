"""The bank of delays: its weights against exact densities, both recursions, and what it finds of a delay."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gain_documents import gain_document
from scipy import stats

from jaxhil.compensators import delay_bank as in_jax
from jaxhil.compensators import force_depth_map
from jaxhil.compensators.hypotheses import suppose
from jaxhil.compensators.lagged_onset import Window
from jaxhil.compensators.meeting import Meeting as MeetingInJax
from jaxhil.compensators.reintegration import Scales
from jaxhil.runtime import Controller
from jaxhil.runtime.laws.contact_plane import Meeting
from jaxhil.runtime.laws.delay_bank import STEADY, UNLIKELY, USUAL, WHOLE, DelayBank
from jaxhil.runtime.laws.force_depth_map import KNOTS, ForceDepthMap, Prior
from jaxhil.runtime.laws.hypotheses import DELAYS, FIRST_LAG, HYPOTHESES, LAGGING
from jaxhil.runtime.laws.lagged_onsets import lagged_onsets
from jaxhil.runtime.laws.onset import Onset

LAW, PERIOD, SPREAD, VARIANCE = "retrospective_delay_bank", 1e-3, 1e-3, 0.1**2
TOLD, FOUND, SPEED, STIFFNESS = 1e-6, 3e-6, 0.005, 500.0  # m, m, m/s, 1/s^2
PRIOR = {
    "stiffness": 200.0,
    "common": 100.0,
    "wandering": 50.0,
    "damping": 1.9,
    "depth_damping": 0.4,
    "unloading": 6.0,
    "friction": 0.0,
    "preload": 0.3,
}
OFFSETS = SPREAD * np.linspace(-1, 1, DELAYS)
LAGS = 0.00025 * np.arange(1, HYPOTHESES - FIRST_LAG + 1)
NO_DELAY, NO_LAG = np.zeros(len(LAGS)), np.zeros(FIRST_LAG)
DELAYED = np.concatenate([OFFSETS, OFFSETS, NO_DELAY])
OLDER = np.append(DELAYED[:FIRST_LAG], LAGS)
UNSEEN: tuple[list[float], list[float], float] = ([], [], VARIANCE)  # no readings about the onset


def contact(rng, ticks=170, begins=-0.02, lasts=0.13, delay=0.0, hides=0.0):
    """Depths, speeds and forces of a contact that is damped, its force `delay` [s] older than the depths, and
    what a dead zone hides."""
    phase = (begins + PERIOD * np.arange(ticks)) * math.pi / lasts
    depths, speeds = lasts / math.pi * np.sin(phase), np.cos(phase)
    x = depths - delay * speeds
    forces = np.where(x > 0, np.maximum(500 * x + 1.2 * speeds, 0), 0)
    forces = forces + math.sqrt(VARIANCE) * rng.standard_normal(ticks)
    hidden = np.abs(forces) < hides
    return depths, speeds, np.where(hidden, 0, forces), hidden


def plain(spread=SPREAD, plane_spread=TOLD, sensor_lag=0.0):
    return DelayBank(spread, sensor_lag, plane_spread, Prior(**PRIOR), PERIOD)


def meeting(place=0.0, pace=1.0):
    """A surface met `place` [m] beyond where it was told."""
    return Meeting(place, place, FOUND**2, SPEED, pace, PERIOD * pace, STIFFNESS)


def in_arrays(met):
    """The same for the law in JAX; what it does not ask for is left out."""
    zero = jnp.zeros(())
    scales = Scales(zero + 1, zero + met.plane, zero + met.speed, zero + met.pace, zero, zero)
    unasked: Any = None
    return MeetingInJax(
        found=jnp.asarray(True), scales=scales, planes=unasked, start=unasked, index=unasked, since=unasked,
        place=zero + met.place, variance=zero + met.variance, stiffness=zero + met.stiffness,
    )  # fmt: skip


def farthest(pace=1.0):
    """By how much [s] the surface may lie elsewhere than where it was met."""
    return (3 * math.sqrt((FOUND / (SPEED * PERIOD)) ** 2 - 1 / 12) + 1.5) * PERIOD * pace


def found(depths, forces, delay):
    """The surface, met between two ticks, and the readings until 8 ticks later."""
    met = int(np.argmax(depths > delay))
    middle = 0.5 * (depths[met - 1] + depths[met])
    newest = slice(max(met - 32, 0), met + 8)
    met_at = meeting()._replace(place=middle * SPEED, variance=(PERIOD * SPEED) ** 2 / 12)
    return met_at, (depths[newest] - middle).tolist(), forces[newest].tolist(), VARIANCE


def weights_of(bank):
    return bank._weigh()


def test_exponential_and_plausibility_are_nearly_those_of_the_normal_distribution():
    u = np.linspace(0, 20, 41)
    np.testing.assert_allclose(in_jax.exponential(jnp.asarray(u), in_jax.SQUARINGS), np.exp(-u), rtol=0.25)
    mean, spread, prior = np.linspace(-2, 4, 25), 0.7, 1.9
    found = in_jax.plausibility(jnp.asarray(mean), jnp.asarray(spread**2), jnp.asarray(prior**2))
    # The posterior's density at 0 over the prior's, and its share from 0 on over the prior's half.
    elastic = stats.norm.pdf(0, mean, spread) / stats.norm.pdf(0, 0, prior)
    exact = in_jax.ELASTIC * elastic + (1 - in_jax.ELASTIC) * 2 * stats.norm.cdf(mean / spread)
    np.testing.assert_allclose(found, exact, rtol=0.06, atol=1e-5)


def test_likelihood_is_the_root_of_the_density_of_all_readings():
    """Of a contact that closes: one multivariate normal density per hypothesis, no recursion."""
    rng = np.random.default_rng(0)
    depths, speeds, forces, _ = contact(rng, ticks=60, begins=0.002)
    bank = plain()
    bank.begin(meeting(), *UNSEEN)
    for depth, speed, force in zip(depths.tolist(), speeds.tolist(), forces.tolist(), strict=True):
        bank.learn(depth, speed, force, VARIANCE, False, 0.0)
    knots = np.array(KNOTS)
    wanders = PRIOR["wandering"] ** 2 * np.minimum.outer(knots, knots) / 0.03
    covariance = np.zeros((17, 17))
    for place, name in enumerate(("damping", "depth_damping", "unloading", "friction", "preload"), start=12):
        covariance[place, place] = PRIOR[name] ** 2
    mean = np.r_[np.full(12, PRIOR["stiffness"]), np.zeros(5)]
    share = TOLD**2 / (TOLD**2 + FOUND**2)
    covariance[16, 16] += (STIFFNESS * farthest()) ** 2
    exact = []
    for h, offset in enumerate(DELAYED[:FIRST_LAG]):
        covariance[:12, :12] = PRIOR["common"] ** 2 + wanders * (1 if h < DELAYS else STEADY**2)
        x = depths - offset * (speeds - share)
        assert np.all(x > 0)
        moved = knots + share * offset * np.minimum(knots / WHOLE, 1)
        ramps = np.clip(x[:, None] - moved, 0, np.append(np.diff(moved), np.inf))
        phi = np.column_stack([ramps, speeds, x * speeds / 0.03, x - np.maximum.accumulate(x)])
        phi = np.column_stack([phi, speeds / np.hypot(speeds, 0.03), np.ones_like(x)])
        spread = phi @ covariance @ phi.T + VARIANCE * np.eye(len(x))
        exact.append(0.5 * stats.multivariate_normal.logpdf(forces, phi @ mean, spread))
    found = np.log(bank._likelihood[:FIRST_LAG])
    np.testing.assert_allclose(found - found[4], np.array(exact) - exact[4], atol=0.02)
    assert np.ptp(exact) > 0.1


@pytest.mark.parametrize("sensor_lag", [0.0, 0.0012])
def test_both_recursions_agree(sensor_lag):
    """Three contacts, the last in part hidden by a dead zone, a lag told or not; what is carried as well."""
    rng = np.random.default_rng(1)
    bank, zero = plain(sensor_lag=sensor_lag), jnp.zeros(())
    prior = jax.jit(force_depth_map.prior)(*(zero + value for value in PRIOR.values()))
    ours, begin, learn = jax.jit(in_jax.no_bank)(prior), jax.jit(in_jax.begin), jax.jit(in_jax.learn)
    supposed = jax.jit(suppose)(zero + SPREAD, zero + sensor_lag)
    known = supposed, zero + TOLD, zero + PRIOR["damping"] ** 2
    for delay, zone, met in (
        (0.0004, 0.0, meeting(2e-6)), (0.0004, 0.0, meeting(1e-4, 0.8)), (-0.0007, 1.0, meeting()),
    ):  # fmt: skip
        about = contact(rng, ticks=40, delay=delay)
        earlier = bank.begin(met, about[0].tolist(), about[2].tolist(), VARIANCE)
        depths, forces, shown = (jnp.asarray(each) for each in (about[0], about[2], ~about[3]))
        window = Window(depths, forces, shown, zero + VARIANCE)
        ours, as_early = begin(ours, prior, in_arrays(met), window, zero + PERIOD, *known)
        assert int(as_early) == earlier
        for depth, speed, force, hidden in zip(*contact(rng, delay=delay, hides=zone), strict=True):
            bank.learn(float(depth), float(speed), float(force), VARIANCE, bool(hidden), zone)
            reading = force_depth_map.Reading(
                zero + depth, zero + speed, zero + force, zero + VARIANCE, jnp.asarray(bool(hidden)),
                zero + zone, jnp.asarray(True),
            )  # fmt: skip
            ours, curve = learn(ours, reading, zero + PERIOD, known[0], known[2])
        assert float(ours.shift) == pytest.approx(bank.shift, rel=1e-9, abs=1e-14)
        assert float(ours.deeper) == pytest.approx(bank.deeper, rel=1e-9, abs=1e-14)
        np.testing.assert_allclose(curve.slopes, bank.curve.slopes, rtol=1e-8)
        assert float(curve.preload) == pytest.approx(bank.curve.at_knots[0], rel=1e-7, abs=1e-12)
        for name in ("damping", "depth_damping", "unloading", "friction"):
            assert float(getattr(curve, name)) == pytest.approx(getattr(bank.curve, name), rel=1e-7)
    assert bank._met == float(ours.met) == 2
    np.testing.assert_allclose(ours.weighted, bank._weighted, rtol=1e-8)


@pytest.mark.parametrize("sensor_lag", [0.002, 0.004])
def test_behind_a_lag_that_is_told_readings_count_since_it_was_entered(sensor_lag):
    """The surface is met a lag after it was entered, by readings of a damper and a spring through it. Lags
    that are longer by up to 4 ms have it earlier still."""
    depths = PERIOD * np.arange(-30, 10)
    since = np.maximum(depths + sensor_lag, 0)
    shown = 1 - np.exp(-since / sensor_lag)
    forces = 2 * shown + 500 * (since - sensor_lag * shown)
    bank = plain(plane_spread=1e-3, sensor_lag=sensor_lag)
    earlier = bank.begin(meeting(), depths.tolist(), forces.tolist(), VARIANCE)
    assert 0 <= earlier - sensor_lag / PERIOD <= 8


def test_where_all_delays_are_the_same_it_is_one_map():
    depths, speeds, forces, _ = contact(np.random.default_rng(2), begins=0.002, lasts=0.2)
    uncertain = math.hypot(PRIOR["preload"], STIFFNESS * farthest())
    bank, alone = plain(0.0, 1e-12), ForceDepthMap(Prior(**{**PRIOR, "preload": uncertain}))
    bank.begin(meeting(), *UNSEEN)
    deepest = 0.0
    for depth, speed, force in zip(depths.tolist(), speeds.tolist(), forces.tolist(), strict=True):
        deepest = max(deepest, depth)
        bank.learn(depth, speed, force, VARIANCE, False, 0.0)
        alone.update(depth, speed, deepest, force, VARIANCE)
    weights = weights_of(bank)
    np.testing.assert_allclose(weights[:DELAYS], weights[0], rtol=1e-12)
    for h in range(DELAYS):
        np.testing.assert_allclose(bank._estimate[:, h], alone._estimate, rtol=1e-9, atol=1e-12)
    assert np.sum(weights[:FIRST_LAG]) > 0.9


@pytest.mark.parametrize(("bend", "steady"), [(0.0, True), (2000.0, False)])
def test_contacts_decide_whether_slopes_wander_but_not_thereby_on_lags(bend, steady):
    """Once the first is over, linear contact speaks for steady slopes, contact that hardens against them.
    Lags, whose slopes wander, have the share that they would have beside delays whose slopes do."""
    bank = plain()
    for number in range(3):
        depths, speeds, forces, _ = contact(np.random.default_rng(number), lasts=0.15)
        bank.begin(meeting(), *UNSEEN)
        before = bank._carried
        for depth, speed, force in zip(depths.tolist(), speeds.tolist(), forces.tolist(), strict=True):
            bank.learn(depth, speed, force + bend * max(depth - 0.02, 0), VARIANCE, False, 0.0)
        weights, either = weights_of(bank), before[:DELAYS] + before[DELAYS:FIRST_LAG]
        shares = [np.sum(weights[:DELAYS]), np.sum(weights[DELAYS:FIRST_LAG])]
        assert shares[1] == 0 if number == 0 else shares[steady] > 3 * shares[not steady]
        lagging = before[FIRST_LAG:] * bank._likelihood[FIRST_LAG:]
        bank._carried = np.concatenate([either, 0 * either, before[FIRST_LAG:]])
        np.testing.assert_allclose(weights[FIRST_LAG:], weights_of(bank)[FIRST_LAG:], rtol=1e-12)
        bank._carried = before
    delayed = np.sum(either * bank._likelihood[:DELAYS] * bank._likely[:DELAYS])
    bank.begin(meeting(), *UNSEEN)
    shares = lagging / (np.sum(lagging) + delayed)
    np.testing.assert_allclose(bank._carried[FIRST_LAG:], np.maximum(shares, 1e-12), rtol=1e-9)


def test_derivatives_are_finite_where_delays_are_next_to_nothing_beside_a_lag():
    prior = force_depth_map.prior(*(jnp.asarray(value) for value in PRIOR.values()))
    small = jnp.where(jnp.arange(HYPOTHESES) < FIRST_LAG, 1e-200, 1.0)
    bank = in_jax.no_bank(prior)._replace(carried=jnp.maximum(small, 1e-12), likelihood=small)

    def weights(share):
        return in_jax.weigh(bank._replace(likelihood=bank.likelihood * share), jnp.asarray(1.9**2))

    share, rates = jnp.ones(HYPOTHESES), jnp.zeros(HYPOTHESES).at[-1].set(1.0)
    value, rate = jax.jvp(weights, (share,), (rates,))
    step = 1e-4
    exact = (weights(share + step * rates) - weights(share - step * rates)) / (2 * step)
    np.testing.assert_allclose(rate, exact, atol=1e-6)
    assert np.sum(value[FIRST_LAG:]) == pytest.approx(1) and rate[-1] > 0.01


def test_contacts_narrow_the_delay_and_a_reset_forgets_it():
    rng, bank, delay = np.random.default_rng(3), plain(), 0.0006
    spreads = []
    for _ in range(8):
        # The ticks fall elsewhere on every contact: of damped contact that is what tells a delay.
        depths, speeds, forces, _ = contact(rng, begins=-0.02 + PERIOD * rng.random(), delay=delay)
        bank.begin(*found(depths, forces, delay))
        for depth, speed, force in zip(depths.tolist(), speeds.tolist(), forces.tolist(), strict=True):
            bank.learn(depth, speed, force, VARIANCE, False, 0.0)
        weights = weights_of(bank)
        spreads.append(math.sqrt(np.sum(weights * (OLDER - bank.shift) ** 2)))
    assert abs(bank.shift - delay) < 1e-4 and spreads[-1] < 0.6 * spreads[0]
    bank.reset()
    np.testing.assert_array_equal(weights_of(bank), weights_of(plain()))


def test_a_jump_between_two_hypotheses_rules_neither_out():
    """The surface is told; readings fall between the surfaces of the two nearest to the delay, now before the
    true one, now beyond it."""
    rng, bank, delay = np.random.default_rng(7), plain(plane_spread=1e-9), 0.5 * (OFFSETS[11] + OFFSETS[12])
    for beside in (-3e-5, 3e-5) * 2:
        depths, speeds, forces, _ = contact(rng, begins=delay + beside - 20 * PERIOD, delay=delay)
        bank.begin(*found(depths, forces, delay))
        for depth, speed, force in zip(depths.tolist(), speeds.tolist(), forces.tolist(), strict=True):
            bank.learn(depth, speed, force, VARIANCE, False, 0.0)
    assert bank.shift == pytest.approx(delay, abs=1e-4)


@pytest.mark.parametrize(
    ("plane_spread", "place", "share"),
    [
        (1e-7, 4e-6, 0.0),  # told
        (1e3, 4e-6, 1.0),  # unknown
        (1e-7, 4e-4, 1.0),  # told, and not there
        (FOUND, 4e-6, 0.5),
    ],
)
def test_surface_lies_between_where_it_was_told_and_where_it_was_met(plane_spread, place, share):
    bank, pace = plain(plane_spread=plane_spread), 0.5
    earlier = bank.begin(meeting(place, pace), *UNSEEN)
    # Depth when it was met: X_0 - d v_0 less p_h = g (X_0 - d v_0), X_0 later with a lag.
    later, around = lagged_onsets(LAGS * pace, *UNSEEN, PERIOD * pace)
    met = place + np.append(NO_LAG, later * SPEED / pace)
    both = plane_spread**2 + FOUND**2 + np.append(NO_LAG, around * (SPEED / pace) ** 2)
    depth = (place - DELAYED * SPEED) / SPEED * pace - share * (met - DELAYED * SPEED) / SPEED * pace
    delayed = slice(0, FIRST_LAG)
    np.testing.assert_allclose((-bank._below - DELAYED * pace)[delayed], depth[delayed], atol=1e-6)
    away = (met - DELAYED * SPEED) ** 2 / both
    entered = -bank._below[FIRST_LAG:].min() / (PERIOD * pace)
    assert earlier == min(math.ceil(max(entered - 1e-2, 0)), 30)
    weights = np.concatenate([np.ones(DELAYS), np.zeros(DELAYS), np.full(len(LAGS), LAGGING)])
    weights *= np.maximum(np.exp(-0.5 * away), UNLIKELY)
    # Of a delay, the place that its map's preload makes, in the mean where it has the surface.
    length, wide = SPEED / pace, STIFFNESS * farthest(pace)
    placed = wide**2 / (wide**2 + PRIOR["preload"] ** 2)
    known, own = (plane_spread / length) ** 2, placed * wide**2 + placed * PRIOR["preload"] ** 2
    own = own / PRIOR["stiffness"] ** 2
    off = share * (met - DELAYED * SPEED)[delayed] / length
    there = np.exp(-0.5 * off**2 / (known + own)) * math.sqrt(known / (known + own))
    weights[delayed] = np.where(weights[delayed] > 0, 1, 0) * np.maximum(there, UNLIKELY)
    weights[delayed] *= farthest(pace) * length / (USUAL * FOUND)
    weights /= np.sum(weights)
    np.testing.assert_allclose(weights_of(bank), weights, rtol=0.03)
    assert bank.shift == pytest.approx(weights @ OLDER, abs=1e-5)
    assert bank.deeper == pytest.approx(weights @ bank._below, abs=1e-5)


@pytest.mark.parametrize("delay", [-0.0005, 0.0005])
@pytest.mark.parametrize("bends", [0.04, 0.042])  # 46 is a knot
def test_where_a_contact_bends_does_not_tell_its_delay(bends, delay):
    """Two layers without noise, the surface met where it is: what a map misses of the bend must not pass
    for a delay that moves the bend of the way back to a knot."""
    bank = plain(plane_spread=1e-3)
    phase = (0.5e-3 - 0.002 + PERIOD * np.arange(150)) * math.pi / 0.15
    depths, speeds = 0.15 / math.pi * np.sin(phase), np.cos(phase)
    bank.begin(meeting(place=delay * SPEED)._replace(variance=1e-13), *UNSEEN)
    for depth, speed in zip(depths.tolist(), speeds.tolist(), strict=True):
        # A force that is `delay` older, of depths that begin where the hardware then was.
        x = depth - delay * (speed - 1)
        force = max(300 * x + 600 * max(x - bends, 0), 0)
        variance = 1e-4 + (0.01 * force) ** 2
        bank.learn(depth, speed, force, variance, False, 0.0)
    assert bank.shift == pytest.approx(delay, abs=2e-4)


def test_onset_is_as_spread_as_the_readings_leave_it():
    """Against every tick beside it, without a step; where it is expected does not count."""
    rng = np.random.default_rng(4)
    for jump, stiffness in ((0.0, 150.0), (2.0, 400.0)):
        onset = Onset(PERIOD)
        for tick in range(1, 91):
            time = PERIOD * (tick - 80.3)
            onset.take(0.1 * rng.standard_normal() + (jump + stiffness * time if time > 0 else 0.0), True)
        found = onset.find(0.01, 0.0, lambda age: 1.0)
        assert found is not None
        ages = np.arange(1, 2 * found.age + 8)
        evidence = np.array([onset.suppose(int(age), 0.01, 0.0, 1.0).evidence for age in ages])
        weights = np.exp(evidence - evidence.max()) / np.sum(np.exp(evidence - evidence.max()))
        mean = np.sum(weights * ages)
        variance = np.sum(weights * (ages - mean) ** 2)
        assert abs(found.age + found.earlier - mean) < 0.3 * math.sqrt(variance + 1 / 12)
        assert found.variance == pytest.approx(variance, rel=0.5, abs=0.02)
        assert abs(found.age + found.earlier - 10.2) < 3 * math.sqrt(found.variance + 1 / 12)
        assert abs(found.earlier) < 0.1 if jump else found.variance > 0.5


@pytest.mark.slow
def test_simulate_and_the_controller_report_the_delay(jaxhil):
    given = ["--set", "rig.force_sensor.delay=0.0085"]
    answer = jaxhil("simulate", "suite-layered", "--compensator", LAW, *given, "--json")
    [one] = answer.document["contacts"]
    assert one["force_delay"] == pytest.approx(0.0085, abs=3e-4)
    table = jaxhil("simulate", "suite-layered", "--compensator", LAW, *given).out
    assert "force delay [ms]" in table and f"{1e3 * one['force_delay']:.2f}" in table
    document = gain_document(LAW)
    value = document["gains"]["identification_delay"]["value"]
    assert Controller.from_dict(document).force_delay == value
    assert Controller.from_dict(gain_document("phase_lead")).force_delay == 0
