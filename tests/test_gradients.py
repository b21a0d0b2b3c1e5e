"""Forward-mode derivatives of the restitution compared with central differences, scenario by scenario.

For 200 random scenarios of the built-in `varying` mechanism with random gains, the first contact's
restitution is differentiated with respect to every gain of response_error, both delays, stiffness and
damping. The loop is piecewise smooth: if a discrete event moves to another tick within the step of the
difference, derivative and difference may disagree, and the event is reported. The restitution is also a
smooth function of the identification delay, because the compensator's gates are differentiable.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lanes import QUICK, join, run_record

from jaxhil.laws.compensators import COMPENSATORS
from jaxhil.mechanism.file import load
from jaxhil.mechanism.uncertainty import draw
from jaxhil.rig.filters import DelayLine
from jaxhil.simulation.loop_construction import build_loop
from jaxhil.simulation.metrics import OK
from jaxhil.simulation.rollout import rollout
from jaxhil.simulation.scenario import build_scenarios

SCENARIOS = 200
SPARE = 16  # spare scenarios, to replace those whose contact ends late or never
LONGEST = 480  # ticks
GAINS = COMPENSATORS["response_error"].gains
PHYSICAL = ("force_delay", "simulator_delay", "stiffness", "damping")
NAMES = (*(gain.name for gain in GAINS), *PHYSICAL)
OFFSETS = np.array([-2.0, -1.0, 1.0, 2.0])
WEIGHTS = np.array([1.0, -8.0, 8.0, -1.0]) / 12  # weights of central differences of fourth order
STEPS = (1e-6, 1e-5)  # steps relative to the scale of each parameter
AGREEING = 48  # recorded (parameter, scenario) pairs that agree

MECHANISM = load("varying").mechanism
PERIOD = MECHANISM.rig.control_period


def random_gains(number):
    """Draw gains within bounds, some log-uniform; the threshold up to ten times its nominal value."""
    generator = np.random.default_rng(3)
    gains = {}
    for gain in GAINS:
        low, high = gain.lower(MECHANISM), gain.upper(MECHANISM)
        uniform = generator.uniform(0, 1, number)
        if gain.name == "contact_threshold":
            high = 10 * gain.nominal(MECHANISM)
        gains[gain.name] = low * (high / low) ** uniform if gain.logarithmic else low + (high - low) * uniform
    return gains


def scales(values):
    """Return the scale of each parameter's step by name: a gain's range, or the value itself."""
    ranges = {g.name: g.upper(MECHANISM) - g.lower(MECHANISM) for g in GAINS if not g.logarithmic}
    return {name: np.full(SCENARIOS, ranges[name]) if name in ranges else values[name] for name in NAMES}


def problem(scenario, values):
    """Return (gains, scenario) with the given parameter values."""
    table = scenario.contact.stiffness.shape
    contact = scenario.contact._replace(
        stiffness=jnp.broadcast_to(values["stiffness"], table),
        damping=jnp.broadcast_to(values["damping"], table),
    )
    return {gain.name: values[gain.name] for gain in GAINS}, scenario._replace(
        contact=contact,
        force_sensor=scenario.force_sensor._replace(delay=values["force_delay"]),
        simulator=scenario.simulator._replace(delay=values["simulator_delay"]),
    )


def restitution(loop, scenario, values):
    metrics = rollout(loop, *problem(scenario, values))
    return metrics.restitution[0], jnp.where(metrics.status[0] == OK, metrics.ticks[0], 1_000_000)


evaluate = jax.jit(restitution, static_argnums=0, compiler_options=QUICK)


@functools.partial(jax.jit, static_argnums=0, compiler_options=QUICK)
def derivatives(loop, scenario, values):
    """Return the derivatives, (parameters, scenarios)."""

    def along(index):
        tangents = {
            name: jnp.full_like(value, 1) * (index == i).astype(value.dtype)
            for i, (name, value) in enumerate((name, values[name]) for name in NAMES)
        }
        return jax.jvp(lambda v: restitution(loop, scenario, v)[0], (values,), (tangents,))[1]

    return jax.vmap(along)(jnp.arange(len(NAMES)))


def chosen(scenario, lanes):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[..., lanes], scenario)


@pytest.fixture(scope="module")
def study():
    """Return (loop, scenario, values by name, scales by name, derivatives in units of the scales)."""
    number = SCENARIOS + SPARE
    scenario = join([build_scenarios(MECHANISM, draw(MECHANISM, number, seed=11))])
    scenario = scenario._replace(contacts=np.ones(number, np.int32))
    values = random_gains(number) | {
        "force_delay": scenario.force_sensor.delay,
        # The nominal delay is a whole number of periods, which every step would cross.
        "simulator_delay": np.random.default_rng(4).uniform(0.0031, 0.0049, number),
        "stiffness": scenario.contact.stiffness[0],
        "damping": scenario.contact.damping[0],
    }
    # The same number of lanes as for the differences, so that both share one program.
    lanes = np.resize(np.arange(number), len(OFFSETS) * SCENARIOS)
    loop = build_loop(MECHANISM, "response_error", scenario)
    ticks = np.asarray(evaluate(loop, *chosen((scenario, values), lanes))[1])[:number]
    good = np.flatnonzero(ticks < LONGEST)[:SCENARIOS]
    assert len(good) == SCENARIOS
    scenario, values = chosen((scenario, {name: values[name] for name in NAMES}), good)
    loop = build_loop(MECHANISM, "response_error", scenario)
    plain = {name: np.asarray(value) for name, value in values.items()}
    scale = scales(plain)
    by_value = np.asarray(derivatives(loop, scenario, values))
    return loop, scenario, plain, scale, by_value * np.stack([scale[name] for name in NAMES])


def differences(study, step):
    """Return central differences (parameters, scenarios), in units of the scales."""
    loop, scenario, values, scale, _ = study
    lanes = np.tile(np.arange(SCENARIOS), len(OFFSETS))
    copies, result = chosen(scenario, lanes), []
    for name in NAMES:
        moved = {other: value[lanes] for other, value in values.items()}
        moved[name] += step * np.repeat(OFFSETS, SCENARIOS) * scale[name][lanes]
        result.append(np.asarray(evaluate(loop, copies, moved)[0]).reshape(len(OFFSETS), SCENARIOS))
    return np.einsum("o,pos->ps", WEIGHTS, np.stack(result)) / step


@pytest.fixture(scope="module")
def disagreements(study):
    """Return, for each step, the (parameter, scenario) pairs whose derivative and difference disagree."""
    exact = study[-1]
    return {
        step: np.argwhere(~(np.abs(differences(study, step) - exact) <= 1e-5 * np.abs(exact) + 1e-8))
        for step in STEPS
    }


@pytest.mark.slow
def test_restitution_derivatives_for_gains_and_parameters_are_nonzero(study):
    exact = study[-1]
    assert np.all(np.isfinite(exact))
    # Every parameter, including the threshold, changes the restitution of most scenarios.
    moved = np.mean(np.abs(exact) > 1e-6, axis=1)
    assert np.all(moved > 0.5), dict(zip(NAMES, moved, strict=True))


def test_restitution_derivatives_match_central_differences(disagreements):
    scenarios = np.unique(disagreements[1e-6][:, 1])
    assert len(scenarios) <= 0.01 * SCENARIOS


@pytest.fixture(scope="module")
def sweep():
    """Return (delay [s], restitution, derivative [1/s]) of the nominal first contact.

    The identification delay varies in fine steps over more than two periods.
    """
    delay = np.arange(2.7, 5.3, 0.005) * PERIOD
    scenario = join([build_scenarios(MECHANISM, {"approach.phase": np.full(len(delay), 0.4)})])
    scenario = scenario._replace(contacts=np.ones(len(delay), np.int32))
    loop = build_loop(MECHANISM, "response_error", scenario)
    gains = {gain.name: jnp.full(len(delay), gain.nominal(MECHANISM)) for gain in GAINS}

    @functools.partial(jax.jit, compiler_options=QUICK)
    def both(delay):
        def first(delay):
            return rollout(loop, gains | {"identification_delay": delay}, scenario).restitution[0]

        return jax.jvp(first, (delay,), (jnp.ones_like(delay),))

    return delay, *map(np.asarray, both(jnp.asarray(delay)))


def test_restitution_is_continuous_function_of_identification_delay(sweep):
    delay, restitution, slope = sweep
    steps = np.diff(restitution)
    assert np.abs(restitution[-1] - restitution[0]) > 0.01
    # The change in each step equals the integral of the derivative: there is no jump.
    expected = np.diff(delay) * (slope[1:] + slope[:-1]) / 2
    np.testing.assert_allclose(steps, expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(steps.sum(), expected.sum(), rtol=1e-4)


def test_restitution_derivative_for_identification_delay_matches_difference(sweep):
    delay, restitution, slope = sweep
    difference = (restitution[2:] - restitution[:-2]) / (delay[2:] - delay[:-2])
    # At a whole number of periods the interpolation between two samples, and with it the curve, has a kink.
    whole = np.abs(delay / PERIOD - np.round(delay / PERIOD))[1:-1] < 0.006
    assert np.sum(whole) == 9
    error = np.abs(difference - slope[1:-1]) / np.abs(slope[1:-1])
    assert np.median(error) < 1e-5 and np.max(error[~whole]) < 2e-3 and np.max(error) < 0.02


def events(loop, scenario, values):
    """Return discrete events of recorded runs (the lanes) by name.

    An event is a boolean per tick, (ticks, runs), or a number of whole periods, (runs,).
    """
    gains, changed = problem(scenario, {name: jnp.asarray(value) for name, value in values.items()})
    ticks = jax.tree.map(np.asarray, run_record(loop, gains, changed, LONGEST)[1])
    force, measured = ticks.signals.force_measured, ticks.signals.position_measured
    aligned = np.empty_like(measured)
    for lane, delay in enumerate(values["identification_delay"]):
        line = DelayLine(delay, PERIOD)
        line.start(measured[0, lane], ticks.signals.velocity_desired[0, lane])
        aligned[:, lane] = [line.step(x) for x in measured[:, lane]]
    running = ticks.active
    assert not running[-1].any()

    def whole(delay):
        return np.floor(delay / PERIOD)

    return {
        "contact over": running,
        "sensor reads contact": running & (force > 0),
        "response active": running & (aligned > 0),
        "identification active": running & (aligned > 0) & (np.abs(force) > values["contact_threshold"]),
        "identification delay crosses a period": whole(values["identification_delay"]),
        "force reading crosses a period": whole(values["simulator_delay"] + values["force_delay"]),
        "position reading crosses a period": whole(values["simulator_delay"]),
    }


def named_events(study, pairs, step):
    """Return, for every pair, the names of the events that differ between the runs of its difference."""
    loop, scenario, values, scale, _ = study
    offsets, asked = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]), len(pairs)
    pairs = np.resize(pairs, (max(asked, AGREEING), 2))  # one program for both steps
    lanes = np.repeat(pairs[:, 1], len(offsets))
    moved = {name: value[lanes] for name, value in values.items()}
    for row, (parameter, lane) in enumerate(pairs):
        name = NAMES[parameter]
        moved[name][row * len(offsets) : (row + 1) * len(offsets)] += step * offsets * scale[name][lane]
    result = events(loop, chosen(scenario, lanes), moved)
    names = [set() for _ in pairs]
    for name, happens in result.items():
        runs = happens.reshape(*happens.shape[:-1], len(pairs), len(offsets))
        differ = (runs != runs[..., :1]).any(axis=-1)
        for row in np.flatnonzero(differ.any(axis=0) if differ.ndim == 2 else differ):
            names[row].add(name)
    return names[:asked]


@pytest.mark.parametrize("step", STEPS)
def test_derivative_differs_from_finite_difference_only_if_discrete_event_moves(study, disagreements, step):
    pairs = disagreements[step]
    # The larger step certainly crosses events: otherwise this test would check nothing.
    assert len(pairs) > 0 or step == STEPS[0]
    if len(pairs):
        names = named_events(study, pairs, step)
        print(
            step,
            len(pairs),
            len(np.unique(pairs[:, 1])),
            [(NAMES[p], int(s), sorted(n)) for (p, s), n in zip(pairs, names, strict=True)],
        )
        unexplained = [(NAMES[p], s) for (p, s), result in zip(pairs, names, strict=True) if not result]
        assert not unexplained


def test_derivative_equals_finite_difference_if_no_discrete_event_moves(study, disagreements):
    step = STEPS[0]
    parted = {(p, s) for p, s in disagreements[step]}
    pairs = np.array([(p, s) for p in range(len(NAMES)) for s in range(SCENARIOS) if (p, s) not in parted])
    names = named_events(study, np.random.default_rng(0).choice(pairs, AGREEING, replace=False), step)
    assert not any(names)
