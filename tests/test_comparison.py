"""Metrics of a comparison for compensators whose transparency is known."""

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from continuous import delayed_restitution
from jaxtyping import Array
from lanes import IDEAL, QUICK, mechanism, validated

from jaxhil.contact.laws import CONTACT_LAWS
from jaxhil.laws import compensators
from jaxhil.laws.simulation_base import Compensator, Gain
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.benchmark.runs import build_scenario_set
from tuning.gains.common_program import group_by_common_program
from tuning.transparency.damping_perturbations import MAX_DAMPING_RATIO, perturb_damping
from tuning.transparency.metrics import (
    BEST_AT_ONE,
    IntervalEstimate,
    bootstrap_metric,
    compute_distance_from_best,
    estimate_share,
    find_winner,
    fit_slope,
    fit_transmission,
)

LIMIT, SEED, LANES = 0.01, 3, 16
SPREAD = {"contact.stiffness": {"distribution": "loguniform", "factor": [0.5, 2.0]}}


def evaluate_compensator(raw, law, gains=None, number=LANES):
    parsed = validated({**raw, "uncertainty": SPREAD})
    [(_, form)] = group_by_common_program([parsed])
    scene = build_scenario_set(parsed, form, number, SEED)
    return scene.evaluate(law, gains or {}, LIMIT, SEED)


@pytest.mark.slow
def test_ideal_rig_has_zero_error_and_full_transparency():
    """Expect error 0, and transparency, slope and peak ratio 1, without delay and for a small period."""
    figures = evaluate_compensator(mechanism({}, IDEAL, 0.0, period=5e-5), "none")
    assert figures["rms"].value < 1e-3 and figures["worst"].value < 1e-3
    for name in ("early", "late", "slope", "peak"):
        assert figures[name].value == pytest.approx(1, abs=1e-3), name
    assert figures["trajectory"].value < 1e-3
    assert figures["failures"].value == 0 and figures["noise"].value == 1


class PlayedBack(Compensator):
    """Compensator that returns the undelayed contact force at the model's penetration."""

    name: ClassVar[str] = "played_back"
    knows: ClassVar[tuple[str, ...]] = ()
    gains: ClassVar[tuple[Gain, ...]] = ()

    def init(self, gains, constants, ring):
        return ()

    def restart(self, gains, state, begins, fresh):
        return ()

    def step(self, prepared, state, signals, tick):
        depth, rate = signals.position_desired, signals.velocity_desired
        force = prepared["stiffness"] * depth + prepared["damping"] * rate
        return jnp.where((depth > 0) & (force > 0), force, 0), state


class Known(NamedTuple):
    """True mechanism parameters of every lane, unknown to real compensators."""

    stiffness: Array
    damping: Array


@pytest.mark.slow
def test_compensator_that_replays_ideal_contact_has_zero_transparency(monkeypatch):
    monkeypatch.setitem(compensators.COMPENSATORS, "played_back", PlayedBack())

    def evaluate_with_plant(loop, gains, scenarios):
        contact = scenarios.contact
        stiffness = contact.stiffness[0].reshape(-1, contact.damping.shape[-1])[0]
        plant_values = Known(stiffness, contact.damping[0])
        return evaluate(loop, plant_values._asdict(), scenarios)

    monkeypatch.setattr("tuning.benchmark.runs.evaluate", evaluate_with_plant)
    figures = evaluate_compensator(mechanism({}, period=2.5e-4), "played_back")
    assert figures["rms"].value < 1e-3
    assert figures["slope"].value == pytest.approx(1, abs=1e-3)
    assert abs(figures["early"].value) < 1e-6 and abs(figures["late"].value) < 1e-6


def test_error_of_uncompensated_delay_matches_closed_form():
    """For a pure force delay and an ideal simulator, e = |S'(t_s + tau)| (model.md, section 6)."""
    tau = 0.004
    raw = mechanism({}, IDEAL, tau, period=2.5e-4)
    parsed = validated({**raw, "uncertainty": SPREAD})
    stiffness = draw(parsed, LANES, SEED)["contact.stiffness"][:, 0]
    omega = np.sqrt(stiffness / parsed.bodies.mass)
    expected = np.array([delayed_restitution(value * tau) for value in omega]) - 1
    figures = evaluate_compensator(raw, "none")
    assert figures["rms"].value == pytest.approx(np.sqrt(np.mean(expected**2)), abs=2e-3)
    assert figures["worst"].value == pytest.approx(np.max(expected), abs=2e-3)
    # Delay makes the loop more sensitive to disturbances than the contact itself.
    assert figures["early"].value > 1 and figures["late"].value > 1


