"""Real-time loop in C with deliberate delays: the report names their cause; a full disk ends only the log."""

import signal
import subprocess
import time

import c99_cases
import numpy as np
import pytest
import rt_loops
import test_rt_loop

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler")
CAUSES = ("woken_late", "plant_too_long", "too_long", "interrupted")
WRAP = "-Wl,--wrap=jaxhil_step"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loop")
    document = test_rt_loop.Result.document
    return rt_loops.compile_loop(
        c99_cases.COMPILER, document, folder, "-O1", WRAP, plant=[rt_loops.SLOW_PLANT]
    )


def run_program(program, *arguments, seconds=0.5, pauses=0, before=()):
    """Run the loop, and stop and continue its process `pauses` times; return exit code, report and errors."""
    command = [*before, program, "--seconds", str(seconds), "--priority", "0", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "open\n"
    time.sleep(0.2 if pauses else 0.0)
    for _ in range(pauses):
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.03)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.05)
    output, errors = process.communicate(timeout=20)
    return process.returncode, rt_loops.read_report(output), errors


@pytest.mark.parametrize(
    ("slow", "cause"), [("read", "plant_too_long"), ("write", "plant_too_long"), ("step", "too_long")]
)
def test_loop_in_c_attributes_overruns_to_plant_or_computation(program, slow, cause):
    code, report, _ = run_program(program, "--slow", slow)
    [overruns] = report[cause]
    assert code == 0 and overruns >= 3
    # Other work on the machine may delay the loop as well, but adds no processor time to its computation.
    assert cause == "too_long" or report["too_long"] == [0]
    assert report["skipped_after"][CAUSES.index(cause)] > 0
    assert sum(report["skipped_after"]) == report["skipped"][0]


def test_loop_in_c_does_not_attribute_a_stopped_process_to_computation(program):
    code, report, _ = run_program(program, seconds=1.0, pauses=6)
    assert code == 0 and report["too_long"] == [0] and report["skipped_after"][2] == 0
    stopped = [report[name][0] for name in CAUSES if name != "too_long"]
    assert sum(stopped) >= 6 and report["skipped"][0] > 6 * 20


def test_loop_in_c_continues_without_log_if_the_disk_is_full(program, tmp_path):
    log = tmp_path / "session.csv"
    limited = ("sh", "-c", 'ulimit -f 10; exec "$@"', "sh")
    code, report, errors = run_program(program, "--log", str(log), before=limited)
    reason = "cannot be written: File too large; the log ends here, the loop continues"
    assert code == 1 and errors == f"rt_loop: {log}: {reason}\n"
    assert report["at_rest"] == [1] and report["ticks"][0] > 200
    rows = np.loadtxt(log, delimiter=",", skiprows=1)
    assert log.read_bytes().endswith(b"\n") and 20 < len(rows) < report["ticks"][0]
    assert (tmp_path / "session.toml").is_file()
