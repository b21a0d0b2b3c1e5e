"""Throughput of the six-axis loop beside C++ and MuJoCo, all in this one process, in turn; the best counts.

The C++ (six_axes.cpp) has the same physics, to rounding. MuJoCo steps the same two bodies, by Euler's method,
with one contact's worth of work: a tendon between them.
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
from jaxhil.simulation.environment import ROLLOUT, known_options
from jaxhil.sixdof.building import build_scenarios, loop_of
from jaxhil.sixdof.loop import begin, build_rig, tick
from jaxhil.sixdof.shapes import Drogue

pytestmark = pytest.mark.benchmark
LANES, TICKS, REPEATS = 64, 600, 25  # lanes of a tile: more do not stay in the caches
CPP, MUJOCO = 0.06, 15.0  # of their speeds; the aim is 0.3 and 30
FLAGS = ("-O3", "-march=native", "-std=c++17", "-fno-math-errno", "-Wno-psabi", "-shared", "-fPIC")
NUMBERS = (
    "period", "bodies", "states", "transition", "rows", "axes", "before", "stride", "command", "intervals",
    "contact", "errors",
)  # fmt: skip


class Problem(ctypes.Structure):
    _fields_ = [(name, ctypes.c_int64) for name in ("lanes", "ring")] + [
        (name, ctypes.c_void_p) for name in NUMBERS
    ]


def prepared():
    """Loop and scenarios of probe-drogue, drawn, with an ideal sensor under a drogue without a rim."""
    mechanism = load_any("probe-drogue", ["rig.force_sensor.noise_std=0.0"]).mechanism
    scenario = build_scenarios(mechanism, draw(mechanism, LANES, 1))
    (group,) = scenario.groups
    shape = group.candidates.shape
    drogue = Drogue(shape.half_angle, shape.bottom_radius, shape.bottom)
    spheres = type(group.candidates)(group.candidates.centre, group.candidates.radius, drogue)
    group = type(group)(spheres, group.law, group.parameters, group.friction)
    loop = loop_of(mechanism, "none", scenario)
    fixed = type(loop)(
        **{name: getattr(loop, name) for name in loop.__dataclass_fields__} | {"side": "fixed"}
    )
    return fixed, scenario._replace(groups=(group,))


def inputs(loop, rig, run):
    """What six_axes.cpp reads, by name."""

    def flat(*trees):
        return np.stack([np.broadcast_to(leaf, (LANES,)) for leaf in jax.tree.leaves(trees)])

    (group,) = rig.groups
    shape, candidates = group.candidates.shape, group.candidates
    drogue = (jnp.sin(shape.half_angle), jnp.cos(shape.half_angle), shape.bottom_radius, shape.bottom)
    law = (group.parameters.stiffness, group.parameters.damping)
    contact = [candidates.radius, *drogue, *law, group.friction.coefficient, group.friction.slip]
    contact += jax.tree.leaves(candidates.centre)
    exact, errors, hardware = rig.axes.propagation, rig.sensor.errors, run.hardware
    rows = [exact.position, exact.velocity]
    bodies = [(body.mass, body.inertia, body.inverse_inertia, body.interface) for body in rig.bodies]
    cut = jnp.stack([errors.bias, errors.quantum, errors.dead_zone, errors.range], axis=1)
    given = {
        "period": rig.period,
        "bodies": flat(*bodies),
        "states": flat(*run.states),
        "transition": exact.transition,
        "rows": jnp.stack(rows),
        "axes": jnp.stack(hardware.state),
        "before": jnp.stack([hardware.before.motion.position, hardware.before.motion.rate]),
        "stride": hardware.stride,
        "command": hardware.commands[0],
        "contact": np.stack([np.broadcast_to(one[0], (LANES,)) for one in contact]),
        "errors": jnp.concatenate([errors.crosstalk, cut], axis=1),
    }
    arrays = {name: np.array(value, float, order="C") for name, value in given.items()}
    return arrays | {"intervals": np.array(rig.axes.force.intervals, np.int64, order="C")}


def compiled(folder):
    library = ctypes.CDLL(str(folder / "six_axes.so"))
    library.run_ticks.argtypes = [ctypes.POINTER(Problem), ctypes.c_int64]
    library.run_ticks.restype = ctypes.c_double
    return library


@partial(jax.jit, static_argnums=0, compiler_options=known_options(ROLLOUT))
def ticks(loop, rig, run):
    return jax.lax.scan(lambda run, _: (tick(loop, rig, run)[0], None), run, None, length=TICKS)[0].states


def test_the_loop_beside_cpp_and_mujoco(tmp_path, capsys):
    if shutil.which("g++") is None:
        pytest.skip("no C++ compiler")
    source = __file__.replace("test_six_axes.py", "six_axes.cpp")
    subprocess.run(["g++", *FLAGS, source, "-o", str(tmp_path / "six_axes.so")], check=True)
    library = compiled(tmp_path)
    loop, scenario = prepared()
    rig = jax.jit(build_rig, static_argnums=0)(loop, {}, scenario)
    run = jax.jit(begin, static_argnums=0)(loop, rig, scenario.start)
    arrays = inputs(loop, rig, run)
    first = arrays["states"].copy()
    problem = Problem(LANES, loop.ring, *(arrays[name].ctypes.data for name in NUMBERS))
    found = np.stack(jax.tree.leaves(ticks(loop, rig, run)))
    library.run_ticks(ctypes.byref(problem), TICKS)
    np.testing.assert_allclose(found, arrays["states"], atol=1e-9 * np.max(np.abs(found - first)))
    assert np.median(np.abs(found - first)[16]) > 0.003  # most chasers were turned back or aside

    ours, cpp = [], []
    for _ in range(REPEATS):
        started = time.perf_counter()
        jax.block_until_ready(ticks(loop, rig, run))
        ours.append(time.perf_counter() - started)
        arrays["states"][...] = first
        cpp.append(library.run_ticks(ctypes.byref(problem), TICKS))
    speed, cpp_speed = (LANES * TICKS / min(one) for one in (ours, cpp))
    with capsys.disabled():
        print(
            f"\nsix axes: lane-steps/s over C++: {speed / cpp_speed:.2f} ({speed:.3g} over {cpp_speed:.3g})"
        )
    assert speed >= CPP * cpp_speed
    mujoco = pytest.importorskip("mujoco")
    slow = mujoco_speed(mujoco)
    with capsys.disabled():
        print(f"six axes: lane-steps/s over MuJoCo's steps: {speed / slow:.0f} ({speed:.3g} over {slow:.3g})")
    assert speed >= MUJOCO * slow


def mujoco_speed(mujoco):
    """Steps/s of two free bodies and a tendon between them, in one thread."""
    body = """<body name="{0}" pos="0 0 {1}"><freejoint/><site name="{0}"/>
        <inertial pos="0 0 0" mass="{2}" diaginertia="1400 1100 800"/></body>"""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option gravity="0 0 0" integrator="Euler" timestep="0.001"/>
            <worldbody>{body.format("a", 0, 1800)}{body.format("b", 2, 420)}</worldbody>
            <tendon><spatial stiffness="1e4" springlength="0 1.9"><site site="a"/><site site="b"/></spatial>
            </tendon></mujoco>"""
    )
    data, seen = mujoco.MjData(model), []
    for _ in range(REPEATS):
        started = time.perf_counter()
        mujoco.mj_step(model, data, nstep=20_000)
        seen.append(time.perf_counter() - started)
    return 20_000 / min(seen)
