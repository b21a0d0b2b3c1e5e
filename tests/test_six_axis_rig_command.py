"""`jaxhil rig` with six axes: short run over UDP, wrong gain files, and an ended controller process."""

import copy
import json
import socket
import subprocess
import sys

import pytest
from gain_documents import gain_document, sign
from six_axis_documents import six_axis_document
from test_six_axis_udp import simulated_rig

from jaxhil.errors import InputError
from jaxhil.mechanism.file import load_any
from tuning.bundle.content import code_files
from tuning.rig import loop
from tuning.rig.network import Injection, Network
from tuning.rig.session import (
    SOURCE_FOLDER,
    SessionSettings,
    open_session,
    read_listening_port,
    run_session,
    start_controller,
)

NAME = "probe-drogue"


@pytest.fixture
def gains(tmp_path):
    path = tmp_path / "gains.json"
    path.write_text(json.dumps(six_axis_document("impulse_ledger", NAME)))
    return path


@pytest.mark.slow  # two runs of 600 ticks in two processes
def test_six_axis_rig_command_reports_results_of_a_short_run(jaxhil, gains):
    ran = jaxhil("rig", gains, "--duration", 0.6, "--limit", "inf", "--json", "--seed", 3)
    result = ran.document
    assert result["axes"] == 6 and result["run"]["ticks"] <= 600 and result["empty_loop"]["ticks"] == 120
    controller = result["run"]["controller"]
    assert controller["ended"] == "stopped" and controller["jax"] is False and controller["ignored"] == 0
    assert len(result["stroke"][0]) == len(result["commanded"]["lowest"]) == 6
    assert result["commanded"]["not_finite"] == 0 and not result["interrupted"]
    for contact in result["contacts"]:
        assert len(contact["final_twist"]) == 6 and contact["status"] in ("rebounded", "stalled", "tripped")
    assert ran.code == (0 if result["verdict"] == "good" else 1)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"axes": 1}, "mechanism: found 6 axes, expected 1 like the controller"),
        ({"mechanism": gain_document("none")["mechanism"]}, "mechanism: found 1 axes, expected 6"),
        ({"axes": 3}, "mechanism: found 6 axes, expected 1 like the controller"),
        ({"constants": None}, "constants: found null, expected an object"),
    ],
)
def test_rig_command_rejects_gains_for_another_number_of_axes(jaxhil, tmp_path, change, words):
    path = tmp_path / "gains.json"
    document = {**six_axis_document("impulse_ledger", NAME), **change}
    path.write_text(json.dumps(sign(document)))
    ran = jaxhil("rig", path)
    assert ran.code == 2 and ran.out == "" and words in ran.err, ran.err
    assert ran.err.strip().count("\n") == 0


@pytest.mark.parametrize("axes, other", [(1, 6), (6, 1)])
def test_controller_process_rejects_gains_for_another_number_of_axes(tmp_path, axes, other):
    documents = {1: gain_document("none"), 6: six_axis_document("none", NAME)}
    for name, content in code_files("none", axes).items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "gains.json").write_text(json.dumps(documents[other]))
    command = [sys.executable, "-I", "udp_controller.py"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 2 and ran.stdout == ""
    assert f"gains.json: axes: found {other}, expected {axes}" in ran.stderr
    assert ran.stderr.strip().count("\n") == 0


def test_rig_rejects_controller_with_another_number_of_axes(gains):
    process = start_controller(SOURCE_FOLDER, ["--gains", str(gains), "--silence", "0.2", "--wait", "5"])
    try:
        address = "127.0.0.1", read_listening_port(process)
        network = Network(address, Injection(), 0, 1, loop.answered_packet_number)
        with pytest.raises(InputError, match="controller's axes: found 6, expected 1 like the rig"):
            open_session(network, 1)
    finally:
        process.kill()
        process.wait()
        process.communicate()


@pytest.mark.slow
def test_killed_controller_ends_session_with_one_line_and_holds_the_command(gains, tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "MAX_SILENCE", 0.2)
    mechanism, rig, commands = load_any(NAME).mechanism, copy.copy(simulated_rig(NAME)), []
    started = []

    def start(*arguments):
        started.append(start_controller(*arguments))
        return started[0]

    def move(self, answer, command):
        commands.append(command)
        if len(commands) == 100:
            started[0].kill()
        return advance(self, answer, command)

    advance = type(rig).advance
    monkeypatch.setattr("tuning.rig.session.start_controller", start)
    monkeypatch.setattr(type(rig), "advance", move)
    low, high = (-10.0,) * 6, (10.0,) * 6
    setup = SessionSettings(SOURCE_FOLDER, gains, mechanism, (low, high), 60.0, 0.0, Injection(), 0)
    with pytest.raises(InputError, match="the controller's process exited without writing its record"):
        run_session(setup, rig, tmp_path, lambda text: None, lambda done, total: None)
    assert len(commands) > 150 and commands[-1] == commands[-20]


@pytest.mark.slow
def test_one_axis_packets_are_ignored_by_six_axis_controller(gains):
    from rig_lock_step import a_reading

    from tuning.rig.udp_protocol import decode_opening, encode_reading, encode_session_request

    process = start_controller(SOURCE_FOLDER, ["--gains", str(gains), "--silence", "0.3", "--wait", "3"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rig:
        rig.settimeout(10)
        rig.connect(("127.0.0.1", read_listening_port(process)))
        rig.send(encode_session_request(5, 1))
        opening = decode_opening(rig.recv(1000), 5)
        assert opening.axes == 6
        for packet in (encode_reading(a_reading(0), opening.session), b"\0" * 7, b"JHrd" + b"\xff" * 400):
            rig.send(packet)
        rig.settimeout(0.3)
        with pytest.raises(TimeoutError):
            rig.recv(1000)
    assert process.wait(20) == 1
    process.communicate()
