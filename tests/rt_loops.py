"""Real-time loop of a bundle in C: compiled, and run against the simulated rig over UDP."""

import signal
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

from tuning.bundle.writers import c99_files
from tuning.rig.loop import PacketTimes, answered_packet_number, build_empty_reading, run_loop
from tuning.rig.network import Injection, Network
from tuning.rig.one_axis_rig import OneAxisRig
from tuning.rig.rig_task import RigTask
from tuning.rig.session import open_session, real_time_priority
from tuning.rig.udp_protocol import MAX_PACKET_NUMBER, STOP, encode_reading

FLAGS = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-pthread"]
SOURCES = ("rt_loop.c", "rt_log.c", "jaxhil_controller.c")
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


def compile_loop(compiler, document, folder: Path, *options: str, plant: str | Path = UDP_PLANT) -> Path:
    """Write the C files of a gain document to the folder, and compile the loop with a plant."""
    for name, text in c99_files(document).items():
        (folder / Path(name).name).write_bytes(text)
    program = folder / "rt_loop"
    sources = [folder / name for name in (*SOURCES, plant)]
    command = [compiler, *FLAGS, *options, f"-I{folder}", "-o", program, *sources, "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    return program


class StoppingTask(RigTask):
    """Rig that sends SIGTERM to the loop at a packet with this number."""

    stop_at, process, stopped = -1, None, 0.0

    def reading(self):
        packet = super().reading()
        if packet.sequence == self.stop_at:
            self.stopped = time.monotonic()
            self.process.send_signal(signal.SIGTERM)
        return packet


def run_on_rig(
    program: Path, mechanism, seconds: float, stop_at: int = -1, priority=0, vanishes: bool = False
) -> Ran:
    """Run the loop against the simulated rig; send SIGTERM at the packet with the number `stop_at`.

    If the rig `vanishes`, it sends no stop packet at its end.
    """
    log, period = program.parent / "session.csv", mechanism.rig.control_period
    command = [str(program), "--log", str(log), "--priority", str(priority)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        port = int(process.stdout.readline().split()[1])
        ticks = round(seconds / period)
        timing, task = PacketTimes(ticks), StoppingTask(OneAxisRig(mechanism, 0), period, None, resets=False)
        task.stop_at, task.process = stop_at, process
        network = Network(("127.0.0.1", port), Injection(), 0, ticks, answered_packet_number)
        session = open_session(network, 1)
        with real_time_priority(priority > 0):
            run_loop(task, network, session, period, timing, lambda done: None)
        if stop_at < 0 and not vanishes:
            stop_packet = build_empty_reading(1, STOP, MAX_PACKET_NUMBER)
            network.send_without_faults(encode_reading(stop_packet, session))
        network.close()
        output, errors = process.communicate(timeout=20)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    return Ran(process.returncode, errors, read_report(output), timing, task, log)


def read_report(output: str) -> dict[str, list[int]]:
    """Return the numbers that the loop has printed, by name."""
    lines = [line.split() for line in output.splitlines() if " " in line]
    return {name: [int(number) for number in numbers] for name, *numbers in lines}
