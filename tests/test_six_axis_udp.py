"""Six-axis rig and controller in lock-step: packets, numerical model, and contacts equal to `simulate`."""

import copy
import functools
import itertools
import math
from random import Random

import c99_cases
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from six_axis_c99 import ControllerInC, controller_of_bundle
from six_axis_documents import LIMITS, six_axis_document

from jaxhil.laws.compensators import SIX_AXIS_COMPENSATORS
from jaxhil.mechanism.file import load_any
from jaxhil.rig import Controller6
from jaxhil.simulation.jax_environment import jax_context
from jaxhil.sixdof.bodies import SHARES, build_body
from jaxhil.sixdof.building import build_scenarios
from jaxhil.sixdof.loop import model_motion
from jaxhil.sixdof.relative import Pair, Wrench, advance
from jaxhil.sixdof.rotations import exponential
from jaxhil.sixdof.run import simulate_six_axes
from jaxhil.sixdof.vectors import matrix, vector
from tuning.rig.numerical_model_six_axes import SixAxisModelInLoop
from tuning.rig.rig_task import RigTask
from tuning.rig.six_axis_rig import SixAxisRig
from tuning.rig.udp_protocol import (
    PREPARE,
    READY,
    TICK,
    AnswerPacket,
    ReadingPacket,
    decode_answer,
    decode_reading,
    encode_answer,
    encode_reading,
)
from tuning.rig.udp_task import MISSED_TICK, ControllerTask

STATE_TOLERANCE = 1e-8  # largest difference, divided by the largest (angular) velocity
MECHANISMS = ("probe-drogue", "ring-capture", "hydraulic-hexapod", "petals", "claw-two-arms")
# Functions that make a controller from a gain document and a folder for C sources; a bundle contains the
# last two controllers.
CONTROLLERS = {
    "package": lambda document, folder: Controller6.from_dict(document),
    "python_file": lambda document, folder: controller_of_bundle(document),
    "c": ControllerInC,
}
# Changes of the mechanism file.
TIMING = ("rig.force_sensor.jitter", 0.002), ("rig.force_sensor.loss_probability", 0.1)
BIAS_WALK = (("rig.force_sensor.bias_random_walk", 0.5),)
CASES = list(itertools.product(MECHANISMS, SIX_AXIS_COMPENSATORS, CONTROLLERS))


@functools.cache
def simulated_rig(mechanism, changes=()):
    """Return a simulated rig, whose programs take seconds to compile."""
    return SixAxisRig(load_any(mechanism, dict(changes)).mechanism)


@functools.cache
def simulated_run(mechanism, compensator, phase=None):
    """Return the run of `simulate` with this phase; None for the nominal phase."""
    changes = {} if phase is None else {"approach.phase": phase}
    return simulate_six_axes(load_any(mechanism, changes).mechanism, compensator)


def exchange(
    mechanism,
    compensator,
    runs,
    delivered=lambda way, packet: [packet],
    limits=None,
    ticks=20_000,
    build=Controller6.from_dict,
    changes=(),
):
    """Exchange packets until this many runs have ended; return rig, controller's task and answers.

    `delivered(way, packet)` returns the packets that arrive when `packet` is sent "there" or "back".
    `build(document)` returns the controller. `changes` contains paths and values of keys of the mechanism.
    """
    document = six_axis_document(compensator, mechanism, limits)
    controller = build(document)
    rig = RigTask(copy.copy(simulated_rig(mechanism, changes)), controller.control_period)
    task = ControllerTask(controller, SixAxisModelInLoop(controller, document["mechanism"]))
    answers = []
    for _ in range(ticks):
        for packet in delivered("there", rig.reading()):
            answer = task.answer(decode_reading(encode_reading(packet, 1), 1, 6))
            if answer is not None:
                answers.append(answer)
                for arrived in delivered("back", decode_answer(encode_answer(answer, 1), 1, 6)):
                    rig.take(arrived)
        rig.advance()
        if len(rig.contacts) == runs or rig.tripped:
            break
    rig.finish()
    return rig, task, answers


