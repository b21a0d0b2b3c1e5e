"""The retrospective reference: its map, its motion, what economy costs it, and the errors it leaves."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cases import Case, run_oracle
from lanes import as_arrays, join, nominal_gains, run_rollout
from lanes import mechanism as plain_mechanism
from scipy import stats

from jaxhil.compensators import COMPENSATORS, literature_gains
from jaxhil.compensators import force_depth_map as in_jax
from jaxhil.compensators.reintegration import HISTORY
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.runtime.law_status import IDENTIFIED, OUT_OF_CONTACT, SATURATED, TOO_SHORT, UNSURE
from jaxhil.runtime.laws import reintegration
from jaxhil.runtime.laws.force_depth_map import KNOTS, Curve, ForceDepthMap, Prior, positive_mean
from jaxhil.runtime.laws.reintegration import ReferenceMotion
from jaxhil.runtime.laws.retrospective_reference import RetrospectiveReference
from jaxhil.simulation.building import build_loop
from jaxhil.simulation.evaluation import compare_with_reference
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios

NAME, PERIOD = "retrospective_reference", 1e-3
PRIOR = {
    "stiffness": 254.0,
    "common": 668.0,
    "wandering": 249.0,
    "damping": 0.9,
    "depth_damping": 0.4,
    "unloading": 60.0,
}


# Slopes of a map that pulls down to 10 ms and pushes from there on [1/s^2].
LATE = np.where(np.array(KNOTS) < 0.01, -50.0, 400.0)


def features(depth, speed, deepest):
    """The regressor, as the equation has it."""
    widths = np.append(np.diff(KNOTS), np.inf)
    pressed = np.clip(depth - np.array(KNOTS), 0, widths)
    return np.r_[pressed, speed, depth * speed / 0.03, depth - deepest]


def prior():
    """Mean and covariance, as the equation has them."""
    knots = np.array(KNOTS)
    covariance = np.zeros((15, 15))
    covariance[:12, :12] = PRIOR["common"] ** 2
    covariance[:12, :12] += PRIOR["wandering"] ** 2 * np.minimum.outer(knots, knots) / 0.03
    for place, name in enumerate(("damping", "depth_damping", "unloading")):
        covariance[12 + place, 12 + place] = PRIOR[name] ** 2
    return np.r_[np.full(12, PRIOR["stiffness"]), 0, 0, 0], covariance


def some_readings(number=120):
    """Depths, speeds, deepest points and forces of a contact that stiffens and dissipates, noisy."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0.02, math.pi - 0.02, number)
    depths, speeds = 0.06 * np.sin(phase), np.cos(phase)
    deepest = np.maximum.accumulate(depths)
    forces = 250 * depths + 400 * np.maximum(depths - 0.03, 0) + 1.5 * speeds + 20 * depths * speeds
    forces += 4.0 - 40 * (deepest - depths)
    return depths, speeds, deepest, forces + 0.05 * rng.standard_normal(number)


def curve_of(slopes, damping=0.0, depth_damping=0.0, unloading=0.0):
    """What counts of a map that is known."""
    curve = Curve()
    curve.slopes = list(slopes)
    curve.at_knots = [0.0, *np.cumsum(np.diff(KNOTS) * slopes[:-1]).tolist()]
    curve.damping, curve.depth_damping, curve.unloading = damping, depth_damping, unloading
    return curve


