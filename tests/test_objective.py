"""Objectives: residuals compared with direct computation, derivatives, failures, noise amplification."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK, join
from noise_cases import amplification

from jaxhil.errors import InputError
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.loop import build_rig_constants
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.one_axis import ONE_AXIS, evaluate
from jaxhil.simulation.scenario import build_scenarios
from tuning.gains.contact_terms import FAILED_CONTACT_ERROR, compute_contact_terms
from tuning.gains.objective import (
    NORM_POWERS,
    OBJECTIVE_NAMES,
    RESIDUAL_SCALE,
    TOLERATED_ERROR_FACTOR,
    Objective,
    ObjectiveTerms,
    ObjectiveWeights,
    SolverProblem,
    compute_residuals,
    evaluate_objective,
    join_terms,
    weight_residuals,
)

NAMES = ("phase_lead", "lead_filter")
GAINS = np.array([[0.004, 0.001], [0.0077, 0.0031], [0.002, 0.0008]])
SCENARIOS = 6
SLOTS = 144
SHORT = 2  # index of the scenario whose time is too short for its contacts
STATED = Objective("rms", 2.0, 0.3, 0.004, 0.05, limit=1.0)


def of_name(name):
    return replace(STATED, name=name)


def build_batch(overrides=()):
    """Return (loop, scenarios, rigs); the scenario `SHORT` fails for all gains."""
    parsed = load("varying", overrides).mechanism
    scenarios = build_scenarios(parsed, draw(parsed, SCENARIOS, 5), 5)
    limit = np.where(np.arange(SCENARIOS) == SHORT, 0.05, scenarios.time_limit)
    scenarios = scenarios._replace(time_limit=limit)
    loop = build_loop(parsed, "phase_lead", scenarios)
    rig = jax.jit(build_rig_constants, static_argnums=0, compiler_options=QUICK)(loop, join([scenarios]))
    rigs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(GAINS), *leaf.shape)), rig)
    return loop, scenarios, rigs


@pytest.fixture(scope="module")
def batch():
    return build_batch()


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def with_jacobian(static, gains, problems):
    """Return residuals (problems, residuals) and derivatives for all gains (gain's problem, gain, ...)."""

    def along(direction):
        return jax.jvp(lambda gains: compute_residuals(static, gains, problems), (gains,), (direction,))

    basis = jnp.eye(gains.size).reshape(-1, *gains.shape)
    value, jacobian = jax.vmap(along, out_axes=(None, 0))(basis)
    return value, jacobian.reshape(*gains.shape, *value.shape)


def run(batch, gains=GAINS, objective=STATED):
    loop, _, rigs = batch
    objectives = [objective] * len(GAINS) if isinstance(objective, Objective) else objective
    problems = SolverProblem(rigs, {}, stacked(objectives))
    static = ONE_AXIS, loop, NAMES, join_terms(objectives)
    return [np.asarray(a) for a in with_jacobian(static, jnp.asarray(gains), problems)]


def stacked(objectives):
    """Stack the weights of problems."""
    return ObjectiveWeights(
        *(jnp.asarray(column) for column in zip(*(one.weights for one in objectives), strict=True))
    )


@pytest.fixture(scope="module")
def known_residuals(batch):
    return run(batch)


@pytest.fixture(scope="module")
def outcomes(batch):
    loop, scenarios, _ = batch
    loop = replace(loop, chatter=True)
    return [evaluate(loop, dict(zip(NAMES, gains, strict=True)), scenarios) for gains in GAINS]


def test_tuning_residuals_equal_errors_of_an_evaluation(outcomes, known_residuals):
    for gains, outcome, row in zip(GAINS, outcomes, known_residuals[0], strict=True):
        good, wanted = outcome.good, outcome.is_scheduled
        assert (wanted & ~good).sum() == 3 and not good[:, SHORT].any()
        count = wanted.sum()
        error = np.where(good, outcome.error, 3.0)
        error = np.where(wanted, np.where(error > 0, np.sqrt(2.0) * error, error), 0)
        excess = np.where(wanted, np.where(good, np.maximum(0, outcome.peak_ratio - 1), 3.0), 0)
        swings = np.where(wanted, np.where(good, outcome.chatter, 3.0), 0)
        assert all((term[good] > 1e-3).any() for term in (error, excess, swings))
        expected = np.concatenate(
            [
                error.ravel() / np.sqrt(count),
                0.3 * excess.ravel() / np.sqrt(count),
                0.05 * swings.ravel() / np.sqrt(count),
                [0.004 * (amplification(gains) - 1)],
            ]
        )
        np.testing.assert_allclose(RESIDUAL_SCALE * row, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("name", OBJECTIVE_NAMES)
def test_residual_sum_of_squares_is_never_below_but_close_to_objective(outcomes, name):
    objective = of_name(name)
    for gains, outcome in zip(GAINS, outcomes, strict=True):
        terms = compute_contact_terms(outcome)
        jax.tree.map(
            np.testing.assert_array_equal, terms, compute_contact_terms(jax.tree.map(jnp.asarray, outcome))
        )
        error, excess, swings = (np.asarray(term)[outcome.is_scheduled] for term in terms)
        noise = amplification(gains)
        value = evaluate_objective(objective, error, excess, noise, swings)
        ours = np.sqrt(sum_of_squares(objective, error, excess, noise, swings))
        if name == "rms":
            np.testing.assert_allclose(ours, value, rtol=1e-12)
        else:
            assert value < ours < 1.5 * value


def test_every_problem_of_a_batch_uses_its_own_objective_weights(batch):
    several = [STATED, replace(STATED, noise_weight=0.02, limit=0.7), Objective("rms", 5.0, 10.0, 0.1, 1.0)]
    together = run(batch, objective=several)[0]
    for i, objective in enumerate(several):
        np.testing.assert_allclose(together[i], run(batch, objective=objective)[0][i], rtol=1e-13)


def test_objective_terms_with_weight_zero_have_zero_residuals():
    errors, excesses, swings, noise = [0.1, -0.2], [0.3, 0.4], [0.5, 0.6], 3.0
    terms = *map(padded, (errors, excesses, swings)), np.arange(SLOTS) < 2, np.asarray(noise)
    none = *[padded([])] * 3, np.asarray(0.0)
    whole, _ = residuals(ObjectiveTerms("rms", True, True, True), stacked([Objective()]), terms, none)
    plain, _ = residuals(ObjectiveTerms("rms", False, False, False), stacked([Objective()]), terms, none)
    assert len(whole) == 3 * len(plain) + 1 and not whole[len(plain) :].any()
    np.testing.assert_array_equal(whole[: len(plain)], plain)


def test_objective_weights_are_scaled_by_the_error_limit():
    """A weight w of a metric X increases the error to at most sqrt(J_0^2 - X_0^2) = w limit X_0."""
    errors, excesses, swings = np.array([0.01, -0.02]), np.array([0.3, 0.5]), np.array([0.7, 0.1])
    for limit in (0.003, 0.01, 0.2):
        for name, value in (("command", excesses), ("chatter", swings), ("noise", np.array([2.5]))):
            objective = Objective(**{f"{name}_weight": 0.4}, limit=limit)
            whole = evaluate_objective(objective, errors, excesses, 3.5, swings)
            share = np.sqrt(whole**2 - evaluate_objective(Objective(), errors) ** 2)
            assert share == pytest.approx(0.4 * limit * np.sqrt(np.mean(value**2)), rel=1e-9)
            assert (
                float(getattr(objective.weights, name))
                == 0.4 * limit
                == 0.4 * objective.unit(f"{name}_weight")
            )
    assert Objective(transparency_weight=0.4, limit=0.2).unit("transparency_weight") == 1
    with pytest.raises(InputError, match="objective: limit: found 0"):
        Objective(limit=0.0)


@pytest.mark.parametrize("tolerance", [0.0, 0.004, 0.02, 1.0])
def test_errors_within_tolerance_hardly_affect_objective(tolerance):
    errors, excesses = np.random.default_rng(3).normal(scale=0.01, size=45), np.full(45, 0.4)
    objective = Objective("rms", 2.0, 0.2, 0.1, tolerance=tolerance)
    size = evaluate_objective(Objective("rms", 2.0), errors)
    counted = size if tolerance == 0 else max(size - tolerance, TOLERATED_ERROR_FACTOR * size)
    expected = np.sqrt(counted**2 + (0.01 * 0.2 * 0.4) ** 2 + (0.01 * 0.1 * 2.0) ** 2)
    assert evaluate_objective(objective, errors, excesses, 3.0) == pytest.approx(expected, rel=1e-13)
    assert sum_of_squares(objective, errors, excesses, 3.0) == pytest.approx(expected**2, rel=1e-12)
    # The rms is homogeneous, so its derivative in the direction of the errors equals the rms (Euler).
    _, slopes = single_residuals(objective, errors, excesses, 3.0, (), (errors, (), (), 0.0))
    values, _ = single_residuals(objective, errors, excesses, 3.0)
    grown = counted if counted <= TOLERATED_ERROR_FACTOR * size or tolerance == 0 else size
    assert RESIDUAL_SCALE**2 * np.sum(values * slopes) == pytest.approx(counted * grown, rel=1e-12)


def test_error_tolerance_of_zero_does_not_change_objective_in_shared_program():
    terms = join_terms([Objective(tolerance=0.0)])
    assert terms == join_terms([Objective(command_weight=0.1, noise_weight=0.2, tolerance=0.5)])
    assert terms == ObjectiveTerms("rms", True, True, False, tolerance=True)
    errors = np.random.default_rng(4).normal(size=45)
    values, _ = single_residuals(Objective(tolerance=0.0), errors, np.ones(45), 7.0)
    plain, _ = single_residuals(Objective(), errors)
    np.testing.assert_array_equal(values[: len(plain)], plain)
    assert not values[len(plain) :].any()


def test_common_objective_terms_are_union_of_terms_of_all_objectives():
    assert join_terms([Objective(), Objective(noise_weight=0.1)]) == ObjectiveTerms(
        "rms", False, True, False, False
    )
    assert join_terms([Objective("cvar", 2.0, 0.1)]) == ObjectiveTerms("cvar", True, False, False, False)
    assert join_terms([Objective(chatter_weight=0.1), Objective()]) == ObjectiveTerms(
        "rms", False, False, True, False
    )
    assert join_terms([Objective()], probed=True) == ObjectiveTerms("rms", False, False, False, True)
    with pytest.raises(ValueError):
        join_terms([Objective("rms"), Objective("cvar")])


def check_differences(batch, jacobian):
    """Compare derivatives (problem, gain, residual) with central differences."""
    jacobian_diagonal = np.stack([jacobian[i, :, i] for i in range(len(GAINS))])
    for gain in range(len(NAMES)):
        step = 1e-6 * GAINS[:, gain]
        up, down = GAINS.copy(), GAINS.copy()
        up[:, gain] += step
        down[:, gain] -= step
        difference = (run(batch, up)[0] - run(batch, down)[0]) / (2 * step[:, None])
        scale = np.abs(jacobian_diagonal[:, gain]).max()
        np.testing.assert_allclose(jacobian_diagonal[:, gain], difference, rtol=1e-5, atol=1e-7 * scale)
    return jacobian_diagonal


def test_objective_derivatives_match_central_differences(batch, known_residuals):
    jacobian_diagonal = check_differences(batch, known_residuals[1])
    parts = *np.split(jacobian_diagonal[..., :-1], 3, axis=-1), jacobian_diagonal[..., -1:]
    assert all((np.abs(part).max(axis=2) > 0).all() for part in parts)


def test_sensor_noise_in_objective_is_the_same_for_all_gains(known_residuals):
    """Every call uses the same noise, so that the residuals are differentiable functions of the gains."""
    noisy = build_batch(["rig.force_sensor.noise_std=2.667", "rig.position_sensor.noise_std=1e-6"])
    value, jacobian = run(noisy)
    assert np.all(np.max(np.abs(value - known_residuals[0]), axis=1) > 0.3)
    np.testing.assert_array_equal(run(noisy)[0], value)
    check_differences(noisy, jacobian)


def test_tuning_problems_in_one_program_do_not_affect_each_other(batch, known_residuals):
    value, jacobian = known_residuals
    for mine in range(len(GAINS)):
        others = np.arange(len(GAINS)) != mine
        assert not jacobian[mine][:, others].any()
    moved = GAINS.copy()
    moved[1] *= 1.3
    changed = run(batch, moved)[0] != value
    assert changed[1].any() and not changed[[0, 2]].any()


def test_failed_contacts_increase_objective_with_zero_derivative(batch, known_residuals):
    value, jacobian = known_residuals
    slots = np.reshape(value[:, :-1], (len(GAINS), 3, -1, SCENARIOS))
    slopes = np.reshape(jacobian[..., :-1], (*GAINS.shape, len(GAINS), 3, -1, SCENARIOS))
    contacts = SCENARIOS * 3
    failed = FAILED_CONTACT_ERROR / (RESIDUAL_SCALE * np.sqrt(contacts)) * np.array([np.sqrt(2.0), 0.3, 0.05])
    np.testing.assert_allclose(
        slots[:, :, :3, SHORT], np.broadcast_to(failed[None, :, None], (len(GAINS), 3, 3)), rtol=1e-14
    )
    assert np.isfinite(jacobian).all()
    assert not slopes[..., SHORT].any()


@partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def residuals(static, weights, terms, tangents):
    """Return residuals and derivative of one problem from its errors, excesses, variation and noise."""
    *contacts, wanted, noise = terms

    def value(error, excess, chatter, noise):
        several = (term[None] for term in (error, excess, chatter, wanted, noise))
        return weight_residuals(static, weights, *several)[0]

    return jax.jvp(value, (*contacts, noise), tangents)


def padded(contacts):
    return np.pad(np.asarray(contacts, float), (0, SLOTS - len(contacts)))


def single_residuals(objective, errors, excesses=(), noise=1.0, chatter=(), tangents=((), (), (), 0.0)):
    """Return residuals and derivative of one problem with these contacts in more slots than needed."""
    wanted = np.arange(SLOTS) < len(errors)
    terms = padded(errors), padded(excesses), padded(chatter), wanted, np.asarray(noise)
    tangents = *map(padded, tangents[:-1]), np.asarray(tangents[-1])
    static = join_terms([objective])
    return tuple(map(np.asarray, residuals(static, stacked([objective]), terms, tangents)))


def sum_of_squares(*arguments):
    return RESIDUAL_SCALE**2 * np.sum(single_residuals(*arguments)[0] ** 2)


@pytest.mark.parametrize("number, tail", [(1, 1), (19, 1), (20, 1), (21, 2), (40, 2), (41, 3), (140, 7)])
def test_cvar_objective_is_mean_of_worst_5_percent(number, tail):
    errors = np.random.default_rng(number).permutation(np.arange(1, number + 1)) / number
    errors[::2] *= -1
    expected = np.mean(np.arange(number - tail + 1, number + 1)) / number
    assert evaluate_objective(Objective("cvar"), errors) == pytest.approx(expected, rel=1e-14)
    # The solver minimises an upper bound: the root of the mean of powers.
    bound = (np.sum(np.abs(errors) ** NORM_POWERS["cvar"]) / tail) ** (1 / NORM_POWERS["cvar"])
    np.testing.assert_allclose(sum_of_squares(Objective("cvar"), errors), bound**2, rtol=1e-13)
    assert expected <= bound


def test_error_metrics_of_known_errors_are_exact():
    errors = np.array([0.03, -0.04, *[0.0] * 18])
    assert evaluate_objective(Objective("rms"), errors) == pytest.approx(0.05 / np.sqrt(20), rel=1e-14)
    assert (
        evaluate_objective(Objective("cvar"), errors)
        == evaluate_objective(Objective("worst"), errors)
        == 0.04
    )
    # With twice the weight on divergence, this error is the worst.
    for name in ("cvar", "worst"):
        assert evaluate_objective(Objective(name, 2.0), errors) == pytest.approx(np.sqrt(2) * 0.03, rel=1e-14)
    assert evaluate_objective(Objective("worst"), np.array([0.1, np.nan])) == FAILED_CONTACT_ERROR
    stated = Objective("worst", 1.0, 0.1, 0.01, limit=1.0)
    excesses = np.array([0.1, 0.3])
    whole = np.sqrt(0.04**2 + 0.01 * (0.01 + 0.09) / 2 + 0.01**2 * 9)
    assert evaluate_objective(stated, errors, excesses, 4.0) == pytest.approx(whole, rel=1e-14)
    swings = evaluate_objective(
        replace(stated, chatter_weight=0.02), errors, excesses, 4.0, np.array([3.0, 1.0])
    )
    assert swings == pytest.approx(np.sqrt(whole**2 + 0.02**2 * 5), rel=1e-14)
    # A noise amplification below 1 gives no benefit.
    assert evaluate_objective(stated, errors, None, 0.5) == 0.04
    assert single_residuals(stated, errors, (), 0.5)[0][-1] == 0


def test_high_order_norm_approximates_the_worst_error():
    errors = np.random.default_rng(0).normal(size=96)
    norm = np.sum(np.abs(errors) ** NORM_POWERS["worst"]) ** (1 / NORM_POWERS["worst"])
    assert np.abs(errors).max() < norm < 1.3 * np.abs(errors).max()
    np.testing.assert_allclose(sum_of_squares(Objective("worst"), errors), norm**2, rtol=1e-13)
    # Neither very large errors nor tiny ones overflow or underflow.
    for size in (1e100, 1e-100):
        value = RESIDUAL_SCALE * single_residuals(Objective("worst"), size * errors)[0]
        np.testing.assert_allclose(np.sqrt(np.sum((value / size) ** 2)), norm, rtol=1e-13)


@pytest.mark.parametrize("name", OBJECTIVE_NAMES)
def test_objective_derivatives_with_respect_to_errors_are_exact(name):
    objective, generator = Objective(name, 3.0, 0.2, 0.01, 0.03), np.random.default_rng(1)
    errors, excesses = generator.normal(size=45), np.maximum(0, generator.normal(size=45))
    terms = errors, excesses, 2.0, generator.uniform(0, 3, 45)

    for _ in range(3):
        way = generator.normal(size=45), np.where(excesses > 0, generator.normal(size=45), 0), 1.0
        way = *way, generator.normal(size=45)
        _, slope = single_residuals(objective, *terms, (way[0], way[1], way[3], way[2]))
        up, down = (
            single_residuals(objective, *(term + h * along for term, along in zip(terms, way, strict=True)))[
                0
            ]
            for h in (1e-6, -1e-6)
        )
        np.testing.assert_allclose(slope, (up - down) / 2e-6, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", OBJECTIVE_NAMES)
def test_objective_without_any_error_has_a_finite_derivative(name):
    objective = Objective(name, 3.0, 0.2, 0.01, 0.03)
    for largest in (0.0, 0.1):
        errors = np.where(np.arange(30) == 7, largest, 0)
        ones, zeros = np.ones((3, 30)), np.zeros(30)
        value, slope = single_residuals(objective, errors, zeros, 1.0, zeros, (*ones, 1.0))
        assert np.isfinite(slope).all()
        assert value.any() == (largest > 0)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"name": "mean"}, "objective: found 'mean', expected rms, cvar, worst"),
        ({"divergence_weight": 0.0}, "objective: divergence_weight: found 0.0, expected a finite number > 0"),
        ({"noise_weight": -1.0}, "objective: noise_weight: found -1.0, expected a finite number >= 0"),
        ({"chatter_weight": -0.1}, "objective: chatter_weight: found -0.1, expected a finite number >= 0"),
        ({"command_weight": np.inf}, "objective: command_weight: found inf, expected a finite number >= 0"),
    ],
)
def test_unknown_objective_is_rejected(values, message):
    with pytest.raises(InputError) as refused:
        Objective(**values)
    assert str(refused.value) == message
