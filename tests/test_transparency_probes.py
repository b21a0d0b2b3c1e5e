"""Transparency in tuning: copies of scenarios with a push or additional damping, their e* and weights."""

import dataclasses

import jax
import numpy as np
import pytest
from lanes import IDEAL, mechanism, validated
from scipy.integrate import solve_ivp

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import evaluate
from tuning.gains import pareto_search
from tuning.gains.contact_terms import compute_contact_terms
from tuning.gains.multistart_solver import solve_tasks
from tuning.gains.objective import Objective, evaluate_objective
from tuning.gains.pareto import compute_fronts
from tuning.gains.pareto_search import PEAK_CRITERION, TRANSPARENCY_CRITERION, choose_default_criterion
from tuning.gains.settings import TuneSettings
from tuning.gains.tasks import build_task
from tuning.gains.tune_all import tune
from tuning.gains.validation import build_validation
from tuning.transparency.probes import (
    LANES_PER_SCENARIO,
    build_probed_scenarios,
    choose_default_weights,
    compute_probe_metrics,
    mask_probes,
)
from tuning.transparency.pushes import PUSH_DURATION, PUSH_SIZE

DAMPED = load("varying", ["contact.stiffness=[1e5]", "approach.contacts=1"]).mechanism
WEIGHED = Objective(command_weight=0.02, transparency_weight=0.7)
SMALL = TuneSettings(scenarios=4, starts=2, steps=4, validation=15, objective=WEIGHED, polish=0, scanned=8)


def lanes_of_kind(scenarios, number):
    """Return one lane of each scenario: 0 plain, 1 early push, 2 late push, 3 damping perturbation."""
    return jax.tree.map(lambda leaf: np.asarray(leaf)[..., number::LANES_PER_SCENARIO], scenarios)


@pytest.mark.slow
def test_contact_with_probe_push_has_restitution_of_pushed_ideal_contact():
    probed = build_probed_scenarios(DAMPED, draw(DAMPED, 3, 0))
    for number, expected in ((1, probed.early), (2, probed.late)):
        scenarios = lanes_of_kind(probed.scenarios, number)
        assert (scenarios.contacts == 1).all()
        for lane in range(3):
            stiffness, damping = scenarios.contact.stiffness[0, lane], scenarios.contact.damping[0, lane]
            mass, velocity = scenarios.equivalent_mass[lane], scenarios.velocity[lane]
            size, centre = scenarios.probe.push.size[0, lane], scenarios.probe.push.centre[0, lane]
            assert size == pytest.approx(PUSH_SIZE * scenarios.reference.peak_force[0, lane])

            def motion(t, y, k=stiffness, b=damping, m=mass, size=size, begin=centre - PUSH_DURATION / 2):
                inside = 0 < t - begin < PUSH_DURATION
                push = size * np.sin(np.pi * (t - begin) / PUSH_DURATION) if inside else 0.0
                return [y[1], -(max(0.0, k * y[0] + b * y[1]) * (y[0] > 0) + push) / m]

            tight = {"method": "DOP853", "rtol": 1e-9, "atol": 1e-13, "max_step": 1e-3}
            end = solve_ivp(motion, (0, 0.5), [0, velocity], **tight).y[1, -1]
            assert expected[lane] == pytest.approx(-end / velocity, abs=2e-5)
            assert scenarios.reference.restitution[0, lane] == expected[lane]
            # The push distinguishes compensators that react to it from others.
            assert abs(expected[lane] - probed.plain[lane]) > 0.01


@pytest.mark.slow
def test_transparency_probes_have_zero_error_on_an_ideal_rig():
    spread = {"contact.stiffness": {"distribution": "loguniform", "factor": [0.5, 2.0]}}
    made = validated({**mechanism({}, IDEAL, 0.0, period=5e-5), "uncertainty": spread})
    probed = build_probed_scenarios(made, draw(made, 16, 0))
    outcome = evaluate(build_loop(made, "none", probed.scenarios), {}, probed.scenarios)
    assert outcome.good[0].all() and np.max(np.abs(outcome.error[0])) < 1e-3
    copies = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], -1, LANES_PER_SCENARIO), outcome)
    figures = compute_probe_metrics(probed, copies)
    assert list(figures) == ["early", "late", "slope", "peak"]
    assert [one.value for one in figures.values()] == pytest.approx([1] * 4, abs=2e-3)


def test_first_lanes_of_a_batch_contain_every_kind_of_probe():
    assert list(mask_probes(8)) == [False, True, True, True] * 2
    probed = build_probed_scenarios(DAMPED, draw(DAMPED, 5, 1)).scenarios
    damping = np.asarray(probed.contact.damping)[0]
    assert (damping[3::LANES_PER_SCENARIO] >= damping[::LANES_PER_SCENARIO]).all() and (
        damping[3:] > damping[:-3]
    ).any()
    np.testing.assert_array_equal(damping[1::LANES_PER_SCENARIO], damping[::LANES_PER_SCENARIO])
    pushed = probed.probe.push.size[0] > 0
    np.testing.assert_array_equal(pushed, np.arange(20) % LANES_PER_SCENARIO % 3 > 0)