def test_map_is_the_posterior_of_all_readings():
    """Normal equations against both recursions."""
    readings = some_readings()
    variance = 0.14**2
    phi = np.array([features(*reading[:3]) for reading in zip(*readings, strict=True)])
    forces = readings[3]
    mean, covariance = prior()
    spread = phi @ covariance @ phi.T + variance * np.eye(len(phi))
    share = np.linalg.solve(spread, phi @ covariance).T
    expected, left = mean + share @ (forces - phi @ mean), covariance - share @ phi @ covariance

    contact = ForceDepthMap(Prior(**PRIOR))
    like = jnp.zeros(())
    ours, update = in_jax.prior(*(like + value for value in PRIOR.values())), jax.jit(in_jax.update)
    np.testing.assert_allclose(ours.mean, mean, rtol=1e-14)
    np.testing.assert_allclose(ours.covariance, covariance, rtol=1e-13)
    for depth, speed, deepest, force in zip(*readings, strict=True):
        contact.update(float(depth), float(speed), float(deepest), float(force), variance)
        regressor = in_jax.features(like + depth, like + speed, like + deepest)
        ours = update(ours, regressor, like + force, like + variance, jnp.asarray(True))
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(ours.mean, expected, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(contact.curve.slopes, expected[:12], rtol=0, atol=1e-9 * scale)
    counts = in_jax.curve(ours)
    for place, name in enumerate(("damping", "depth_damping", "unloading")):
        value = positive_mean(expected[12 + place], left[12 + place, 12 + place])
        assert getattr(contact.curve, name) == pytest.approx(value, rel=1e-6)
        assert float(getattr(counts, name)) == pytest.approx(value, rel=1e-6)
    for depth, speed, deepest in ((0.004, 0.9, 0.004), (0.03, -0.2, 0.05), (0.2, 0.5, 0.2)):
        value = features(depth, speed, deepest) @ [
            *expected[:12],
            counts.damping,
            counts.depth_damping,
            counts.unloading,
        ]
        assert contact.curve.force(depth, speed, deepest) == pytest.approx(value, rel=1e-6)
        seen = in_jax.force(counts, like + depth, like + speed, like + deepest)
        assert float(seen) == pytest.approx(value, rel=1e-6)
    assert contact.curve.force(-0.001, 1.0, 0.0) == 0
    assert float(in_jax.force(counts, like - 0.001, like + 1, like)) == 0


@pytest.mark.parametrize(
    ("slopes", "peak"),
    [
        (np.full(12, 400.0), 20.0),
        # 100 up to 32 ms, 500 beyond: the energy left at 32 ms is 1/2 - 0.0512.
        (np.where(np.array(KNOTS) < 0.032, 100.0, 500.0), math.sqrt(3.2**2 + 1000 * (0.5 - 0.0512))),
        # It pulls down to 10 ms, where it would be at -0.5, and stands at 1.9 at 16 ms.
        (LATE, math.sqrt(1.9**2 + 2 * 400 * (0.5 - 0.006 * 1.9 / 2))),
        # It pulls from 22 ms on, and never again pushes.
        (np.where(np.array(KNOTS) < 0.01, 1000.0, -900.0), 1.0),
        (np.full(12, -5.0), 1.0),
    ],
    ids=["linear", "two slopes", "pulls first", "pulls then", "only pulls"],
)
def test_predicted_peak_force(slopes, peak):
    assert curve_of(slopes).peak_force() == pytest.approx(peak, rel=1e-12)
    both = jnp.stack([jnp.asarray(slopes), jnp.full(12, 400.0)], axis=-1)
    np.testing.assert_allclose(in_jax.peak_force(both), [peak, 20.0], rtol=1e-12)


def test_derivative_of_the_predicted_peak_force_beyond_knots_that_pull():
    found = jax.grad(in_jax.peak_force)(jnp.asarray(LATE))
    each = 1e-4 * np.eye(12)
    steps = [curve_of(LATE + step).peak_force() - curve_of(LATE - step).peak_force() for step in each]
    np.testing.assert_allclose(found, np.array(steps) / 2e-4, rtol=1e-6, atol=1e-9)
    assert np.count_nonzero(found) == 9  # up to 62 ms


@pytest.mark.parametrize("ratio", [-30.0, -3.0, -0.5, 0.0, 0.3, 1.0, 2.5, 8.0])
def test_damping_that_counts_is_the_truncated_mean(ratio):
    density, share = stats.norm.pdf(ratio), stats.norm.cdf(ratio)
    expected = ratio + density / share if ratio > -20 else -1 / ratio
    assert positive_mean(0.4 * ratio, 0.16) == pytest.approx(0.4 * expected, rel=0.03)


@pytest.mark.parametrize(("damping", "first"), [(0.0, 0.2), (4.0, 0.2), (4.0, 0.9)])
def test_reference_of_a_known_map_is_the_exact_motion(damping, first):
    """Damped oscillation until its force is 0, however the ticks fall."""
    stiffness = 600.0
    curve = curve_of(np.full(12, stiffness), damping)
    decay = damping / 2
    rate = math.sqrt(stiffness - decay**2)
    ends = math.atan2(2 * decay * rate, 2 * decay**2 - stiffness) / rate
    leaves = math.exp(-decay * ends) * (math.cos(rate * ends) - decay / rate * math.sin(rate * ends))
    reference = ReferenceMotion(PERIOD)
    reference.restart(first * PERIOD)
    for tick in range(200):
        reference.tick(curve)
        time = (first + tick) * PERIOD
        if time < ends - PERIOD:
            exact = math.exp(-decay * time) * math.sin(rate * time) / rate
            assert reference.live.depth == pytest.approx(exact, abs=2e-3 / rate)
    assert reference.live.speed == pytest.approx(leaves, abs=2e-3)


def test_reference_loses_what_the_unloading_takes():
    """Unloading r times as steep as loading leaves the share 1/r of the energy: e = r^(-1/2)."""
    ratio, stiffness = 1.44, 600.0
    reference = ReferenceMotion(PERIOD)
    reference.restart(0.5 * PERIOD)
    curve = curve_of(np.full(12, stiffness), unloading=(ratio - 1) * stiffness)
    for _ in range(200):
        reference.tick(curve)
    assert reference.live.speed == pytest.approx(-1 / 1.2, abs=2e-3)


def test_replayed_force_makes_up_for_a_wrong_map():
    """With rho = 1 and all of the hardware's motion known, the reference is that motion, whatever the map."""
    wrong, rate = curve_of(np.full(12, 350.0)), 20.0
    last = math.floor(math.pi / rate / PERIOD)
    found = {}
    for replay in (0.0, 1.0):
        reference = ReferenceMotion(PERIOD)
        reference.replay = replay
        reference.restart(0.5 * PERIOD)
        time = (0.5 + np.arange(last)) * PERIOD
        impulse = (1 - np.cos(rate * time)) * rate / rate / PERIOD
        depths, speeds = np.sin(rate * time) / rate, np.cos(rate * time)
        samples = zip(impulse, time / PERIOD, depths, speeds, np.maximum.accumulate(depths), strict=True)
        for index, sample in enumerate(samples):
            reference.remember(index, *(float(value) for value in sample))
        for _ in range(last):
            reference.tick(wrong)
        found[replay] = abs(reference.live.depth - depths[-1]) * rate
    assert found[1.0] < 2e-3 and found[0.0] > 0.1


@pytest.mark.parametrize("shown", [True, False])
def test_what_a_dead_zone_hides_is_left_to_the_map(shown):
    """With rho = 1 and the true map, the way in, on which no force is read at first, does no harm; taken for
    no force, it does."""
    rate = 20.0
    right, last = curve_of(np.full(12, rate**2)), math.floor(math.pi / rate / PERIOD)
    time = (0.5 + np.arange(last)) * PERIOD
    forces, depths, speeds = rate * np.sin(rate * time), np.sin(rate * time) / rate, np.cos(rate * time)
    seen = (forces > 0.7 * rate) | (speeds < 0.0)
    intervals = np.append(0.0, seen[1:] & seen[:-1])
    impulse = np.cumsum(intervals * (forces + np.append(0.0, forces[:-1])) / 2)
    read = np.cumsum(intervals) if shown else time / PERIOD
    reference = ReferenceMotion(PERIOD)
    reference.replay = 1.0
    reference.restart(0.5 * PERIOD)
    for index, sample in enumerate(
        zip(impulse, read, depths, speeds, np.maximum.accumulate(depths), strict=True)
    ):
        reference.remember(index, *(float(value) for value in sample))
    for _ in range(last):
        reference.tick(right)
    error = abs(reference.live.speed - speeds[-1])
    assert error < 2e-3 if shown else error > 0.1


def test_both_sides_keep_as_much():
    assert HISTORY == reintegration.HISTORY


def quiet_case(stiffness, gains, damping=0.0):
    """A contact of the standard suites without noise."""
    raw = plain_mechanism(
        {"stiffness": [stiffness], "damping": [damping]},
        {"model": "second_order", "natural_frequency": 12.0, "damping_ratio": 0.8, "delay": 0.004},
        0.008,
        period=PERIOD,
    )
    return Case(raw, NAME, gains)


@pytest.mark.parametrize("stiffness", [4e4, 2.5e5])
def test_economical_reference_costs_little(monkeypatch, stiffness):
    """Against integrating the reference over again from the entry, sample by sample, at every tick."""
    case = quiet_case(stiffness, {})
    economical = run_oracle(case)[0]["restitution"]
    monkeypatch.setattr(reintegration, "STRIDE", 10**6)
    monkeypatch.setattr(reintegration, "COARSE", 0.0)
    plain = run_oracle(case)[0]["restitution"]
    print(stiffness, plain - 1, economical - 1)
    assert plain != economical
    assert abs(plain - 1) < 1.5e-3 and abs(economical - plain) < 5e-4


# What is set, what is left, root mean square and worst [%]; the published law, tuned to each suite, leaves 2
# to 6 rms.
SUITES = {
    "noisy": ("noisy", [], 0.5, 1.5),
    "damped": ("damped", [], 0.5, 1.5),
    "hertz": ("hertz", [], 0.6, 2.0),
    "elastoplastic": ("elastoplastic", [], 1.5, 5.0),
    "fast": ("fast", [], 1.5, 5.0),
    "dead zone": ("dead-zone", [], 2.5, 8.0),
    "dead zone, little noise": ("noisy", ["rig.force_sensor.dead_zone=12.0"], 0.8, 2.5),
    "surface 10 ms x v0 nearer": ("noisy", ["rig.contact_plane=-5e-5"], 0.8, 2.5),
}


SELDOM = ("hertz", "elastoplastic")  # each a program of its own


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=pytest.mark.slow if case in SELDOM else ()) for case in SUITES]
)
def test_errors_of_the_standard_suites(case):
    suite, changes, rms, worst = SUITES[case]
    mechanism = load(f"suite-{suite}", changes).mechanism
    scenario = join([build_scenarios(mechanism, draw(mechanism, 64, 3), 3)])
    loop = build_loop(mechanism, NAME, scenario)
    metrics = run_rollout(loop, as_arrays(nominal_gains(mechanism, NAME)), scenario)
    outcome = compare_with_reference(loop, scenario, metrics)
    assert np.all(np.asarray(outcome.good)[0])
    error = 100 * np.asarray(outcome.error)[0]
    print(case, np.sqrt(np.mean(error**2)), np.max(np.abs(error)))
    assert np.sqrt(np.mean(error**2)) < rms and np.max(np.abs(error)) < worst


