"""Real-time loop in C with six axes: answers of the Python process, contacts of `simulate`, log, SIGTERM."""

import c99_cases
import numpy as np
import pytest
import rt_loops
from gain_documents import sign
from six_axis_documents import LIMITS, six_axis_document

import tuning
from jaxhil.mechanism.file import load_any
from jaxhil.mechanism.six_axes import SixAxisMechanism
from jaxhil.rig.six_axes import Controller6
from jaxhil.rig.six_axes.faults import SIX_AXIS_FAULTS
from jaxhil.sixdof.run import simulate_six_axes
from tuning.rig.numerical_model_six_axes import SixAxisModelInLoop
from tuning.rig.rig_task import RigTask
from tuning.rig.six_axis_rig import SixAxisRig
from tuning.rig.udp_protocol import PREPARE, READY, TARING, TICK, TRIPPED, ReadingPacket

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler")

NAME = "probe-drogue"
EMERGENCY_STOP = next(fault.bit for fault in SIX_AXIS_FAULTS if fault.name == "emergency_stop")
COMMANDS = slice(25, 31)  # columns of the wrench commands in the log
# Limits that drives without lag, or readings without contact, exceed.
WITHOUT = ("missed_in_a_row", "lag_lowest", "lag_highest", "unpaid_impulse", "momentum_error", "energy_gain")
TWIST_TOLERANCE = 1e-8  # largest difference, divided by the largest (angular) velocity


class Result:
    """Stand-in for a result of `tuning.tune`: gains with limits that the readings of these tests keep."""

    def __init__(self, *without: str) -> None:
        limits = {name: value for name, value in LIMITS.items() if name not in (*WITHOUT, *without)}
        self.document = six_axis_document("impulse_ledger", NAME, limits)


RESULT = Result()


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return rt_loops.compile_loop(c99_cases.COMPILER, RESULT.document, tmp_path_factory.mktemp("loop"), "-O0")


@pytest.fixture
def folder(program, tmp_path):
    """Return the program in a folder without a log."""
    (tmp_path / "rt_loop").symlink_to(program)
    return tmp_path / "rt_loop"


def start_of(document):
    """Return the states of both bodies 50 mm before the contact: they approach slowly and turn."""
    target, chaser = (document["mechanism"][name]["interface"] for name in ("target", "chaser"))
    states = np.zeros((2, 13))
    states[:, 6] = 1.0
    states[1, :3] = np.subtract(target, chaser) + np.array([0.0, 0.0, 0.05])
    states[1, 3:6] = [0.001, -0.002, -0.02]
    states[:, 10:] = [[2.0, -1.0, 0.5], [0.3, 0.2, -0.1]]
    return tuple(states.ravel().tolist())


def check_answers(program, document=RESULT.document):
    """Check the loop's answers; return its result."""
    controller = Controller6.from_dict(document)
    model = SixAxisModelInLoop(controller, document["mechanism"])
    return rt_loops.check_answers_of_python_process(program, controller, model, start_of(document))


def build_rig():
    """Return the mechanism, its simulated rig, and a series of runs on this rig."""
    mechanism = load_any(NAME).mechanism
    assert isinstance(mechanism, SixAxisMechanism)
    rig = SixAxisRig(mechanism)
    return mechanism, rig, RigTask(rig, mechanism.rig.control_period)


def check_shadow(log, result=RESULT):
    """Check that the controller's commands in shadow mode equal those in the log."""
    document = tuning.shadow(result, log, map=log.with_suffix(".toml")).document
    assert {contact["share"] for contact in document["contacts"]} == {0.0}


def check_stop(ran):
    """Check that the loop has stopped with the drives at rest, and without a command to the model."""
    assert ran.code == 0 and ran.report["at_rest"] == [1]
    rows = np.loadtxt(ran.log, delimiter=",", skiprows=1)
    stopped = int(np.argmax(rows[:, -1].astype(int) & EMERGENCY_STOP > 0))
    assert np.max(np.abs(rows[:stopped, COMMANDS])) > 1.0 and np.all(rows[-1, COMMANDS] == 0.0)
    poses = np.array([answer.position_command for answer in ran.answers])
    assert np.all(poses[-1] == poses[-2])


