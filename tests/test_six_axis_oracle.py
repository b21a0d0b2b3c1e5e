"""Six-axis rig and ideal contact compared with an independent implementation (`six_axis_oracle`).

Off-centre and oblique contacts with friction and unequal delays: a probe in a drogue, three points of a ring
on a plane, and the probe on a sensor that carries its tool.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from six_axes import (
    FULL,
    drawn_timing,
    ideal_sensor,
    lanes,
    place,
    plain_body,
    second_order,
    spheres,
    springs,
)
from six_axis_oracle import command, ideal_motion, on_the_rig, relative

from jaxhil.simulation.scenario import TimingBatch
from jaxhil.sixdof.bodies import build_state
from jaxhil.sixdof.friction import Regularised
from jaxhil.sixdof.kinematics import TaskSpace
from jaxhil.sixdof.loop import build_loop, run
from jaxhil.sixdof.metrics import compute_ideal_states
from jaxhil.sixdof.relative import Pair, States
from jaxhil.sixdof.rotations import Quaternion
from jaxhil.sixdof.scenario import Scenario
from jaxhil.sixdof.sensor import Tool
from jaxhil.sixdof.shapes import Drogue, Plane
from jaxhil.sixdof.vectors import components, matrix

pytestmark = pytest.mark.slow
BATCH, TICKS, PERIOD = (1,), 300, 1e-3
TURN = Rotation.from_rotvec([0.02, 0.03, -0.01]).as_matrix()
COMMON = {
    "masses": (1800.0, 420.0), "inertias": FULL, "interfaces": ((0.05, -0.02, 1.2), (0.01, 0.04, -1.0)),
    "exponent": 1.5, "damping": 1.5, "friction": 0.15, "slip": 2e-3, "period": PERIOD,
    "frequency": [14.0, 13.0, 12.0, 11.0, 10.0, 9.0], "ratio": [0.8, 0.7, 0.8, 0.9, 0.8, 1.1],
    "delays": [4e-3, 4.2e-3, 3e-3, 5.3e-3, 5.05e-3, 4.4e-3], "force_delay": 3.7e-3, "position_delay": 1.3e-3,
    "tool": None, "hold": "linear",
}  # fmt: skip
PROBE = COMMON | {
    "spheres": [((0.0, 0.0, 0.0), 0.02)], "shape": "drogue", "numbers": (0.75, 0.04, 0.0), "stiffness": 3e6,
    "height": 0.014,
}  # fmt: skip
CASES = {
    "probe": PROBE,
    "ring": COMMON | {
        "spheres": [((0.3, 0.0, 0.0), 0.01), ((-0.15, 0.26, 0.0), 0.01), ((-0.15, -0.26, 0.0), 0.01)],
        "shape": "plane", "numbers": (), "stiffness": 1e6, "height": 0.0205,
    },
    "tool": PROBE | {
        "tool": (12.0, np.array([0.01, 0.02, 0.15]), np.diag([0.2, 0.25, 0.1])),
        "assumed": (11.8, np.array([0.012, 0.02, 0.14])), "gravity": np.array([0.3, -0.2, -9.8]),
    },
}  # fmt: skip
# The inertia force of a tool depends on the ripple of held commands, also before the first tick.
HELD = {"held commands": CASES["tool"] | {"hold": "zoh"}}

EFFECTS = {
    "jitter": TimingBatch(lanes(3.1e-3, BATCH), None, None),
    "lost frames": TimingBatch(None, lanes(0.2, BATCH), None),
    "missed ticks": TimingBatch(None, None, lanes(0.1, BATCH)),
    "all": TimingBatch(lanes(1.7e-3, BATCH), lanes(0.1, BATCH), lanes(0.05, BATCH)),
}


def initial_bodies(case):
    """Return the case with its initial states: the chaser's frame C is rotated, and approaches the target's
    frame T.
    """
    o1, o2 = (np.asarray(o) for o in case["interfaces"])
    apart = np.array([0.03, -0.025, case["height"]])
    chaser = (o1 + apart - TURN @ o2, np.array([1e-3, -2e-3, -0.025]), TURN, np.array([3e-3, -2e-3, 1e-3]))
    target = (np.zeros(3), np.zeros(3), np.eye(3), np.array([1e-3, 2e-3, -1e-3]))
    return case | {"start": [target, chaser]}


def as_scenario(case):
    bodies = Pair(*(
        plain_body(mass, inertia, interface, BATCH)
        for mass, inertia, interface in zip(case["masses"], case["inertias"], case["interfaces"], strict=True)
    ))  # fmt: skip
    states = []
    for body, (r, v, attitude, w) in zip(bodies, case["start"], strict=True):
        x, y, z, scalar = Rotation.from_matrix(attitude).as_quat()
        turn = Quaternion(lanes(scalar, BATCH), place([x, y, z], BATCH))
        states.append(build_state(body, place(r, BATCH), place(v, BATCH), turn, place(w, BATCH)))
    one = jnp.ones((len(case["spheres"]), 1))
    centres = jnp.asarray(np.array([centre for centre, _ in case["spheres"]], float).T[..., None])
    radii = lanes([radius for _, radius in case["spheres"]], BATCH)
    if case["shape"] == "drogue":
        shape = Drogue(*(number * one for number in case["numbers"]))
    else:
        shape = Plane(place([0, 0, 0], one.shape), place([0, 0, 1], one.shape))
    law = springs(case["stiffness"] * one, case["damping"] * one, case["exponent"] * one)
    contact = spheres(
        centres, radii, shape, "hunt_crossley", law, Regularised(case["friction"] * one, case["slip"] * one)
    )
    axes = (lanes(case[key], BATCH) for key in ("frequency", "ratio", "delays"))
    sensor = ideal_sensor(
        lanes(case["force_delay"], BATCH), position_delay=lanes(case["position_delay"], BATCH)
    )
    if case["tool"] is not None:
        mass, centre, inertia = case["tool"]
        tool = Tool(lanes(mass, BATCH), place(centre, BATCH), matrix(lanes(inertia, BATCH)))
        assumed = Tool(lanes(case["assumed"][0], BATCH), place(case["assumed"][1], BATCH), tool.inertia)
        gravity = place(case["gravity"], BATCH)
        sensor = sensor._replace(tool=tool, assumed_tool=assumed, gravity=gravity, assumed_gravity=gravity)
    return Scenario(
        bodies, States(*states), (contact,), (), second_order(*axes), TaskSpace(), sensor,
        lanes(PERIOD, BATCH), lanes(TICKS * PERIOD, BATCH), jnp.zeros((2, 1), jnp.uint32),
    )  # fmt: skip


def close(states, expected, tolerance):
    """Compare positions and velocities with those of the independent implementation."""
    for state, (r, v, attitude, _) in zip(states, expected, strict=True):
        np.testing.assert_allclose(np.asarray(components(state.velocity))[:, 0], v, atol=tolerance)
        np.testing.assert_allclose(np.asarray(components(state.position))[:, 0], r, atol=tolerance)
        x, y, z = np.asarray(components(state.attitude.v))[:, 0]
        turned = Rotation.from_quat([x, y, z, np.asarray(state.attitude.w)[0]])
        np.testing.assert_allclose(turned.as_matrix(), attitude, atol=tolerance)


@pytest.mark.parametrize("name", CASES | HELD)
def test_six_axis_rig_agrees_with_independent_implementation(name):
    case = initial_bodies((CASES | HELD)[name])
    case_scenario = as_scenario(case)
    loop = build_loop(
        case_scenario, integrator="semi_implicit_euler", hold=case["hold"], latency=0,
        side="fixed" if case["tool"] is None else "moving",
    )  # fmt: skip
    end, seen = jax.jit(run, static_argnums=(0, 3))(loop, {}, case_scenario, TICKS)
    assert np.max(np.abs(components(seen.contact.force))) > 20
    expected = on_the_rig(case, TICKS)
    close(end.states, expected, 1e-10)
    # Angular velocities, and total momentum.
    spins = [np.asarray(components(state.spin))[:, 0] for state in end.states]
    for spin, (_, _, attitude, w), inertia in zip(spins, expected, case["inertias"], strict=True):
        np.testing.assert_allclose(spin, attitude @ inertia @ w, atol=1e-9)


@functools.cache
def undisturbed(name):
    """Return the independent implementation's final states without timing effects."""
    return on_the_rig(initial_bodies(CASES[name]), TICKS)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("effect", EFFECTS)
