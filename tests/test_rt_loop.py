"""Real-time loop in C: complete log, equal commands in shadow mode, and force command 0 after SIGTERM."""

import signal
import subprocess

import bundles
import c99_cases
import numpy as np
import pytest
import rt_loops
from gain_documents import sign

import tuning
from jaxhil.mechanism.file import from_plain_data
from jaxhil.rig import Controller
from jaxhil.rig.faults import FAULTS
from tuning.rig.numerical_model import OneAxisModelInLoop
from tuning.rig.one_axis_rig import OneAxisRig
from tuning.rig.rig_task import RigTask

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler")


LIMITS = {
    "deceleration": {"value": 1.0, "unit": "m/s^2"},
    "retreat_velocity": {"value": 0.01, "unit": "m/s"},
    "velocity_limit": {"value": 0.1, "unit": "m/s"},
}
EMERGENCY_STOP = next(fault.bit for fault in FAULTS if fault.name == "emergency_stop")


class Result:
    """Stand-in for a result of `tuning.tune`: gains with the limits that a stop needs."""

    document = sign(bundles.document("rig-300kg", "phase_lead") | {"limits": LIMITS})


MECHANISM = from_plain_data(Result.document["mechanism"], "gains")
PERIOD = MECHANISM.rig.control_period


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return rt_loops.compile_loop(c99_cases.COMPILER, Result.document, tmp_path_factory.mktemp("loop"), "-O1")


@pytest.fixture
def folder(program, tmp_path):
    """Return the program in a folder without a log."""
    (tmp_path / "rt_loop").symlink_to(program)
    return tmp_path / "rt_loop"


def read_log(ran):
    return np.loadtxt(ran.log, delimiter=",", skiprows=1)


def check_log(ran):
    """Check that the log has every tick of each run, and that shadow mode computes the same commands."""
    rows = read_log(ran)
    [lost], [ticks] = ran.report["lost_rows"], ran.report["ticks"]
    assert lost == 0 and len(rows) >= ticks > 0
    check_shadow(ran)
    return rows


def check_shadow(ran):
    """Check that the controller's commands in shadow mode equal those in the log."""
    document = tuning.shadow(Result, ran.log, map=ran.log.with_suffix(".toml")).document
    assert {contact["share"] for contact in document["contacts"]} == {0.0}


def rig():
    """Return a simulated rig."""
    return RigTask(OneAxisRig(MECHANISM, 0), PERIOD)


def test_loop_in_c_gives_answers_of_python_process(folder):
    controller = Controller.from_dict(Result.document)
    model = OneAxisModelInLoop(controller, Result.document["mechanism"])
    ran = rt_loops.check_answers_of_python_process(folder, controller, model, (-0.05, 0.008))
    trips = {answer.trip_reason for answer in ran.answers}
    assert trips == {"", "tripped: velocity_limit", "tripped: force_not_finite"}


def test_loop_in_c_stops_on_sigterm_with_the_drives_at_rest(folder):
    task = rig()
    ran = rt_loops.run_in_lock_step(folder, rt_loops.readings_of(task), 1, task.take, stop_at=120)
    assert ran.code == 0 and ran.report["at_rest"] == [1]
    assert task.tripped == "tripped: emergency_stop"
    rows = read_log(ran)
    stopped = int(np.argmax(rows[:, 7].astype(int) & EMERGENCY_STOP > 0))
    assert 100 < stopped < 120 and np.max(rows[:stopped, 5]) > 1.0 and rows[-1, 5] == 0.0
    lines = ran.log.read_text().splitlines(keepends=True)
    ran.log.write_text("".join(lines[: stopped + 1]))
    check_shadow(ran)


def test_loop_in_c_exits_with_0_if_sigterm_arrives_before_the_rig(folder):
    with rt_loops.started_loop(folder) as (process, _, _):
        process.send_signal(signal.SIGTERM)
        output, errors = process.communicate(timeout=20)
    assert process.returncode == 0 and errors == "" and rt_loops.read_report(output)["at_rest"] == [1]


@pytest.mark.slow
def test_loop_in_c_exits_with_1_if_it_loses_the_plant(folder):
    ran = rt_loops.run_on_rig(folder, OneAxisRig(MECHANISM, 0), PERIOD, 0.1, vanishes=True)
    assert ran.code == 1
    assert ran.errors.splitlines()[-1] == "rt_loop: plant: found no readings for 2 s, expected some"


def test_loop_in_c_rejects_wrong_options(program, tmp_path):
    for arguments, words in (
        (["--lag", "x.csv"], "--lag: unknown option"),
        (["--log"], "--log: found no value"),
        (["--log", "x.txt"], "expected a name that ends in .csv"),
        (["--log", str(tmp_path / "no" / "x.csv")], "cannot be created"),
    ):
        done = subprocess.run([program, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [60, 600])
def test_loop_in_c_completes_run_of_several_minutes(folder, seconds):
    ran = rt_loops.run_on_rig(folder, OneAxisRig(MECHANISM, 0), PERIOD, float(seconds), priority=80)
    print("\n", {name: values for name, values in ran.report.items()}, "rig's packets late by up to",
          1e-9 * max(ran.timing.late), "s")  # fmt: skip
    assert ran.code == 0 and ran.task.tripped == ""
    rows = check_log(ran)
    contacts = [contact for contact in ran.task.contacts if contact.status == "ok"]
    assert len(contacts) > seconds and np.max(rows[:, 6]) + 1 >= len(contacts)
    if ran.timing.clock_shift == 0:
        assert len(rows) >= 0.9 * seconds / PERIOD


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [("-O2",), ("-O1", "-g", "-fsanitize=address,undefined"), ("-fsanitize=thread",)]
)
def test_loop_in_c_has_no_undefined_behaviour_under_sanitizers(tmp_path, options):
    program = rt_loops.compile_loop(c99_cases.COMPILER, Result.document, tmp_path, *options)
    ran = rt_loops.run_on_rig(program, OneAxisRig(MECHANISM, 0), PERIOD, 3.0)
    assert ran.code == 0
    check_log(ran)
