"""Speed of the six-axis simulation on one core, compared with C++ and MuJoCo.

The best of several repetitions counts. The C++ code (six_axes.cpp) gives the same results, except for
rounding. MuJoCo simulates the same two bodies without the rig, by Euler's method, with friction between a
sphere and a wall. Its time per step is the average of steps with and without contact, weighted by the time in
contact.
"""

import ctypes
import shutil
import subprocess
import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhil.mechanism.file import load_any
from jaxhil.mechanism.uncertainty import draw
from jaxhil.simulation.evaluation import TILE_SIZE
from jaxhil.simulation.jax_environment import SIX_AXIS_OPTIONS, supported_options
from jaxhil.sixdof.building import build_scenarios, make_loop
from jaxhil.sixdof.loop import begin, build_rig_constants, tick
from jaxhil.sixdof.shapes import Drogue

pytestmark = pytest.mark.benchmark
TILES, REPEATS = 8, 25
LANES = TILES * TILE_SIZE  # lanes of a tile run in parallel, tiles one after the other
TICKS = 384  # all contacts have ended by then
CPP, MUJOCO = 0.3, 30.0  # required speed relative to C++ and to MuJoCo
FLAGS = ("-O3", "-march=native", "-std=c++17", "-fno-math-errno", "-Wno-psabi", "-shared", "-fPIC")
NUMBERS = (
    "period", "bodies", "states", "transition", "rows", "axes", "samples", "command", "intervals", "contact",
    "bias",
)  # fmt: skip


class Problem(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int64) for name in ("lanes", "ring")] + [
        (name, ctypes.c_void_p) for name in NUMBERS
    ]


def build_loop_and_scenarios():
    """Return loop and random scenarios of probe-drogue, with an ideal sensor and a drogue without a rim."""
    mechanism = load_any("probe-drogue", ["rig.force_sensor.noise_std=0.0"]).mechanism
    scenario = build_scenarios(mechanism, draw(mechanism, LANES, 1))
    (group,) = scenario.groups
    shape = group.candidates.shape
    drogue = Drogue(shape.half_angle, shape.bottom_radius, shape.bottom)
    spheres = type(group.candidates)(group.candidates.centre, group.candidates.radius, drogue)
    group = type(group)(spheres, group.law, group.parameters, group.friction)
    loop = make_loop(mechanism, "none", scenario)
    fixed = type(loop)(
        **{name: getattr(loop, name) for name in loop.__dataclass_fields__} | {"side": "fixed"}
    )
    return fixed, scenario._replace(groups=(group,))


def inputs(loop, rig, run):
    """Return the inputs of six_axes.cpp by name."""

    def flat(*trees):
        return np.stack([np.broadcast_to(leaf, (LANES,)) for leaf in jax.tree.leaves(trees)])

    (group,) = rig.groups
    shape, candidates = group.candidates.shape, group.candidates
    drogue = (jnp.sin(shape.half_angle), jnp.cos(shape.half_angle), shape.bottom_radius, shape.bottom)
    law = (group.parameters.stiffness, group.parameters.damping)
    contact = [candidates.radius, *drogue, *law, group.friction.coefficient, group.friction.slip]
    contact += jax.tree.leaves(candidates.centre)
    exact, hardware = rig.axes.propagation, run.hardware
    rows = [exact.position, exact.velocity]
    bodies = [(body.mass, body.inertia, body.inverse_inertia, body.interface) for body in rig.bodies]
    values = {
        "period": rig.period,
        "bodies": flat(*bodies),
        "states": flat(*run.states),
        "transition": exact.transition,
        "rows": jnp.stack(rows),
        "axes": jnp.stack(hardware.state),
        "samples": hardware.ring,
        "command": hardware.commands[0],
        "contact": np.stack([np.broadcast_to(one[0], (LANES,)) for one in contact]),
        "bias": rig.sensor.errors.bias,
    }
    arrays = {name: np.array(value, float, order="C") for name, value in values.items()}
    return arrays | {"intervals": np.array(rig.axes.force.intervals, np.int64, order="C")}


def compiled(folder):
    library = ctypes.CDLL(str(folder / "six_axes.so"))
    library.run_ticks.argtypes = [ctypes.POINTER(Problem), ctypes.c_int64]
    library.run_ticks.restype = ctypes.c_double
    return library


@partial(jax.jit, static_argnums=0, compiler_options=supported_options(SIX_AXIS_OPTIONS))
def ticks(loop, rig, run):
    """Return the states after all ticks."""

    def one_tile(start):
        rig, run = start
        return jax.lax.scan(lambda run, _: (tick(loop, rig, run)[0], None), run, None, length=TICKS)[0].states

    return jax.lax.map(one_tile, (rig, run))