def test_six_axis_rig_with_timing_effects_agrees_with_independent_implementation(name, effect):
    case, timing = initial_bodies(CASES[name]), EFFECTS[effect]
    case_scenario = as_scenario(case)._replace(timing=timing, key=jnp.array([[5], [7]], jnp.uint32))
    loop = build_loop(
        case_scenario, integrator="semi_implicit_euler", hold="linear", latency=0,
        side="fixed" if case["tool"] is None else "moving",
    )  # fmt: skip
    end, _ = jax.jit(run, static_argnums=(0, 3))(loop, {}, case_scenario, TICKS)
    expected = on_the_rig(case, TICKS, **drawn_timing(case_scenario, TICKS))
    close(end.states, expected, 1e-10)
    assert np.linalg.norm(expected[1][1] - undisturbed(name)[1][1]) > 1e-6


@pytest.mark.parametrize("name", ["probe", "ring"])
def test_six_axis_ideal_contact_agrees_with_independent_implementation(name):
    case = initial_bodies(CASES[name])
    case_scenario = as_scenario(case)
    time = lanes(TICKS * PERIOD, BATCH)
    result = jax.jit(compute_ideal_states)(case_scenario, time)
    before = case["start"][1][1]
    expected = ideal_motion(case, TICKS * PERIOD)
    assert np.linalg.norm(expected[1][1] - before) > 0.01
    close(result, expected, 1e-9)
    assert np.all(np.isfinite(command(case, expected)[0])) and relative(case, expected)[0][2] > 0
