"""Six-axis impulse ledger: smaller errors than with a lead, and no command without contact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICK
from six_axis_ranges import POSE_NOISE, with_ranges

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.laws.impulse_ledger.six_axes.tangent_model.rig import TangentModel
from jaxhil.laws.impulse_ledger.six_axes.tangent_model.simulation import (
    Estimate,
    Tangent,
    compute_force_change,
    turn,
)
from jaxhil.mechanism.file import load_any
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.loop import run
from jaxhil.sixdof.metrics import evaluate
from jaxhil.sixdof.rollout import STATUS_NAMES

LANES = 64
LAW = "impulse_ledger"
# By mechanism: largest rms of the energy error and of the twist error, and largest twist error.
BARS = {
    "probe-drogue": (0.05, 0.012, 0.05),
    "ring-capture": (0.05, 0.08, np.inf),
    "hydraulic-hexapod": (0.04, 0.02, np.inf),
}


def evaluated(mechanism, compensator, *changes, lanes=LANES, scenario=None, seed=1):
    """Return the metrics of all contacts of a run, for each change of the literature's gains."""
    with jax_context():
        scenarios = build_scenarios(mechanism, draw(mechanism, lanes, seed), seed=seed)
        if scenario is not None:
            scenarios = scenario(scenarios)
        loop = make_loop(mechanism, compensator, scenarios)
        gains = literature_gains(mechanism, compensator)
        program = jax.jit(evaluate, static_argnums=0, compiler_options=QUICK)

        def of(change):
            arrays = {name: jnp.asarray(value) for name, value in {**gains, **change}.items()}
            metrics = program(loop, arrays, scenarios).metrics
            return {name: np.asarray(getattr(metrics, name))[..., 0, :] for name in metrics._fields}

        return [of(change) for change in changes or ({},)]


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def check_good(metrics):
    """Check that the status of every lane is a success."""
    assert {STATUS_NAMES[status] for status in metrics["status"]} <= {"rebounded", "captured"}


@pytest.mark.slow
@pytest.mark.parametrize("name", BARS)
def test_six_axis_impulse_ledger_has_much_smaller_errors_than_lead(name):
    mechanism = with_ranges(name)
    [ledger] = evaluated(mechanism, LAW)
    check_good(ledger)
    energy, twist, largest = BARS[name]
    assert rms(ledger["energy_error"]) < energy
    assert rms(ledger["twist_error"]) < twist
    assert np.max(ledger["twist_error"]) < largest
    leads = [{"phase_lead": lead} for lead in np.arange(0.018, 0.040, 0.004)]
    best = min(rms(metrics["twist_error"]) for metrics in evaluated(mechanism, "phase_lead", *leads))
    assert rms(ledger["twist_error"]) < 0.6 * best


@pytest.mark.slow
def test_six_axis_impulse_ledger_is_accurate_with_pose_noise():
    [metrics] = evaluated(with_ranges("probe-drogue", POSE_NOISE), LAW)
    check_good(metrics)
    assert rms(metrics["energy_error"]) < 0.05 and rms(metrics["twist_error"]) < 0.012


@pytest.mark.slow
def test_six_axis_impulse_ledger_commands_zero_wrench_without_contact():
    mechanism = with_ranges("probe-drogue", POSE_NOISE)
    with jax_context():
        scenarios = build_scenarios(mechanism, draw(mechanism, LANES, 2), seed=2)
        # The chaser starts a second before the first touch.
        away = scenarios.start.chaser.position + 1.0 * (
            scenarios.start.target.velocity - scenarios.start.chaser.velocity
        )
        start = scenarios.start._replace(chaser=scenarios.start.chaser._replace(position=away))
        scenarios = scenarios._replace(start=start)
        loop = make_loop(mechanism, LAW, scenarios)
        gains = {name: jnp.asarray(value) for name, value in literature_gains(mechanism, LAW).items()}
        _, ticks = jax.jit(run, static_argnums=(0, 3), compiler_options=QUICK)(loop, gains, scenarios, 800)
    assert all(np.all(np.asarray(part) == 0) for part in jax.tree.leaves(ticks.command))
    depths = np.asarray(ticks.forces[0].touch.depth)
    assert np.all(depths < 0)


