"""Derivatives through the six-axis loop with the impulse ledger, compared with central differences."""

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
LAW, LANES = "impulse_ledger", 48
GAINS = "velocity_gain", "position_gain", "identification_delay"
BY = (*GAINS, "force delay", "axes' delays", "stiffness", "friction")
# Parameters whose derivatives are compared. For the others, discrete changes between two runs (for example of
# the tick at which a contact is detected) spoil the central differences of more than 5 % of the lanes.
COMPARED = "position_gain", "identification_delay", "force delay", "axes' delays"
# Relative steps of the parameters, so small that few touches begin at a different tick. Parameters with a
# small effect have larger steps, because the numerical integration of the ideal contact has an error.
STEPS = 2e-4, 1e-3, 2e-5, 2e-5, 2e-5, 2e-5, 1e-3


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


def differences(function, at, index):
    """Return fourth-order central differences with respect to one parameter."""
    step = STEPS[index] * np.eye(len(at))[index]
    near, far = (np.asarray(function(at + k * step)) - function(at - k * step) for k in (1, 2))
    return (8 * near - far) / (12 * STEPS[index])


def test_ledger_derivatives_are_finite_and_agree_with_central_differences():
    """Check that derivatives of lanes with contact are finite, and compare some with differences."""
    mechanism = load_wide("probe-drogue")
    with jax_context():
        scenarios = build_scenarios(mechanism, draw(mechanism, LANES, 3), seed=3)
        loop, gains = make_loop(mechanism, LAW, scenarios), literature_gains(mechanism, LAW)

        def errors(scales):
            changed = {name: scales[i] * gains[name] for i, name in enumerate(GAINS)}
            arrays = {name: jnp.asarray(value) for name, value in {**gains, **changed}.items()}
            metrics = evaluate(loop, arrays, scaled(scenarios, scales[len(GAINS) :])).metrics
            return jnp.stack([metrics.energy_error[0], metrics.twist_error[0]])

        ones = jnp.ones(len(BY))
        values = jax.jit(errors, compiler_options=QUICK)
        slopes = np.asarray(jax.jit(jax.jacfwd(errors), compiler_options=QUICK)(ones))
        touched = np.isfinite(np.asarray(values(ones))).all(axis=0)
        assert touched.mean() > 0.9 and np.all(np.isfinite(slopes[:, touched]))
        for name in COMPARED:
            index = BY.index(name)
            expected = differences(values, ones, index)[:, touched]
            scale = np.maximum(np.abs(expected), 0.01 * np.median(np.abs(expected)))
            close = np.abs(slopes[:, touched, index] - expected) < 1e-4 * scale
            assert np.mean(close.all(axis=0)) > 0.95, name
