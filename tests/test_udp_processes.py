"""`jaxhil rig` and the controller process: short runs over UDP, interrupts, and rejected input."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import deque
from pathlib import Path

import pytest
from bundles import document, signed
from gain_documents import gain_document, sign

from jaxhil.laws.compensators import literature_gains
from jaxhil.mechanism.file import load
from tuning.bundle.bundle import build_bundle, write_bundle
from tuning.gain_file import build_document, write_gain_file
from tuning.rig import udp_controller

ROOT = Path(__file__).parents[1]


def gain_file(folder, compensator="response_error", limits=None, **values):
    document = gain_document(compensator, **values)
    if limits is not None:
        from jaxhil.rig.limits import LIMITS

        document["limits"] = {name: {"value": v, "unit": LIMITS[name].unit} for name, v in limits.items()}
    path = folder / "gains.json"
    path.write_text(json.dumps(sign(document)))
    return path


@pytest.mark.slow
def test_rig_command_rejects_bundle_with_modified_controller(jaxhil, tmp_path):
    """Only code exported by this version is run."""
    made = build_bundle(document(), [])
    trap = b"open(%r, 'w')\n" % str(tmp_path / "ran")
    folder = tmp_path / "bundle"
    write_bundle(folder, made.files)
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "jaxhil_runtime.cpython-311.pyc").write_bytes(b"of Python's own making")
    arguments = ("rig", folder, "--duration", 0.2, "--json", "--limit", "inf")
    assert jaxhil(*arguments).document["run"]["ticks"] == 200
    for name in (
        "jaxhil_runtime.py",
        "udp_controller.py",
        "udp_protocol.py",
        "numerical_model.py",
        "selftest.py",
    ):
        for other, content in signed({**made.files, name: made.files[name] + trap}, made.document).items():
            (folder / other).write_bytes(content)
        ran = jaxhil(*arguments)
        assert (ran.code, ran.document["schema"]) == (2, "jaxhil/error/1")
        assert f"{name}: differs from what this version exports" in ran.err
    assert not (tmp_path / "ran").exists()


def test_controller_process_without_gain_file_exits_with_error(capfd):
    assert udp_controller.main(["--gains", "nowhere.json"]) == 2
    error = capfd.readouterr().err
    assert "nowhere.json" in error and error.count("\n") == 1


@pytest.mark.slow
def test_rig_command_reports_results_of_a_short_run(jaxhil, tmp_path):
    path = gain_file(tmp_path)
    # One contact under this gain file takes almost a second.
    ran = jaxhil("rig", path, "--duration", 2, "--limit", "inf", "--json", "--plot", tmp_path / "rig.png")
    result = ran.document
    assert result["empty_loop"]["ticks"] == 400 and result["run"]["ticks"] == 2000
    assert (tmp_path / "rig.png").stat().st_size > 10_000
    for loop in (result["empty_loop"], result["run"]):
        missed = [loop[f"missed_by_{cause}"] for cause in ("controller", "injection", "machine")]
        assert sum(missed) == loop["missed"] and missed[1] == 0
        assert loop["controller"]["ended"] == "stopped" and loop["controller"]["jax"] is False
        for name in ("tick_time", "tick_cpu", "round_trip", "lateness"):
            assert 0 < loop[name]["median"] <= loop[name]["p999"] <= loop[name]["maximum"]
    assert result["contacts"] and not result["tripped"] and not result["interrupted"]
    assert result["commanded"]["not_finite"] == result["commanded"]["beyond_limits"] == 0
    for contact in result["contacts"]:
        assert contact["reference_restitution"] == pytest.approx(1.0, abs=1e-9)
        assert contact["error"] == contact["restitution"] - contact["reference_restitution"]
    assert ran.code == (0 if result["verdict"] == "good" else 1)


@pytest.mark.slow
def test_rig_command_with_injected_faults_ends_safely(jaxhil, tmp_path):
    limits = {"command_lowest": -0.01, "command_highest": 0.01, "velocity_limit": 0.05, "deceleration": 1.0}
    limits |= {"held_readings": 3.0, "missed_in_a_row": 5.0, "retreat_velocity": 0.01}
    limits |= {"limited_in_a_row": 5.0, "force_limit": 200.0}
    path = gain_file(tmp_path, limits=limits)
    injected = ("--drops", 0.2, "--delay", 0.003, "--jitter", 0.002)
    ran = jaxhil("rig", path, "--duration", 1, *injected, "--limit", "inf", "--json")
    result = ran.document
    assert result["run"]["missed_by_injection"] > 100
    assert result["stroke"] == [-0.01, 0.01]
    assert -0.01 <= result["commanded"]["lowest"] <= result["commanded"]["highest"] <= 0.01
    assert result["commanded"]["not_finite"] == result["commanded"]["beyond_limits"] == 0


@pytest.mark.slow
def test_rig_verdict_is_bad_if_controller_trips_without_injected_fault(jaxhil, tmp_path):
    limits = {"force_limit": 5.0, "retreat_velocity": 0.01, "deceleration": 1.0}
    path = gain_file(tmp_path, limits=limits)
    ran = jaxhil("rig", path.parent, "--duration", 2, "--limit", "inf")
    assert ran.code == 1
    assert "tripped: force_limit" in ran.out and "though no faults were injected" in ran.out


@pytest.mark.slow
def test_interrupted_rig_command_reports_measurements_so_far(tmp_path):
    path = gain_file(tmp_path)
    # Background jobs of a shell ignore interrupts, and so do their child processes.
    heeding = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from tuning.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", heeding, "rig", str(path), "--duration", "60", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    seen = deque(maxlen=10)
    for line in process.stderr:
        seen.append(line)
        if "empty loop" in line:
            break
    # Interrupt during the empty loop of 12 s: the run is never reached.
    time.sleep(3.0)
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=60)
    assert process.returncode == 130, (seen, error)
    result = json.loads(out)
    assert result["interrupted"] and result["run"] is None
    assert 0 < result["empty_loop"]["ticks"] < 12_000
    assert "Traceback" not in error


@pytest.mark.parametrize(
    "options, words",
    [
        (("nowhere.json",), "nowhere.json"),
        (("GAINS", "--drops", "1"), "--drops: found 1, expected a probability"),
        (("GAINS", "--jitter", "-1"), "--jitter: found -1"),
        (("GAINS", "--delay", "nan"), "--delay: found nan"),
        (("GAINS", "--connect", "0"), "--connect: found 0, expected an integer >= 1"),
        (("GAINS", "--connect", "9", "--rate", "0.004"), "--rate: found 0.004, expected 0.005 to 1 with"),
        (("GAINS", "--duration", "0"), "--duration: found 0, expected 0.001 to 2000 s"),
        (("BROKEN",), "sha256"),
    ],
)
def test_rig_command_rejects_unusable_input(jaxhil, tmp_path, options, words):
    good = gain_file(tmp_path)
    broken = tmp_path / "broken.json"
    broken.write_text(good.read_text().replace("0.005", "0.006"))
    names = {"GAINS": good, "BROKEN": broken}
    ran = jaxhil("rig", *(names.get(option, option) for option in options))
    assert ran.code == 2 and words in ran.err and ran.out == ""
    assert ran.err.strip().count("\n") == 0


def test_process_priority_that_cannot_be_set_is_reported(jaxhil, tmp_path, monkeypatch):
    def refuse(*arguments):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse, raising=False)
    ran = jaxhil("rig", gain_file(tmp_path), "--realtime")
    assert (
        ran.code == 2
        and "--realtime: found no permission for real-time priority (Operation not permitted)" in ran.err
    )


def test_rig_command_help_has_an_example(jaxhil):
    ran = jaxhil("rig", "--help")
    assert ran.code == 0 and "Example: jaxhil rig" in ran.out


def test_rig_loop_runs_without_importing_jax():
    program = (
        "import sys, tuning.cli.commands.rig as command, tuning.rig.session, tuning.rig.session_report\n"
        "assert 'jax' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


@pytest.mark.benchmark
def test_rig_loop_runs_ten_minutes_at_1_khz(jaxhil, tmp_path):
    mechanism, sha256, _ = load("varying")
    gains = literature_gains(mechanism, "response_error")
    path = tmp_path / "gains.json"
    write_gain_file(path, build_document("response_error", gains, mechanism, sha256, {}, {}, 0, {}))
    assert mechanism.rig.control_period == 1e-3
    ran = jaxhil("rig", path, "--duration", 600)
    print(ran.out)
    assert ran.code == 0