@pytest.mark.slow
@pytest.mark.parametrize("name, compensator, controller", CASES)
def test_six_axis_rehearsal_gives_final_twists_and_errors_of_simulate(
    name, compensator, controller, tmp_path
):
    if controller == "c" and c99_cases.COMPILER is None:
        pytest.skip("no C compiler (cc) on this machine")
    mechanism = load_any(name).mechanism
    rig, task, _ = exchange(
        name, compensator, 2, build=lambda document: CONTROLLERS[controller](document, tmp_path)
    )
    assert task.status == "ok" and task.interpolated == task.stale == 0
    first, second = simulated_rig(name).evaluate(rig.contacts)[:2]
    for result, phase in ((first, None), (second, Random(1).random())):
        expected = simulated_run(name, compensator, phase)
        episode = expected.episodes[0]
        assert result["status"] == episode.status and result["touches"] == episode.touches
        assert result["ticks"] == round(expected.final.time / mechanism.rig.control_period)
        for part in (slice(0, 3), slice(3, 6)):
            wanted = np.array(expected.final.twist[part])
            error = np.max(np.abs(np.array(result["final_twist"][part]) - wanted)) / np.max(np.abs(wanted))
            print(name, compensator, controller, error)
            assert error <= STATE_TOLERANCE
        assert result["twist_error"] == pytest.approx(episode.twist_error, abs=1e-7)
        assert result["energy_error"] == pytest.approx(episode.energy_error, abs=1e-6)
        assert result["peak_force"] == pytest.approx(episode.peak_force, rel=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("compensator", ["phase_lead", "impulse_ledger"])
@pytest.mark.parametrize("changes", [TIMING, BIAS_WALK], ids=["timing", "bias walk"])
def test_six_axis_rehearsal_with_drawn_sensor_effects_gives_final_twist_of_simulate(compensator, changes):
    name = "probe-drogue"
    rig, task, _ = exchange(name, compensator, 1, changes=changes)
    assert task.status == "ok" and task.interpolated == task.stale == 0
    (result,) = simulated_rig(name, changes).evaluate(rig.contacts)
    run = simulate_six_axes(load_any(name, dict(changes)).mechanism, compensator)
    final, without = np.array(run.final.twist), np.array(simulated_run(name, compensator).final.twist)
    error = np.max(np.abs(result["final_twist"] - final)) / np.max(np.abs(final))
    print(compensator, error)
    assert error <= STATE_TOLERANCE < 1e-4 < np.max(np.abs(without - final)) / np.max(np.abs(final))


@pytest.mark.slow
def test_six_axis_rig_compensates_for_lost_packets():
    random, name = Random(3), "probe-drogue"
    whole = exchange(name, "impulse_ledger", 1)[0]
    lossy = exchange(
        name, "impulse_ledger", 1, lambda way, packet: [packet] if random.random() > 0.02 else []
    )
    rig, task, answers = lossy
    assert task.interpolated > 3 and task.status == "ok" and not rig.tripped
    assert any(answer.faults & MISSED_TICK for answer in answers)
    evaluate = simulated_rig(name).evaluate
    (result,), (expected,) = evaluate(rig.contacts), evaluate(whole.contacts)
    assert result["status"] == "rebounded"
    assert result["twist_error"] == pytest.approx(expected["twist_error"], abs=0.02)
    assert rig.commanded.not_finite == rig.commanded.beyond_limits == 0


@pytest.mark.slow
def test_failed_channel_trips_six_axis_controller_and_rig_stays_safe():
    count, name = 0, "probe-drogue"

    def broken(way, packet):
        nonlocal count
        count += way == "there"
        if way == "there" and count > 60:
            packet = packet._replace(force=(*packet.force[:4], math.nan, packet.force[5]))
        return [packet]

    limits = {**LIMITS, "tare_ticks": None}
    rig, task, answers = exchange(name, "impulse_ledger", 1, broken, {k: v for k, v in limits.items() if v})
    assert "force_not_finite" in rig.tripped and "my" in rig.tripped and task.status == rig.tripped
    assert [contact.status for contact in rig.contacts] == ["tripped"]
    (result,) = simulated_rig(name).evaluate(rig.contacts)
    assert result["status"] == "tripped"
    assert all(map(math.isfinite, answers[-1].position_command))


def a_reading(tick, **changes):
    start = copy.copy(simulated_rig("probe-drogue")).prepare(None)
    pose = (0.0, 0.0, 0.6, 0.0, 0.0, 0.0)
    packet = ReadingPacket(TICK, tick + 10, 1, tick, 0.001 * tick, (0.0,) * 6, pose, start)
    return packet._replace(**changes)


def new_task():
    document = six_axis_document("none")
    controller = Controller6.from_dict(document)
    return ControllerTask(controller, SixAxisModelInLoop(controller, document["mechanism"]))


@pytest.mark.parametrize("index, value", [(0, math.nan), (20, math.inf), (6, 0.5)])
def test_packet_with_invalid_start_state_of_bodies_is_dropped(index, value):
    task, start = new_task(), list(a_reading(0).start)
    start[index] = value
    assert task.answer(a_reading(0, event=PREPARE, start=tuple(start), sequence=1)) is None
    assert task.stale == 1
    assert task.answer(a_reading(0)) is None
    answer = task.answer(a_reading(0, event=PREPARE, sequence=20))
    assert answer.flags == READY and answer.bodies == a_reading(0).start


NUMBER = st.floats(width=64)


@settings(deadline=None, max_examples=40)
@given(
    st.lists(
        st.tuples(st.integers(0, 30), *[st.tuples(*[NUMBER] * 6)] * 2, st.floats(-1e3, 1e3)), max_size=12
    )
)
def test_any_readings_of_a_six_axis_rig_are_answered_with_finite_commands(readings):
    task = new_task()
    assert task.answer(a_reading(0, event=PREPARE, sequence=1)).flags == READY
    for number, (tick, force, position, time) in enumerate(readings):
        packet = a_reading(tick, force=force, position=position, time=time, sequence=2 + number)
        answer = task.answer(packet)
        if answer is not None:
            for values in (answer.position_command, answer.force_command):
                assert all(map(math.isfinite, values))
            assert isinstance(answer, AnswerPacket) and encode_answer(answer, 1)


@pytest.mark.parametrize("integrator", SHARES)
def test_six_axis_numerical_model_equals_simulated_model(integrator):
    """Use bodies with full inertia and rotated interfaces, and arbitrary states and wrenches."""
    random, period = np.random.default_rng(5), 0.01
    mechanism, bodies, start = {"rig": {"control_period": period, "integrator": integrator}}, [], []
    for name in ("target", "chaser"):
        axes = Rotation.from_rotvec(random.normal(size=3)).as_matrix()
        inertia = axes @ np.diag([120.0, 150.0, 180.0]) @ axes.T
        mass, interface, rotation = random.uniform(100, 900), random.normal(size=3), random.normal(size=3)
        mechanism[name] = {
            "mass": mass,
            "inertia": inertia.tolist(),
            "interface": interface.tolist(),
            "interface_rotation": rotation.tolist(),
        }
        quaternion = Rotation.from_rotvec(random.normal(size=3)).as_quat()[[3, 0, 1, 2]]
        start += [*random.normal(size=6), *quaternion, *(50 * random.normal(size=3))]
        with jax_context():
            turned = exponential(vector(rotation[:, None]))
            parts = matrix(inertia[..., None]), vector(interface[:, None]), turned
            bodies.append(build_body(np.array([mass]), *parts))
    model = SixAxisModelInLoop(None, mechanism)
    assert model.place(start) and model.bodies == tuple(start)
    with jax_context():
        structure = jax.tree.structure(build_scenarios(load_any("probe-drogue").mechanism).start)
        states, pair = structure.unflatten([np.array([value]) for value in start]), Pair(*bodies)
        for _ in range(5):
            wrench = 300 * random.normal(size=(6, 1))
            model.force = tuple(wrench[:, 0].tolist())
            model.coast()
            load = Wrench(vector(wrench[:3]), vector(wrench[3:]))
            states = advance(pair, states, load, np.array([period]), SHARES[integrator])
        expected = np.concatenate(jax.tree.leaves(states))
        pose, rates, twist = (np.asarray(part)[:, 0] for part in model_motion(pair, states))
    np.testing.assert_allclose(model.bodies, expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(model.motion, (pose, twist), rtol=1e-11, atol=1e-12)
    assert np.linalg.norm(pose[3:]) > 1.0
    # The rates of the rotation are a power series.
    np.testing.assert_allclose(model.rate, rates, rtol=0.1, atol=0.3)