def test_settings_are_gains_within_bounds_and_gentle_commands_less():
    mechanism = load("suite-layered").mechanism
    law = COMPENSATORS[NAME]
    assert list(law.settings) == ["sharp", "gentle"]
    assert literature_gains(mechanism, NAME, "sharp") == literature_gains(mechanism, NAME)
    peaks = {}
    scenario = join([build_scenarios(mechanism, draw(mechanism, 64, 3), 3)])
    loop = build_loop(mechanism, NAME, scenario)
    for name, chosen in law.settings.items():
        gains = literature_gains(mechanism, NAME, name)
        assert gains.items() >= chosen.items() and set(gains) == {gain.name for gain in law.gains}
        outcome = compare_with_reference(loop, scenario, run_rollout(loop, as_arrays(gains), scenario))
        peaks[name] = np.percentile(np.asarray(outcome.peak_ratio)[0], 99)
        assert np.sqrt(np.mean(np.asarray(outcome.error)[0] ** 2)) < 0.005
    assert peaks["gentle"] < 2.0 < peaks["sharp"] < 3.5
    # A slow rig gets no more than its period allows.
    slow = load("suite-layered", ["rig.control_period=0.008"]).mechanism
    assert literature_gains(slow, NAME, "gentle")["velocity_gain"] == pytest.approx(125.0)
    with pytest.raises(KeyError):
        literature_gains(mechanism, "phase_lead", "gentle")


