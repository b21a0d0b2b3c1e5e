"""Real-time loop of a bundle in C: compiled, and run against the simulated rig over UDP."""

import signal
import socket
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tuning.bundle.writers import c99_files, rehearsal_files
from tuning.rig.loop import PacketTimes, answered_packet_number, build_empty_reading, run_loop
from tuning.rig.network import Injection, Network
from tuning.rig.rig_task import RigTask
from tuning.rig.session import open_session, real_time_priority
from tuning.rig.udp_protocol import (
    MAX_PACKET_NUMBER,
    PREPARE,
    RESET,
    STOP,
    TICK,
    AnswerPacket,
    ReadingPacket,
    decode_answer,
    decode_opening,
    encode_answer,
    encode_reading,
    encode_session_request,
)
from tuning.rig.udp_task import ControllerTask

FLAGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-pthread"]
SOURCES = ("rt_loop.c", "rt_task.c", "rt_model.c", "rt_log.c", "jaxhil_controller.c")
UDP_PLANT = "rt_plant_udp.c"
SLOW_PLANT = Path(__file__).with_name("slow_plant.c")


class Ran(NamedTuple):
    """Result of the program: exit code, standard error, its report, and the rig's packets and contacts."""

    code: int
    errors: str
    report: dict[str, list[int]]
    timing: PacketTimes
    task: RigTask
    log: Path


