"""Derivatives through the six-axis loop with the impulse ledger, compared with central differences.

Derivatives of the energy error and the twist error with respect to the tuned gains, the delays, stiffness and
friction are finite in all lanes, and agree with central differences in nearly all lanes.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICK
from six_axis_ranges import load_wide

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.metrics import evaluate

pytestmark = pytest.mark.slow
LAW, LANES, TILE = "impulse_ledger", 256, 64
GAINS = "velocity_gain", "position_gain", "identification_delay"
# Smallest relative step of each parameter. The steps of parameters with a small effect are larger, because
# rounding, and the integration of the ideal contact, have errors.
STEPS = {
    "velocity_gain": 1.6e-5,
    "position_gain": 1.6e-5,
    "identification_delay": 2.5e-7,
    "force delay": 1e-6,
    "axes' delays": 1.6e-5,
    "stiffness": 1e-6,
    "friction": 1.6e-5,
}
RATIO, LEVELS = 4, 4  # ratio of successive steps, and their number
TOLERANCE = 1e-4  # of the derivative or, where it is small, of 0.01 times the error
SHARE = 0.95  # smallest share of the lanes that agree
# Rounding and the integration of the ideal contact limit the differences with respect to friction, whose
# effect on the errors is small.
SHARES = dict.fromkeys(STEPS, SHARE) | {"friction": 0.93}


def scaled(scenarios, scales):
    """Return the scenarios with scaled delays of force sensor and axes, stiffness and friction."""
    force, axes, stiffness, friction = scales
    sensor, simulator = scenarios.sensor, scenarios.simulator
    groups = tuple(
        replace(
            group,
            parameters=group.parameters._replace(stiffness=stiffness * group.parameters.stiffness),
            friction=replace(group.friction, coefficient=friction * group.friction.coefficient),
        )
        for group in scenarios.groups
    )
    return scenarios._replace(
        sensor=sensor._replace(delay=force * sensor.delay),
        simulator=simulator._replace(delay=axes * simulator.delay),
        groups=groups,
    )


def best_difference(runs, steps):
    """Return the derivative by central differences, and the error of this estimate.

    `runs` (levels, 2, metrics, lanes) contains the values below and above the nominal value for each of the
    relative `steps`. Of the two successive extrapolations that agree best, the result is the one with the
    larger steps, because rounding affects it less.
    """
    plain = (runs[:, 1] - runs[:, 0]) / (2 * steps[:, None, None])
    extrapolated = (RATIO**2 * plain[:-1] - plain[1:]) / (RATIO**2 - 1)
    gaps = np.abs(np.diff(extrapolated, axis=0))
    best = np.argmin(gaps, axis=0)[None]
    pick = np.take_along_axis
    return pick(extrapolated, best + 1, axis=0)[0], pick(gaps, best, axis=0)[0]


def test_ledger_derivatives_are_finite_and_agree_with_central_differences():
    mechanism, by = load_wide("probe-drogue"), list(STEPS)
    with jax_context():
        scenarios = build_scenarios(mechanism, draw(mechanism, LANES, 3), seed=3)
        loop, gains = make_loop(mechanism, LAW, scenarios), literature_gains(mechanism, LAW)

        def tile(first):
            def pick(leaf):
                is_drawn = jnp.ndim(leaf) > 0 and jnp.shape(leaf)[-1] == LANES
                return jnp.asarray(leaf)[..., first : first + TILE] if is_drawn else leaf

            return jax.tree.map(pick, scenarios)

        def errors(scales, scenarios):
            changed = {name: scales[i] * gains[name] for i, name in enumerate(GAINS)}
            arrays = {name: jnp.asarray(value) for name, value in {**gains, **changed}.items()}
            metrics = evaluate(loop, arrays, scaled(scenarios, scales[len(GAINS) :])).metrics
            return jnp.stack([metrics.energy_error[0], metrics.twist_error[0]])

        tiles = [tile(first) for first in range(0, LANES, TILE)]

        def on_all_lanes(function, scales):
            return np.concatenate([np.asarray(function(scales, part)) for part in tiles], axis=1)

        ones = jnp.ones(len(by))
        values = jax.jit(errors, compiler_options=QUICK)
        middle = on_all_lanes(values, ones)
        assert np.isfinite(middle).all(), "in some lanes nothing touches"
        slopes = on_all_lanes(jax.jit(jax.jacfwd(errors), compiler_options=QUICK), ones)
        assert np.isfinite(slopes).all()
        agreeing = {}
        for index, (name, smallest) in enumerate(STEPS.items()):
            steps = smallest * RATIO ** np.arange(LEVELS)
            moved = [[on_all_lanes(values, ones.at[index].add(k * h)) for k in (-1, 1)] for h in steps]
            expected, uncertainty = best_difference(np.array(moved), steps)
            scale = np.maximum(np.abs(expected), 0.01 * np.abs(middle))
            is_close = (np.abs(slopes[..., index] - expected) < TOLERANCE * scale).all(axis=0)
            is_certain = (uncertainty < TOLERANCE * scale).all(axis=0)
            agreeing[name] = np.mean(is_close)
            print(
                f"{name}: {agreeing[name]:.3f} of the lanes agree; among the others, "
                f"{np.sum(~is_close & ~is_certain)} differences are uncertain"
            )
    assert all(agreeing[name] >= share for name, share in SHARES.items()), agreeing