@pytest.mark.slow
def test_derivatives_against_differences():
    """By every gain that tuning moves, of every scenario's restitution error."""
    mechanism = load("suite-damped").mechanism
    lanes = 8
    scenario = join([build_scenarios(mechanism, draw(mechanism, lanes, 3), 3)])
    loop = build_loop(mechanism, NAME, scenario)
    nominal = nominal_gains(mechanism, NAME)
    names = [gain.name for gain in COMPENSATORS[NAME].gains if gain.tuned(mechanism)]

    @jax.jit
    def errors(change):
        gains = {name: jnp.full(lanes, value) for name, value in nominal.items()}
        gains |= {name: gains[name] * jnp.exp(change[i]) for i, name in enumerate(names)}
        return compare_with_reference(loop, scenario, rollout(loop, gains, scenario)).error[0]

    nowhere, step = jnp.zeros((len(names), 1)), 1e-4
    slope = jax.jit(lambda towards: jax.jvp(errors, (nowhere,), (towards,))[1])
    for place, name in enumerate(names):
        towards = nowhere.at[place].set(1.0)
        exact = np.asarray(slope(towards))
        between = np.asarray(errors(step * towards) - errors(-step * towards)) / (2 * step)
        assert np.max(np.abs(exact)) > 1e-6, name
        # Where a decision falls within the step, the two have to part: not in more than one lane.
        apart = np.abs(exact - between) > 1e-4 * np.max(np.abs(between))
        assert np.sum(apart) <= 1, (name, exact, between)