def test_six_axis_loop_in_c_gives_answers_of_python_process(folder):
    ran = check_answers(folder)
    trips = {answer.trip_reason for answer in ran.answers}
    assert trips == {"", "tripped: velocity_limit", "tripped: force_not_finite"}
    assert {TARING, READY, TRIPPED} <= {answer.flags for answer in ran.answers}
    check_shadow(ran.log)


def test_six_axis_loop_in_c_stops_on_sigterm_with_the_drives_at_rest(folder):
    start, answers = start_of(RESULT.document), []

    def readings():
        for number in range(2000):
            event, tick = (PREPARE, 0) if number < 8 else (TICK, number - 8)
            pose = answers[-1].position_command if answers else (0.0,) * 6
            wrench = (0.0, 0.0, 20.0 * min(1.0, tick / 20), 0.0, 0.0, 0.0)
            yield ReadingPacket(event, number, 1, tick, 1e-3 * number, wrench, pose, start)

    check_stop(rt_loops.run_in_lock_step(folder, readings(), 6, answers.append, stop_at=60))


@pytest.mark.slow
def test_six_axis_loop_in_c_gives_final_twist_of_simulate(tmp_path):
    # `simulate` has no tare, which here measures a bias of a millinewton.
    result = Result("tare_ticks", "tare_force_spread", "tare_torque_spread")
    program = rt_loops.compile_loop(c99_cases.COMPILER, result.document, tmp_path, "-O2")
    mechanism, rig, task = build_rig()
    ran = rt_loops.run_in_lock_step(
        program, rt_loops.readings_of(task, lambda: len(task.contacts) == 1), 6, task.take
    )
    assert ran.code == 0 and task.tripped == ""
    check_shadow(ran.log, result)
    run, expected = rig.evaluate(task.contacts)[0], simulate_six_axes(mechanism, "impulse_ledger")
    assert run["status"] == expected.episodes[0].status
    for part in (slice(0, 3), slice(3, 6)):
        twist = np.array(expected.final.twist[part])
        error = np.max(np.abs(np.array(run["final_twist"][part]) - twist)) / np.max(np.abs(twist))
        print(error)
        assert error <= TWIST_TOLERANCE


@pytest.mark.slow
def test_six_axis_loop_in_c_stops_in_contact_with_the_drives_at_rest(folder):
    _, _, task = build_rig()
    check_stop(rt_loops.run_in_lock_step(folder, rt_loops.readings_of(task), 6, task.take, stop_at=120))
    assert task.tripped == "tripped: emergency_stop"


@pytest.mark.slow
def test_six_axis_loop_in_c_runs_in_real_time_with_complete_log(folder):
    mechanism, rig, _ = build_rig()
    ran = rt_loops.run_on_rig(folder, rig, mechanism.rig.control_period, 10.0, priority=80)
    print("\n", ran.report, ran.task.tripped)
    [lost], [ticks] = ran.report["lost_rows"], ran.report["ticks"]
    rows = np.loadtxt(ran.log, delimiter=",", skiprows=1)
    assert ran.code == 0 and lost == 0 and len(rows) >= ticks > 0
    check_shadow(ran.log)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [("-O2",), ("-O1", "-g", "-fsanitize=address,undefined"), ("-fsanitize=thread",)]
)
def test_six_axis_loop_in_c_has_no_undefined_behaviour_under_sanitizers(tmp_path, options):
    check_answers(rt_loops.compile_loop(c99_cases.COMPILER, RESULT.document, tmp_path, *options))


@pytest.mark.slow
@pytest.mark.parametrize("compensator", ["none", "impulse_ledger"])
@pytest.mark.parametrize(
    ("name", "integrator"),
    [
        ("ring-capture", "zoh"),
        ("hydraulic-hexapod", "explicit_euler"),
        ("petals", "semi_implicit_euler"),
        ("claw-two-arms", "zoh"),
    ],
)
def test_six_axis_loop_in_c_has_model_of_mechanism(tmp_path, name, integrator, compensator):
    document = six_axis_document(compensator, name)
    document["mechanism"]["rig"]["integrator"] = integrator
    document["mechanism"]["chaser"]["interface_rotation"] = [0.2, -0.1, 0.3]
    document = sign(document)
    check_answers(rt_loops.compile_loop(c99_cases.COMPILER, document, tmp_path, "-O2"), document)
