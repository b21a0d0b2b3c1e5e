"""Real-time loop with the simulated rig in C: ticks of `simulate`, complete log, stop on SIGTERM."""

import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import c99_cases
import numpy as np
import pytest
import rt_loops
import test_rt_loop
import test_rt_loop_six_axes
from bundles import LIMITS, document
from six_axis_documents import six_axis_document

import jaxhil
import tuning
from jaxhil.errors import InputError
from jaxhil.mechanism.file import load, load_any
from jaxhil.sixdof.run import simulate_six_axes
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.bundle.checking import check_bundle
from tuning.bundle.writers import rehearsal_files

pytestmark = pytest.mark.skipif(c99_cases.COMPILER is None, reason="no C compiler")

NOISELESS = ("rig.force_sensor.noise_std=0", "rig.position_sensor.noise_std=0")
SIGNALS = ("force_measured", "position_desired", "velocity_desired", "position_measured", "force_command")
RESULTS = {1: test_rt_loop.Result, 6: test_rt_loop_six_axes.RESULT}  # gains with limits, by number of axes


def compile_rehearsal(gains, folder, *options):
    return rt_loops.compile_rehearsal(c99_cases.COMPILER, gains, folder, *options)


def started(program, seconds, priority=0):
    """Start a session with a log beside the program; return its process."""
    arguments = ("--log", program.with_name("session.csv"), "--seconds", seconds, "--priority", priority)
    command = [str(part) for part in (program, *arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finished(process, program: Path):
    """Wait for the end of a session; return its report and the rows of its log."""
    output, errors = process.communicate()
    assert process.returncode == 0, errors
    return rt_loops.read_report(output), np.loadtxt(
        program.with_name("session.csv"), delimiter=",", skiprows=1
    )


def run_session(program, seconds, priority=0):
    return finished(started(program, seconds, priority), program)


def check_one_axis(name, compensator, folder):
    """Check that each tick of the first run is that of `simulate`."""
    gains = document(name, compensator, NOISELESS)
    mechanism = load(name, NOISELESS).mechanism
    values = {name: gain["value"] for name, gain in gains["gains"].items()}
    run = jaxhil.simulate(mechanism, compensator, values)
    expected = np.stack([getattr(run, signal) for signal in SIGNALS], axis=1)[np.asarray(run.contact) == 0]
    seconds = 1.0 + 2.0 * len(expected) * mechanism.rig.control_period
    _, rows = run_session(compile_rehearsal(gains, folder, "-O0"), seconds)
    ticks = rows[: len(expected), 1:6]
    difference = np.max(np.abs(ticks - expected), axis=0) / np.max(np.abs(expected), axis=0)
    assert rows[len(expected) - 1, 6] == 0 and np.all(difference < 1e-9)
    return rows


def test_rehearsal_in_c_repeats_each_tick_of_simulate(tmp_path):
    rows = check_one_axis("rig-300kg", "phase_lead", tmp_path)
    first, second = (rows[rows[:, 6] == number, 1:6] for number in (0, 1))
    assert len(first) > 200 and np.array_equal(first, second)  # without noise, all runs are the same


@pytest.mark.slow
@pytest.mark.parametrize("compensator", ["none", "response_error", "impulse_ledger"])
@pytest.mark.parametrize("name", ["suite-lag", "suite-dead-zone", "layered"])
def test_rehearsal_in_c_repeats_each_tick_of_simulate_with_other_rigs(name, compensator, tmp_path):
    check_one_axis(name, compensator, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("compensator", ["none", "impulse_ledger"])
@pytest.mark.parametrize("name", ["probe-drogue", "ring-capture", "petals"])
def test_rehearsal_in_c_with_six_axes_has_final_twist_of_simulate(name, compensator, tmp_path):
    gains = six_axis_document(compensator, name)
    mechanism: Any = load_any(name).mechanism
    final = simulate_six_axes(
        mechanism, compensator, {name: gain["value"] for name, gain in gains["gains"].items()}
    ).final
    tick = round(final.time / mechanism.rig.control_period)
    _, rows = run_session(compile_rehearsal(gains, tmp_path, "-O1"), 2.0 * final.time + 1.0)
    difference = np.max(np.abs(rows[tick, 13:19] - final.twist))
    print(name, compensator, difference)
    assert difference < 1e-9 < np.max(np.abs(final.twist))


@pytest.mark.slow
@pytest.mark.parametrize("axes", RESULTS)
def test_rehearsal_in_c_stops_on_sigterm_with_the_drives_at_rest(axes, tmp_path):
    program = compile_rehearsal(RESULTS[axes].document, tmp_path, "-O2")
    process = started(program, 60)
    time.sleep(0.5)
    process.send_signal(signal.SIGTERM)
    report, rows = finished(process, program)
    assert report["at_rest"] == [1] and report["lost_rows"] == [0]
    assert 0 < len(rows) < 6000 and np.all(rows[-1, 1 + 4 * axes : 1 + 5 * axes] == 0.0)


def check_shadow(log, rows, result):
    """Check that shadow mode computes the same commands until the stop, which it does not know."""
    ticks = np.argmax(rows[:, -1].astype(int) & test_rt_loop.EMERGENCY_STOP > 0)
    log.write_text("".join(log.read_text().splitlines(keepends=True)[: ticks + 1]))
    document = tuning.shadow(result, log, map=log.with_suffix(".toml")).document
    assert {contact["share"] for contact in document["contacts"]} == {0.0}


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [10, 60, 600])
@pytest.mark.parametrize("axes", RESULTS)
def test_rehearsal_in_c_executes_every_tick_for_minutes(axes, seconds, tmp_path):
    program = compile_rehearsal(RESULTS[axes].document, tmp_path, "-O2")
    report, rows = run_session(program, seconds, priority=80)
    print("\n", axes, "axes:", report)
    [periods], [ticks], [skipped] = report["periods"], report["ticks"], report["skipped"]
    assert report["lost_rows"] == report["without_readings"] == report["not_sent"] == [0]
    assert len(rows) == ticks and sum(report["skipped_after"]) == skipped
    # Each deadline has a period or was skipped; the stop at the end takes further periods.
    assert 0 <= periods + skipped - 1000 * seconds < 5000
    assert report["too_long"][0] <= 1e-4 * ticks  # a virtual machine counts its own pauses as processor time
    assert report["at_rest"] == [1]
    runs = np.unique(rows[:, -2], return_counts=True)[1]
    assert len(runs) >= seconds / 4 and ticks + 150 > periods - len(runs)
    if seconds < 600:
        check_shadow(program.with_name("session.csv"), rows, RESULTS[axes])


@pytest.mark.slow
@pytest.mark.parametrize("axes", RESULTS)
@pytest.mark.parametrize("options", [("-O1", "-g", "-fsanitize=address,undefined"), ("-fsanitize=thread",)])
def test_rehearsal_in_c_has_no_undefined_behaviour_under_sanitizers(axes, options, tmp_path):
    report, _ = run_session(compile_rehearsal(RESULTS[axes].document, tmp_path, *options), 2)
    assert report["ticks"][0] > 100


@pytest.mark.slow
def test_bundle_with_rehearsal_is_valid_and_its_command_compiles(tmp_path):
    files = build_bundle(document(), ["c99", "rehearsal"], LIMITS).files
    write_bundle(tmp_path / "bundle", files)
    assert check_bundle(tmp_path / "bundle").reasons == []
    readme = files["README.md"].decode()
    [command] = [line.strip() for line in readme.splitlines() if "rehearsal/*.c" in line]
    subprocess.run(command, shell=True, check=True, cwd=tmp_path / "bundle")
    report, _ = run_session(tmp_path / "rt_rehearsal", 1)
    assert report["ticks"][0] > 100


def test_rehearsal_in_c_rejects_rig_that_its_fmu_lacks():
    made = document("rig-300kg", overrides=("rig.force_sensor.jitter=0.0005",))
    with pytest.raises(InputError, match=r"rehearsal: rig.force_sensor.jitter: found 0.0005, expected 0"):
        rehearsal_files(made)