def driven(gains, stiffness, lag=0.03, ticks=400, rate=25.0):
    """Statuses of a law on a contact that the hardware follows late; the law."""
    law = RetrospectiveReference(gains, PERIOD, math.inf)
    seen = []
    for tick in range(ticks):
        time = 0.001 * tick - 0.0203
        motion = [2e-4 * math.sin(rate * (time - late)) for late in (0.0, lag, lag + 0.008)]
        force = stiffness * max(motion[2], 0.0)
        law.step(force, motion[0], 8e-6 * rate * math.cos(rate * time) * 25, motion[1])
        seen.append(law.status)
    return seen, law


def test_status_says_what_stands_behind_the_command():
    values = nominal_gains(load("suite-noisy").mechanism, NAME)
    seen, law = driven(values, 2.5e5)
    assert seen[0] == OUT_OF_CONTACT and seen[25] == UNSURE
    assert {IDENTIFIED, SATURATED} & set(seen[65:140]) and OUT_OF_CONTACT in seen[160:]
    assert TOO_SHORT not in seen
    # A contact of 8 Hz, into which the hardware comes when half of it is over.
    seen, law = driven(values, 9e5, rate=50.0)
    assert TOO_SHORT in seen
    # A run that begins in contact: nothing to scale by, so that the measured force is passed on.
    law.reset()
    assert law.step(31.0, 1e-3, 0.0, 1e-3) == pytest.approx(31.0, rel=1e-15)
    assert law.status == UNSURE


def test_a_known_dead_zone_is_added_to_what_is_read():
    """The first reading that comes through counts for all of it, on either surface."""
    values = nominal_gains(load("suite-noisy").mechanism, NAME, dead_zone=12.0)
    law = RetrospectiveReference(values, PERIOD, 0.002)
    assert law.step(3.0, 1e-3, 0.0, 1e-3) == pytest.approx(15.0, rel=1e-15)
    law.reset()
    assert law.step(-3.0, -3e-3, 0.0, -3e-3) == pytest.approx(-15.0, rel=1e-15)
    law.reset()
    assert law.step(0.0, 1e-3, 0.0, 1e-3) == 0
