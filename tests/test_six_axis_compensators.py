"""Interface of six-axis compensators: signals, constants, lead of the pose command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import QUICK

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS, literature_gains
from jaxhil.laws.six_axis_base import LAG_LEADS, SixAxisCompensator
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.loop import build_rig_constants, controller_constants, run
from jaxhil.sixdof.relative import coordinates

pytestmark = pytest.mark.slow
TICKS = 400
STILL = {key: [0, 0, 0] for key in ("position", "velocity", "angular_velocity")} | {"attitude": [1, 0, 0, 0]}
MOVING = {"position": [0, 0, 4.0], "velocity": [0.01, -0.02, 0.03], "angular_velocity": [0.003, 0, 0.002]}
CHASER = STILL | MOVING
FREE = {"approach": None, "uncertainty": {}, "start": {"duration": 0.4, "target": STILL, "chaser": CHASER}}
NOISE, QUANTUM = {"translation": 2e-5, "rotation": 1e-4}, {"translation": 1e-3, "rotation": 2e-3}


class Recorder(SixAxisCompensator):
    """Compensator that stores the measured poses and returns the measured wrench."""

    name = "recorder"
    knows = ()
    gains = ()
    reads_pose = True

    def init(self, prepared, constants, start, ring):
        return jnp.zeros((TICKS, *start.pose_desired.shape))

    def step(self, prepared, state, signals, tick):
        return signals.wrench, state.at[tick].set(signals.pose_measured)


def recorded(changes, gains=None, compensator="recorder"):
    """Return the final state of a run and its ticks, for one lane."""
    mechanism = load_any("petals", {**FREE, **changes}).mechanism
    with jax_context():
        scenario = build_scenarios(mechanism)
        loop = make_loop(mechanism, compensator, scenario)
        program = jax.jit(run, static_argnums=(0, 3), compiler_options=QUICK)
        arrays = {name: jnp.asarray(value) for name, value in (gains or {}).items()}
        state, ticks = program(loop, arrays, scenario, TICKS)
        at, _ = coordinates(ticks.pose, ticks.twist)
        return state, np.stack([np.asarray(part)[:, 0] for part in jax.tree.leaves(at)], axis=1)


@pytest.fixture
def poses(monkeypatch):
    """Return a function that returns the measured poses and the poses of the hardware, (ticks, 6)."""
    monkeypatch.setitem(SIX_AXIS_COMPENSATORS, "recorder", Recorder())

    def of(changes):
        state, hardware = recorded(changes)
        return np.asarray(state.controller.law)[:, :, 0], hardware

    return of


def test_six_axis_compensator_reads_pose_delayed_by_sensor(poses):
    """With equal sensor delays, the pose is measured at the sampling time of the force."""
    measured, hardware = poses({"rig.position_sensor.delay": 0.0037, "rig.force_sensor.delay": 0.0037})
    np.testing.assert_allclose(measured, hardware, atol=1e-12)
    later, _ = poses({"rig.position_sensor.delay": 0.0})
    speed = np.diff(later, axis=0).mean(axis=0) / 1e-3
    np.testing.assert_allclose((later - measured)[100], 0.0037 * speed, rtol=1e-3, atol=1e-9)


def test_measured_six_axis_pose_has_noise_and_quantisation(poses):
    exact, _ = poses({})
    noisy, _ = poses({"rig.position_sensor.noise_std": NOISE})
    error = noisy - exact
    expected = np.repeat([NOISE["translation"], NOISE["rotation"]], 3)
    np.testing.assert_allclose(error.std(axis=0), expected, rtol=0.15)
    assert np.all(np.abs(error.mean(axis=0)) < 4 * expected / np.sqrt(TICKS))
    correlation = np.corrcoef(error.T) - np.eye(6)
    assert np.max(np.abs(correlation)) < 5 / np.sqrt(TICKS)
    rounded, _ = poses({"rig.position_sensor.quantum": QUANTUM})
    assert np.all(np.abs(rounded - exact) <= np.repeat([*QUANTUM.values()], 3) * (0.5 + 1e-9))
    steps = np.repeat([QUANTUM["translation"], QUANTUM["rotation"]], 3)
    np.testing.assert_allclose(rounded, steps * np.round(exact / steps), atol=1e-12)


def test_six_axis_lag_lead_shifts_pose_command_along_its_motion():
    mechanism = load_any("petals", FREE).mechanism
    gains = {**literature_gains(mechanism, "phase_lead"), "lead_filter": 1e-3}
    _, late = recorded({}, gains, "phase_lead")
    lead = 0.011
    _, led = recorded({}, {**gains, LAG_LEADS[1]: lead}, "phase_lead")
    speed = np.diff(late, axis=0).mean(axis=0) / 1e-3
    np.testing.assert_allclose((led - late)[:, 1], lead * speed[1], rtol=1e-3)
    np.testing.assert_allclose(np.delete(led, 1, axis=1), np.delete(late, 1, axis=1), atol=1e-15)


def test_six_axis_controller_constants_match_masses_of_docked_bodies():
    """Compare with M^-1 = D diag(m, J)^-1 D' of both bodies."""
    mechanism = load_any("probe-drogue").mechanism
    with jax_context():
        constants = jax.tree.map(np.asarray, controller_constants(build_scenarios(mechanism), True))
    inverse = np.zeros((6, 6))
    for body in (mechanism.target, mechanism.chaser):
        arm = np.array(body.interface)
        across = np.cross(np.eye(3), arm)
        inertia = np.array(body.inertia) if np.ndim(body.inertia) == 2 else np.diag(body.inertia)
        inverse[:3, :3] += np.eye(3) / body.mass
        jacobian = np.vstack([across.T, np.eye(3)])
        inverse += jacobian @ np.linalg.inv(inertia) @ jacobian.T
    np.testing.assert_allclose(constants.inverse_mass[..., 0], inverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(constants.mass_matrix[..., 0], np.linalg.inv(inverse), rtol=1e-9, atol=1e-9)
    tool = mechanism.rig.force_sensor.tool
    across = np.cross(np.eye(3), tool.com)
    mass = np.block([
        [tool.mass * np.eye(3), tool.mass * across.T],
        [tool.mass * across, np.diag(tool.inertia) + tool.mass * across @ across.T],
    ])  # fmt: skip
    correction = np.linalg.inv(np.eye(6) - mass @ inverse)
    np.testing.assert_allclose(constants.tool_correction[..., 0], correction, rtol=1e-9, atol=1e-12)


def test_six_axis_tool_correction_is_identity_without_tool():
    mechanism = load_any("petals").mechanism
    with jax_context():
        scenario = build_scenarios(mechanism)
        rig = build_rig_constants(make_loop(mechanism, "none", scenario), {}, scenario)
    np.testing.assert_array_equal(rig.constants.tool_correction[..., 0], np.eye(6))