def test_elastic_force_of_tangent_model_never_opposes_change_of_depth():
    """Use a negative curvature: the force of the parabola falls beyond a depth of 0.1 mm."""
    stiffness, curvature, path, speed = 100.0, -1e4, 0.004, 0.02
    changes = np.linspace(-1e-3, 1e-3, 201)
    with jax_context():
        model = Tangent(*(jnp.full(201, value) for value in (stiffness, curvature, 0.0, path, speed)))
        force = np.asarray(compute_force_change(model, jnp.asarray(changes)))
        line = np.asarray(
            compute_force_change(model._replace(curvature=jnp.zeros(201)), jnp.asarray(changes))
        )
    assert np.all(force * np.sign(changes) >= 0) and np.max(force) > 0 > np.min(force)
    np.testing.assert_allclose(line, stiffness * changes, atol=1e-15)


def test_tangent_model_keeps_slope_and_force_when_contact_direction_turns():
    """The model learns F = 500 x/s^2 + 2e4 x|x|/(m s^2) up to 20 mm, with slope 1300/s^2, and turns."""
    gains = {"stiffness_spread": 1e3, "damping_spread": 3.0, "force_spread": 1.0, "curvature_spread": 1e3}
    model, speed, force, noise = TangentModel(gains | {"forgetting": 1.0}, 1e-3), 0.3, 7.0, 1e-6
    for depth in np.linspace(1e-4, 0.02, 200):
        model.learn(depth, 0.0, 500 * depth + 2e4 * depth**2, noise, speed)
    with jax_context():
        old = Estimate(jnp.array(model._mean), jnp.array(model._covariance))
        prior = jnp.diag(jnp.square(jnp.array([1e3, 3.0, 1.0, 1e3])))
        turned = turn(
            old, Estimate(jnp.zeros(4), prior), jnp.asarray(0.02 / speed), jnp.asarray(force / speed)
        )
        np.testing.assert_allclose(turned.covariance, prior)
    model.turn(0.02, force, speed)
    np.testing.assert_allclose(turned.mean, model._mean, rtol=1e-12)
    np.testing.assert_allclose(np.sqrt(np.diag(model._covariance)), [1e3, 3.0, 1.0, 1e3])
    np.testing.assert_allclose(model._mean, [1300.0, 0.0, force / speed, 0.0], rtol=0.01, atol=0.5)
    model.settle(0.0, speed)
    model.bridge(force, 0.0, 0.0, 0.0, 1e-4)
    assert model.force == pytest.approx(force, rel=1e-3)


def test_six_axis_impulse_ledger_gains_follow_from_mechanism_file():
    mechanism = load_any(
        "probe-drogue", {"rig.force_sensor.noise_std": {"force": 0.5, "torque": 0.05}}
    ).mechanism
    gains = literature_gains(mechanism, LAW)
    assert gains["identification_delay"] == 0.0037 and gains["pose_filter"] == 0.0
    assert (gains["force_noise"], gains["torque_noise"]) == (0.5, 0.05)
    lags = 0.8 / (np.pi * np.array([14.0] * 3 + [11.0] * 3)) + mechanism.rig.simulator.delay
    leads = [gains[f"lag_lead_{name}"] for name in ("x", "y", "z", "rx", "ry", "rz")]
    np.testing.assert_allclose(leads, lags - lags.min(), rtol=1e-12)
    noisy = with_ranges("petals", POSE_NOISE)
    assert literature_gains(noisy, LAW)["pose_filter"] == 0.003
    assert [gain.name for gain in SIX_AXIS_COMPENSATORS[LAW].gains if gain.tuned(mechanism)] == [
        "velocity_gain",
        "position_gain",
    ]