def test_only_compensators_that_predict_contacts_are_probed_by_default():
    weighed = [name for name in COMPENSATORS if choose_default_weights(name)]
    assert (
        weighed
        == ["impulse_ledger"]
        == [n for n in COMPENSATORS if choose_default_criterion(n) == PEAK_CRITERION]
    )
    assert Objective(**choose_default_weights(weighed[0])).transparency_weight > 0


@pytest.fixture(scope="module")
def task():
    return build_task(DAMPED, "phase_lead", 4, 0, probed=True)


def of_training(task, gains):
    """Return restitution errors of scenarios and copies, and all peak excesses, in training."""
    outcome = evaluate(task.loop, gains, task.scenarios)
    assert outcome.good[outcome.is_scheduled].all()
    error, excess, _ = (np.asarray(term)[0] for term in compute_contact_terms(outcome))
    copies = mask_probes(len(error))
    return error[~copies], error[copies], excess


@pytest.mark.slow
def test_solver_and_search_minimise_the_stated_objective(task):
    assert task.number == 4 and len(task.scenarios.velocity) == 4 * LANES_PER_SCENARIO
    validation = build_validation([task], 3, 0)
    points = np.array([[0.3, 0.4], [0.6, 0.2]])[:, : len(validation.names)]
    (starts,) = solve_tasks([task], [points], 1, WEIGHED)
    for point, start, loss in zip(
        points, starts, validation.losses(WEIGHED, [0], points[None])[0], strict=True
    ):
        error, of_probes, excess = of_training(task, validation.gains(0, point))
        stated = np.sqrt(np.mean(error**2) + 0.7**2 * np.mean(of_probes**2) + 0.02**2 * np.mean(excess**2))
        assert loss == pytest.approx(stated, rel=1e-9)
        assert evaluate_objective(WEIGHED, error, excess, probe_errors=of_probes) == pytest.approx(
            stated, rel=1e-12
        )
        assert start.history[0] <= stated * (1 + 1e-9)
        ended = of_training(task, start.gains)
        value = evaluate_objective(WEIGHED, ended[0], ended[2], probe_errors=ended[1])
        assert start.rms >= value * (1 - 1e-9)


def test_scenarios_of_a_common_program_cannot_be_probed():
    with pytest.raises(ValueError):
        build_task(DAMPED, "phase_lead", 4, 0, common=object(), probed=True)  # pyright: ignore


@pytest.fixture(scope="module")
def result():
    return tune(DAMPED, "phase_lead", SMALL)


@pytest.mark.slow
def test_transparency_is_evaluated_for_literature_and_tuned_gains(result):
    assert list(result.transparency) == ["before", "literature", "tuned"]
    for key, metrics in result.transparency.items():
        peaks = result.outcomes[key].peak_ratio[result.outcomes[key].good]
        assert metrics["peak"].value == pytest.approx(np.percentile(peaks, 99), rel=1e-12)
        assert metrics["peak"].low <= metrics["peak"].value <= metrics["peak"].high
    assert len(result.scenarios.velocity) == SMALL.validation == result.outcomes["tuned"].error.shape[-1]
    assert result.nominal["tuned"] != result.figures["tuned"]


def test_scenarios_without_transparency_weight_are_not_probed():
    plain = dataclasses.replace(SMALL, objective=Objective())
    assert not plain.probed and dataclasses.replace(plain, evaluate_transparency=True).probed
    assert len(build_task(DAMPED, "phase_lead", 4, 0).scenarios.velocity) == 4


@pytest.mark.slow
@pytest.mark.parametrize("axis", [PEAK_CRITERION, TRANSPARENCY_CRITERION])
def test_objective_weights_trade_error_against_peak_force_or_transparency(result, axis):
    ((_, front),) = compute_fronts([result], 2, axis=axis)
    assert front.axis == axis and front.points[0].weight == 0 < front.points[1].weight
    for point in (*front.points, front.tuned):
        assert point.transparency is not None
        if axis == PEAK_CRITERION:
            assert point.cost == pytest.approx(point.transparency["peak"].value, rel=1e-12)
    assert front.tuned.transparency == result.transparency["tuned"]
    # On the training scenarios, a larger weight does not increase the weighted metric.
    task = build_task(DAMPED, "phase_lead", SMALL.scenarios, SMALL.seed, probed=True)
    validation = build_validation([task], 3, 0)
    starts = [pareto_search.StartResult("made up", 1, 1.0, [1.0], point.gains) for point in front.points]
    light, heavy = pareto_search._collect_candidates(validation, 0, axis, WEIGHED, 0.0, starts)
    assert heavy.excess <= light.excess * (1 + 1e-6) and light.error <= heavy.error * (1 + 1e-6)
    _, of_probes, excess = of_training(task, front.points[1].gains)
    traded = excess if axis == PEAK_CRITERION else of_probes
    assert heavy.excess == pytest.approx(np.sqrt(np.mean(traded**2)), rel=1e-6)