def split_into_tiles(tree):
    """Reshape (..., lanes) to (tiles, ..., lanes of a tile); repeat scalars."""

    def fold(leaf):
        spread = jnp.broadcast_to(leaf, (*leaf.shape[:-1], LANES)).reshape(*leaf.shape[:-1], TILES, TILE_SIZE)
        return jnp.moveaxis(spread, -2, 0)

    return jax.tree.map(lambda leaf: fold(leaf) if leaf.ndim else jnp.full(TILES, leaf), tree)


@partial(jax.jit, static_argnums=0)
def share_in_contact(loop, rig, run):
    """Return the share of all ticks of all lanes at which the bodies touch."""

    def body(run, _):
        run, seen = tick(loop, rig, run)
        return run, jnp.mean(seen.forces[0].touch.depth > 0)

    return jnp.mean(jax.lax.scan(body, run, None, length=TICKS)[1])


def test_six_axis_simulation_reaches_required_speed_relative_to_cpp_and_mujoco(tmp_path, capsys):
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    source = __file__.replace("test_six_axes.py", "six_axes.cpp")
    subprocess.run(["g++", *FLAGS, source, "-o", str(tmp_path / "six_axes.so")], check=True)
    library = compiled(tmp_path)
    loop, scenario = build_loop_and_scenarios()
    rig = jax.jit(build_rig_constants, static_argnums=0)(loop, {}, scenario)
    run = jax.jit(begin, static_argnums=0)(loop, rig, scenario.start)
    arrays = inputs(loop, rig, run)
    first = arrays["states"].copy()
    problem = Problem(LANES, loop.ring, *(arrays[name].ctypes.data for name in NUMBERS))
    tiles = split_into_tiles(rig), split_into_tiles(run)
    final_states = np.stack(jax.tree.leaves(ticks(loop, *tiles))).reshape(len(first), LANES)
    library.run_ticks(ctypes.byref(problem), TICKS)
    np.testing.assert_allclose(
        final_states, arrays["states"], atol=1e-9 * np.max(np.abs(final_states - first))
    )
    assert np.median(np.abs(final_states - first)[16]) > 0.003  # most chasers have changed their direction

    ours, cpp = [], []
    for _ in range(REPEATS):
        started = time.perf_counter()
        jax.block_until_ready(ticks(loop, *tiles))
        ours.append(time.perf_counter() - started)
        arrays["states"][...] = first
        cpp.append(library.run_ticks(ctypes.byref(problem), TICKS))
    speed, cpp_speed = (LANES * TICKS / min(one) for one in (ours, cpp))
    with capsys.disabled():
        print(
            f"\nsix axes: lane-steps/s over C++: {speed / cpp_speed:.2f} ({speed:.3g} over {cpp_speed:.3g})"
        )
    assert speed >= CPP * cpp_speed
    share = float(share_in_contact(loop, rig, run))
    slow = mujoco_speed(pytest.importorskip("mujoco"), share)
    with capsys.disabled():
        print(f"six axes: lane-steps/s over MuJoCo's steps: {speed / slow:.0f} ({speed:.3g} over {slow:.3g})")
    assert speed >= MUJOCO * slow


def mujoco_speed(mujoco, share):
    """Return the steps per second of two free bodies that touch during the given share of the time."""
    mechanism = load_any("probe-drogue", []).mechanism
    shapes = ('<geom type="box" size="1 1 0.1"/>', '<geom type="sphere" size="0.02" pos="0 0 -1"/>')
    bodies = ""
    for body, shape, height in zip((mechanism.target, mechanism.chaser), shapes, (0.0, 1.125), strict=True):
        full = np.eye(3) * body.inertia
        moments = " ".join(map(str, [*np.diag(full), full[0, 1], full[0, 2], full[1, 2]]))
        bodies += f"""<body pos="0 0 {height}"><freejoint/>{shape}
            <inertial pos="0 0 0" mass="{body.mass}" fullinertia="{moments}"/></body>"""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 0" integrator="Euler" timestep="{mechanism.rig.control_period}"/>
        <worldbody>{bodies}</worldbody></mujoco>"""
    )
    return 1 / sum(part * step_time(mujoco, model, push) for part, push in ((share, 100.0), (1 - share, 0.0)))


def step_time(mujoco, model, push, steps=10_000):
    """Return the time of a step [s] for bodies that are pressed together by the given force [N]."""
    data, seen = mujoco.MjData(model), []
    data.xfrc_applied[1:, 2] = push, -push
    for _ in range(REPEATS):
        started = time.perf_counter()
        mujoco.mj_step(model, data, nstep=steps)
        seen.append(time.perf_counter() - started)
        assert data.ncon == (push > 0)
    return min(seen) / steps