def compile_loop(
    compiler, document, folder: Path, *options: str, plant: Sequence[str | Path] = (UDP_PLANT,)
) -> Path:
    """Write the C files of a gain document to the folder, and compile the loop with the files of a plant."""
    for name, text in c99_files(document).items():
        (folder / Path(name).name).write_bytes(text)
    program = folder / "rt_loop"
    sources = [folder / name for name in (*SOURCES, *plant)]
    command = [compiler, *FLAGS, *options, f"-I{folder}", "-o", program, *sources, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return program


def compile_rehearsal(compiler, document, folder: Path, *options: str) -> Path:
    """Compile the loop with the simulated rig in C."""
    files = {Path(name).name: content for name, content in rehearsal_files(document).items()}
    for name, content in files.items():
        (folder / name).write_bytes(content)
    plant = [name for name in files if name.endswith(".c")]
    return compile_loop(compiler, document, folder, *options, plant=plant)


@contextmanager
def started_loop(program: Path, priority: int = 0):
    """Context manager: start the loop with a log beside it; yield its process, the log and the UDP port."""
    log = program.parent / "session.csv"
    command = [str(program), "--log", str(log), "--priority", str(priority)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process, log, int(process.stdout.readline().split()[1])
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def run_on_rig(program: Path, rig, period: float, seconds: float, priority=0, vanishes: bool = False) -> Ran:
    """Run the loop in real time against the simulated rig; if it `vanishes`, it sends no stop packet."""
    with started_loop(program, priority) as (process, log, port):
        ticks = round(seconds / period)
        timing, task = PacketTimes(ticks), RigTask(rig, period, None, resets=False)
        network = Network(("127.0.0.1", port), Injection(), 0, ticks, answered_packet_number)
        session = open_session(network, rig.axes)
        with real_time_priority(priority > 0):
            run_loop(task, network, session, period, timing, lambda done: None)
        if not vanishes:
            stop_packet = build_empty_reading(rig.axes, STOP, MAX_PACKET_NUMBER)
            network.send_without_faults(encode_reading(stop_packet, session))
        network.close()
        output, errors = process.communicate(timeout=20)
    return Ran(process.returncode, errors, read_report(output), timing, task, log)


class LockStep(NamedTuple):
    """Result of the program in lock-step: exit code, its report, its answers and its log."""

    code: int
    report: dict[str, list[int]]
    answers: list[AnswerPacket]
    log: Path


def run_in_lock_step(
    program: Path,
    readings: Iterable[ReadingPacket],
    axes: int,
    take: Callable[[AnswerPacket], Any] = lambda answer: None,
    stop_at: int | None = None,
) -> LockStep:
    """Send readings to the loop, and wait for each answer, so that the load of the computer has no effect.

    Args:
        program: compiled loop.
        readings: readings, each generated after the answer to the one before it.
        axes: number of axes.
        take: function that receives each answer.
        stop_at: number of the packet before which the loop gets SIGTERM; readings then end with the loop.
    """
    answers = []
    with started_loop(program) as (process, log, port), socket.socket(type=socket.SOCK_DGRAM) as rig:
        rig.connect(("127.0.0.1", port))
        rig.settimeout(0.02)
        rig.send(encode_session_request(1, axes))
        session = decode_opening(_receive(rig, process), 1).session
        for number, reading in enumerate(readings):
            if number == stop_at:
                process.send_signal(signal.SIGTERM)
            rig.send(encode_reading(reading, session))
            packet = _receive(rig, process)
            if not packet:
                break
            answers.append(decode_answer(packet, session, axes))
            take(answers[-1])
        if stop_at is None:
            rig.send(encode_reading(build_empty_reading(axes, STOP, MAX_PACKET_NUMBER), session))
        output, errors = process.communicate(timeout=20)
    assert "found no readings" not in errors
    return LockStep(process.returncode, read_report(output), answers, log)


def _receive(rig: socket.socket, process: subprocess.Popen) -> bytes:
    """Wait for a packet of the loop; return nothing if the loop has ended without sending one."""
    while True:
        has_ended = process.poll() is not None
        try:
            return rig.recv(1024)
        except (TimeoutError, ConnectionRefusedError):
            if has_ended:
                return b""


def readings_of(rig: RigTask, until: Callable[[], bool] = lambda: False) -> Iterator[ReadingPacket]:
    """Yield the readings of a simulated rig in lock-step, until a condition holds or it has no answers."""
    while not until():
        yield rig.reading()
        rig.advance()


# Runs of `check_answers_of_python_process`: event of the preparation, and ticks with readings. Missing ticks
# are interpolated in run 1 and before the first tick of run 2; in run 2, a long gap follows.
RUNS = (
    (PREPARE, (*range(40), *range(44, 70))),
    (PREPARE, (*range(3, 30), *range(50, 60))),
    (RESET, tuple(range(70))),
    (RESET, tuple(range(20))),
)


def draw_readings(model: Any, start: Sequence[float]) -> Iterator[ReadingPacket]:
    """Yield readings for `RUNS`: noise and a push; the drives follow the model's command; NaN in run 3."""
    random, axes, first = np.random.default_rng(1), model.axes, 0
    for run, (event, ticks) in enumerate(RUNS, 1):
        for number in range(-5, len(ticks)):
            tick = max(0, ticks[number] if number >= 0 else 0)
            push = 20.0 * max(0.0, np.sin((tick - 20) / 10))
            force = (push + 0.1 * random.normal(size=axes)).tolist()
            if run == 3 and tick > 30:
                force[-1] = np.nan
            time = 1e-3 * (first + number if number < 0 else first + tick)
            kind = event if number < 0 else TICK
            yield ReadingPacket(
                kind, first + number + 5, run, tick, time, tuple(force), model.command, tuple(start)
            )
        first += 100


def check_answers_of_python_process(
    program: Path, controller: Any, model: Any, start: Sequence[float]
) -> LockStep:
    """Check that the loop's answers equal those of `udp_controller.py`, bit for bit; return its result."""
    task, expected = ControllerTask(controller, model), []

    def readings():
        for reading in draw_readings(model, start):
            expected.append(task.answer(reading))
            yield reading

    ran = run_in_lock_step(program, readings(), model.axes)
    assert ran.code == 0 and ran.report["lost_rows"] == [0] and len(ran.answers) == len(expected) > 200
    for number, answers in enumerate(zip(ran.answers, expected, strict=True)):
        # The reason for a trip has other words.
        one, other = (encode_answer(answer._replace(trip_reason=""), 1) for answer in answers)
        assert one == other, f"answer {number}: {answers}"
    return ran


def read_report(output: str) -> dict[str, list[int]]:
    """Return the numbers that the loop has printed, by name."""
    lines = [line.split() for line in output.splitlines() if " " in line]
    return {name: [int(number) for number in numbers] for name, *numbers in lines}
