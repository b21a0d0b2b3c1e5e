"""The exported six-axis controller, in Python and C, in a loop with an independent rig (`six_axis_oracle`).

The rig is plain NumPy: its numerical model, motion simulator, contact and force sensor share no code with the
package. The final twist of a contact must equal that of `simulate`.
"""

import c99_cases
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gain_documents import sign
from scipy.spatial.transform import Rotation
from six_axes import drawn_bias_walk, drawn_timing
from six_axis_c99 import ControllerInC, controller_of_bundle
from six_axis_documents import six_axis_document
from six_axis_oracle import on_the_rig, relative

import jaxhil
from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load_any
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.loop import model_motion, run
from tuning.verification.six_axis_replay import six_axis_loop

TICKS = 240  # duration of a run of probe-drogue until its contact is over
LEADS = tuple(f"lag_lead_{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz"))
OFFSETS = ((0.03, -0.025), (-0.01, 0.045))  # m


def body(body, state):
    """Return position, velocity, rotation matrix and angular velocity (body axes) of a body."""
    quaternion = np.array(jax.tree.leaves(state.attitude))[:, 0]
    attitude = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
    position, velocity = (np.array(jax.tree.leaves(part))[:, 0] for part in (state.position, state.velocity))
    spin = np.array(jax.tree.leaves(state.spin))[:, 0]
    return position, velocity, attitude, np.linalg.solve(body, attitude.T @ spin)


def case_of(mechanism, scenario):
    """Return the oracle's case (see `six_axis_oracle`) for probe-drogue."""
    sensor, simulator = mechanism.rig.force_sensor, mechanism.rig.simulator
    tip, tool = mechanism.contact["tip"], mechanism.rig.force_sensor.tool
    inertias = [np.asarray(part.inertia, float) for part in (mechanism.target, mechanism.chaser)]
    inertias = [np.diag(part) if part.ndim == 1 else part for part in inertias]
    states = (scenario.start.target, scenario.start.chaser)
    target = tip.target
    return {
        "masses": (mechanism.target.mass, mechanism.chaser.mass),
        "inertias": inertias,
        "interfaces": (mechanism.target.interface, mechanism.chaser.interface),
        "start": [body(inertia, state) for inertia, state in zip(inertias, states, strict=True)],
        "spheres": [(tip.chaser.centre, tip.chaser.radius)],
        "shape": "drogue",
        "numbers": (target.half_angle, target.bottom_radius, target.bottom),
        "stiffness": tip.stiffness,
        "exponent": tip.exponent or 1.5,
        "damping": tip.damping,
        "friction": tip.friction.coefficient,
        "slip": tip.friction.slip,
        "period": mechanism.rig.control_period,
        "frequency": simulator.natural_frequency,
        "ratio": np.broadcast_to(simulator.damping_ratio, 6),
        "delays": simulator.delay,
        "force_delay": sensor.delay,
        "position_delay": mechanism.rig.position_sensor.delay,
        "hold": mechanism.rig.command_hold,
        "tool": (tool.mass, np.array(tool.com), np.diag(tool.inertia)),
        "assumed": (tool.mass, np.array(tool.com)),
        "gravity": np.array(sensor.gravity),
    }


@pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler (cc) on this machine")
@pytest.mark.slow
@pytest.mark.parametrize("name", ["impulse_ledger", "phase_lead"])
def test_exported_controller_on_independent_rig_gives_simulated_final_twist(name, tmp_path):
    for offset in OFFSETS:
        mechanism = load_any("probe-drogue", {"approach.offset": list(offset)}).mechanism
        gains = literature_gains(mechanism, name)
        leads = np.array([gains[lead] for lead in LEADS])
        with jax_context():
            scenario = build_scenarios(mechanism)
            loop = six_axis_loop(mechanism, name, scenario)
            arrays = {gain: jnp.asarray(value) for gain, value in gains.items()}
            state, ticks = jax.jit(run, static_argnums=(0, 3))(loop, arrays, scenario, TICKS)
            simulated = np.asarray(model_motion(scenario.bodies, state.states)[2])[:, 0]
        before = np.asarray(ticks.signals.twist_desired)[0, :, 0]
        assert np.linalg.norm((simulated - before)[:3]) > 0.01  # there was a contact
        case, document = case_of(mechanism, scenario), sign(six_axis_document(name, **gains))
        for controller in (
            controller_of_bundle(document),
            ControllerInC(document, tmp_path / str(offset[0])),
        ):
            *_, v, w, _, _ = relative(case, on_the_rig(case, TICKS, controller, leads))
            for part, expected in ((v, simulated[:3]), (w, simulated[3:])):
                error = np.max(np.abs(part - expected)) / np.max(np.abs(expected))
                print(name, offset, type(controller).__name__, error)
                assert error <= 1e-8


def assert_final_twist(run, case, bodies):
    """Assert that the bodies have the final twist of a simulated run."""
    *_, v, w, _, _ = relative(case, bodies)
    error = np.max(np.abs([*v, *w] - np.array(run.final.twist))) / np.max(np.abs(run.final.twist))
    print(error)
    assert error <= 1e-8


def controller_and_leads(name, gains):
    """Return the exported controller with its leads of the coordinates; None and 0 for `none`."""
    if name == "none":
        return None, 0.0
    document = sign(six_axis_document(name, **gains))
    return controller_of_bundle(document), np.array([gains[lead] for lead in LEADS])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["none", "phase_lead", "response_error", "impulse_ledger"])
def test_controller_on_independent_rig_with_bias_walk_gives_simulated_final_twist(name):
    walk = {"rig.force_sensor.bias_random_walk": {"force": 2.0, "torque": 0.2}}
    mechanism = load_any("probe-drogue", walk).mechanism
    gains, scenario = literature_gains(mechanism, name), build_scenarios(mechanism)
    run, case = jaxhil.simulate(mechanism, name, gains=gains), case_of(mechanism, scenario)
    ticks = round(run.final.time / mechanism.rig.control_period)
    bias = drawn_bias_walk(scenario, ticks)
    assert_final_twist(run, case, on_the_rig(case, ticks, *controller_and_leads(name, gains), bias=bias))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["none", "phase_lead", "response_error", "impulse_ledger"])
def test_controller_on_independent_rig_with_timing_effects_gives_simulated_final_twist(name):
    """The controller does not run at missed ticks, and converts a repeated frame with the present pose."""
    overrides = {
        "rig.force_sensor.jitter": 0.0021,
        "rig.force_sensor.loss_probability": 0.1,
        "rig.missed_tick_probability": 0.1,
    }
    mechanism = load_any("probe-drogue", overrides).mechanism
    gains = literature_gains(mechanism, name)
    run = jaxhil.simulate(mechanism, name, gains=gains)
    case = case_of(mechanism, build_scenarios(mechanism))
    controller, leads = controller_and_leads(name, gains)
    ticks = round(run.final.time / mechanism.rig.control_period)
    timing = drawn_timing(build_scenarios(mechanism), ticks)
    assert_final_twist(run, case, on_the_rig(case, ticks, controller, leads, **timing))