@pytest.mark.parametrize(
    "name",
    [
        *("suite-damped", "suite-depth-damped", "suite-elastoplastic", "suite-repeated"),
        pytest.param("suite-hertz", marks=pytest.mark.slow),
    ],
)
def test_damping_perturbations_reduce_rebound_speed_by_up_to_a_third(name):
    parsed = load(name).mechanism
    draws = draw(parsed, 24, 0)
    twin, twin_draws = perturb_damping(parsed, draws)
    lossy = []
    for member, values in ((parsed, draws), (twin, twin_draws)):
        batch = build_scenarios(member, values)
        assert build_loop(member, "none", batch).law == CONTACT_LAWS[member.contact.law]
        contact = type(batch.contact)(
            *(jnp.asarray(leaf)[0] if leaf is not None else None for leaf in batch.contact)
        )
        mass, velocity = jnp.asarray(batch.equivalent_mass), jnp.asarray(batch.velocity)
        of_law = jax.jit(CONTACT_LAWS[member.contact.law].ideal_contact, compiler_options=QUICK)
        lossy.append(np.asarray(of_law(contact, mass, velocity).restitution))
    before, after = lossy
    lost = 1 - after / before
    assert np.all(lost >= -1e-9) and np.min(lost) < 0.02
    assert 0.2 < np.max(lost) < 1.3 * (1 - np.exp(-np.pi * MAX_DAMPING_RATIO))


def test_transparency_and_slope_are_least_squares_estimates():
    true = np.array([0.01, -0.02, 0.03])
    assert fit_transmission(0.4 * true, true) == pytest.approx(0.4)
    reference = np.array([0.5, 0.7, 0.9])
    assert fit_slope(0.2 + 0.8 * reference, reference) == pytest.approx(0.8)


def test_comparison_intervals_have_stated_coverage():
    rng = np.random.default_rng(0)
    hits, every = 0, np.ones((1, 60), bool)
    for seed in range(200):
        sample = rng.normal(1.0, 1.0, 60)
        result = bootstrap_metric(lambda values: np.mean(values, axis=-1), seed, every, sample[None])
        hits += result.low <= 1.0 <= result.high
    # Binomial(200, 0.95) is below 181 with probability 0.3 %.
    assert 181 <= hits <= 200
    none = estimate_share(np.zeros(100, bool))
    assert none.value == 0 and none.low == 0 and none.high == pytest.approx(1 - 0.025 ** (1 / 100))


def test_best_compensator_is_marked_only_if_intervals_are_disjoint():
    figures = {
        "a": IntervalEstimate(0.1, 0.09, 0.11),
        "b": IntervalEstimate(0.2, 0.12, 0.3),
        "c": IntervalEstimate(0.15, 0.105, 0.2),
    }
    assert find_winner("rms", figures) is None
    assert find_winner("rms", {name: figures[name] for name in "ab"}) == "a"
    assert find_winner("rms", {"a": figures["a"]}) is None
    # A compensator with unfinished contacts has no interval; it is ignored in the ranking.
    assert (
        find_winner(
            "rms", {"a": figures["a"], "b": figures["b"], "d": IntervalEstimate(0.01, np.nan, np.nan)}
        )
        == "a"
    )


def test_transparency_metrics_are_ranked_by_distance_from_1():
    assert set(BEST_AT_ONE) == {"early", "late", "slope"}
    assert compute_distance_from_best("early", IntervalEstimate(0.7, 0.6, 0.8)) == pytest.approx(
        (0.3, 0.2, 0.4)
    )
    assert compute_distance_from_best("slope", IntervalEstimate(1.1, 0.9, 1.3)) == pytest.approx(
        (0.1, 0.0, 0.3)
    )
    assert compute_distance_from_best("rms", IntervalEstimate(0.7, 0.6, 0.8)) == (0.7, 0.6, 0.8)


def test_comparison_resamples_scenarios_with_all_their_contacts():
    """Four equal contacts have the information of one; failed contacts are ignored."""
    sample = np.random.default_rng(0).normal(1.0, 1.0, 40)
    good = np.ones((4, 40), bool)

    def mean(values):
        return np.nanmean(values, axis=-1)

    once = bootstrap_metric(mean, 0, good[:1], sample[None])
    assert bootstrap_metric(mean, 0, good, np.tile(sample, (4, 1))) == pytest.approx(once, rel=1e-12)
    good[1:] = False
    assert bootstrap_metric(mean, 0, good, np.tile(1e3 * sample, (4, 1)) * [[1e-3], [1], [1], [1]]) == once
