"""Session of a rehearsal: an empty loop for comparison, then a run of the controller on the simulated rig.

This code runs in the rig's process. It starts the controller's process, simulates the rig, and stops the
controller's process. After the session, it determines the cause of each missed tick:

- the controller, if it used more CPU time than the fraction `MAX_CPU_SHARE` of the period, both in the
  session and in a replay of the packets. Missed ticks that directly follow such a tick have the same cause;
- an injected fault, if one affected the packets of this tick;
- in all other cases the machine: the computer ran another process or virtual machine.
"""

import copy
import json
import math
import os
import secrets
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, to_one_line
from jaxhil.mechanism.file import AnyMechanism
from tuning.rig.loop import (
    ANSWER_SHARE,
    EmptyTask,
    PacketTimes,
    answered_packet_number,
    build_empty_reading,
    run_loop,
)
from tuning.rig.network import Injection, Network
from tuning.rig.rig_task import CommandRange, RigTask, SimulatedRig
from tuning.rig.udp_controller import MAX_CPU_SHARE, request_real_time_priority
from tuning.rig.udp_protocol import (
    MAX_PACKET_NUMBER,
    STOP,
    Numbers,
    PacketError,
    decode_opening,
    encode_reading,
    encode_session_request,
)

START_TIMEOUT = 30.0  # longest time until the controller's process listens, then until it answers [s]
REQUEST_INTERVAL = 0.1  # time between two requests for a session [s]
END_TIMEOUT = 120.0  # longest time until the controller's process ends, including its replay [s]
# Time without a packet after which the controller's process ends [s]; also the constant SILENCE of rt_loop.c.
SILENCE_TIMEOUT = 2.0

SOURCE_FOLDER = Path(__file__).parent
# Record of a controller that this process has not started: it contains no times of ticks.
RECORD_OF_OTHER_PROGRAM: dict[str, Any] = {
    "ended": "stopped",
    "ignored": 0,
    "status": "unknown",
    "stale": 0,
    "made_up": 0,
    "doubts": {},
    "jax": False,
    "ticks": {"sequence": [], "wall": [], "cpu": []},
    "replayed": {"sequence": [], "cpu": []},
}


class Quantiles(NamedTuple):
    """Median, 99.9th percentile and maximum of a measured time."""

    median: float  # [s]
    p999: float  # 99.9th percentile [s]
    maximum: float  # [s]


class LoopMetrics(NamedTuple):
    """Numbers of missed ticks, by cause, and times of one real-time loop."""

    ticks: int  # number of executed ticks
    missed: int  # number of missed ticks
    missed_by_controller: int  # number of ticks missed because of the controller
    missed_by_injection: int  # number of ticks missed because of injected faults
    missed_by_machine: int  # number of ticks missed because the computer was busy with other work
    stood_still: float  # time by which the rig's clock was shifted [s]
    tick_time: Quantiles  # time that the controller needs for a tick [s]
    tick_cpu: Quantiles  # CPU time that the controller uses for a tick [s]
    round_trip: Quantiles  # time from a packet to its answer [s]
    lateness: Quantiles  # delay of a packet after its due time [s]


class LoopTimes(NamedTuple):
    """Measured times of all ticks of one real-time loop, for plots."""

    tick_time: np.ndarray  # time that the controller needs for each tick [s], (recorded ticks,)
    round_trip: np.ndarray  # time from each packet to its answer [s], (answered ticks,)


class LoopReport(NamedTuple):
    """Results of one real-time loop: metrics, times, and the causes of missed ticks."""

    metrics: LoopMetrics  # numbers of missed ticks and quantiles of the times
    times: LoopTimes  # times of all ticks, for plots
    causes: np.ndarray  # cause of each missed tick, (ticks,); see `find_miss_causes`
    controller: dict[str, Any]  # record that the controller's process wrote at its end


class SessionReport(NamedTuple):
    """Results of a session: empty loop, loop with the simulated rig, contacts, commands and trips."""

    empty: LoopReport | None  # loop without a rig; None if the session ended before this loop began
    run: LoopReport | None  # loop with the simulated rig; None if the session ended before this loop began
    contacts: tuple[Any, ...]  # contacts that have ended (for six axes, runs)
    commanded: CommandRange | None  # extreme values of the commands
    tripped: str  # reason for the controller's trip; empty if it has not tripped
    interrupted: bool  # whether the user interrupted the session
    # reasons for all trips that were caused by old commands and followed by a reset
    resets: tuple[str, ...] = ()


class SessionSettings(NamedTuple):
    """Settings of a session: controller, mechanism, durations, and injected faults."""

    folder: Path  # folder that holds `udp_controller.py`: a bundle, or `SOURCE_FOLDER`
    gains: Path  # gain file of the controller
    mechanism: AnyMechanism  # mechanism that the gain file contains
    stroke: tuple[Numbers, Numbers]  # lowest and highest positions of the drives [m, rad]
    duration: float  # duration of the run with the simulated rig [s]
    empty_duration: float  # duration of the empty loop before the run [s]
    injection: Injection  # network faults that are injected into the run
    seed: int  # seed of all random numbers
    priority: bool = False  # whether to request a real-time priority for both processes
    # UDP port of a running controller, such as the bundle's `rt_loop`; None to start `udp_controller.py`
    port: int | None = None
    rate: float = 1.0  # simulated time divided by real time; below 1, the rehearsal is slower [1]

    @property
    def tick_interval(self) -> float:
        """Return the real time from one tick to the next [s]."""
        return self.mechanism.rig.control_period / self.rate

    def count_ticks(self, duration: float) -> int:
        """Return the number of ticks of a run with this duration [s] in simulated time."""
        return max(1, round(duration / self.mechanism.rig.control_period))


def run_session(
    setup: SessionSettings,
    rig: SimulatedRig,
    scratch: Path,
    say: Callable[[str], None],
    progress: Callable[[int, int], None],
) -> SessionReport:
    """Run an empty loop (packets without a rig) for comparison, then the loop with the simulated rig.

    Args:
        setup: settings of the session.
        rig: simulated rig of the mechanism.
        scratch: folder for the records that the controller's process writes.
        say: callback, called with a description of each loop before it starts.
        progress: callback, called once a second with the completed and the total number of ticks.

    Raises:
        InputError: if the controller's process does not start or does not write its record.
    """
    period, empty, run, interrupted = setup.mechanism.rig.control_period, None, None, False
    task = RigTask(rig, period, setup.stroke, resets=not setup.injection.any)
    try:
        if setup.port is None and setup.empty_duration >= period:
            say(f"empty loop at {1 / setup.tick_interval:g} Hz, {setup.empty_duration:g} s")
            faultless = Injection()
            empty, interrupted = _run_controller_loop(
                setup, EmptyTask(rig.axes), rig.axes, setup.empty_duration, faultless, scratch, progress
            )
        if not interrupted:
            say(f"{setup.mechanism.name} at {1 / setup.tick_interval:g} Hz, {setup.duration:g} s")
            run, interrupted = _run_controller_loop(
                setup, task, rig.axes, setup.duration, setup.injection, scratch, progress
            )
    except KeyboardInterrupt:
        interrupted = True
    task.finish()
    return SessionReport(
        empty, run, task.contacts, task.commanded, task.tripped, interrupted, task.reset_trips
    )


def _run_controller_loop(
    setup: SessionSettings,
    task: RigTask | EmptyTask,
    axes: int,
    duration: float,
    injection: Injection,
    scratch: Path,
    progress: Callable[[int, int], None],
) -> tuple[LoopReport, bool]:
    """Run one closed loop, with the controller in a new process.

    Return the report of the loop, and whether the user interrupted it.
    """
    ticks = setup.count_ticks(duration)
    record, interval = scratch / f"{type(task).__name__}.json", setup.tick_interval
    options = ["--empty"] * isinstance(task, EmptyTask) + ["--realtime"] * setup.priority
    options += ["--gains", str(setup.gains.resolve()), "--record", str(record), "--ticks", str(ticks)]
    options += ["--silence", str(max(SILENCE_TIMEOUT, 100 * interval))]
    process = None if setup.port is not None else start_controller(setup.folder, options)
    timing, interrupted = PacketTimes(ticks), False
    try:
        port = setup.port if process is None else read_listening_port(process)
        name = "udp_controller.py" if process is not None else f"--connect {port}"
        network = Network(("127.0.0.1", int(port or 0)), injection, setup.seed, ticks, answered_packet_number)
        session = open_session(network, axes, name)
        try:
            with real_time_priority(setup.priority):
                run_loop(task, network, session, interval, timing, lambda done: progress(done, ticks))
        except KeyboardInterrupt:
            interrupted = True
        finally:
            # The stop packet is sent twice, because a full network buffer may drop a packet.
            for _ in range(2):
                stop = build_empty_reading(axes, STOP, MAX_PACKET_NUMBER)
                network.send_without_faults(encode_reading(stop, session))
            network.close()
        document = RECORD_OF_OTHER_PROGRAM
        if process is not None:
            process.wait(END_TIMEOUT)
            document = json.loads(record.read_text(encoding="utf-8"))
    except (OSError, subprocess.TimeoutExpired, json.JSONDecodeError) as error:
        reason = to_one_line(str(error), 200)
        raise InputError(
            f"udp_controller.py: the controller's process exited without writing its record ({reason})"
        ) from None
    finally:
        if process is not None:
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()
    return build_loop_report(timing, network, copy.deepcopy(document), interval), interrupted


@contextmanager
def real_time_priority(wanted: bool) -> Iterator[None]:
    """Context manager: run this thread with real-time priority if `wanted` is true.

    Raise OSError if the operating system denies the priority.
    """
    if not wanted:
        yield
        return
    kind, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    request_real_time_priority()
    try:
        yield
    finally:
        os.sched_setscheduler(0, kind, parameters)


def start_controller(folder: Path, arguments: Sequence[str]) -> subprocess.Popen:
    """Start the controller's process in an isolated interpreter; `folder` holds `udp_controller.py`."""
    # The process gets its own process group, so that Ctrl-C reaches only the rig's process, which then sends
    # the stop packet.
    return subprocess.Popen(
        [sys.executable, "-I", "udp_controller.py", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def read_listening_port(process: subprocess.Popen) -> int:
    """Return the UDP port that the controller's process prints when it listens.

    Raise InputError if the process does not print a port within `START_TIMEOUT`.
    """
    stream = process.stdout
    assert stream is not None
    ready = select.select([stream], [], [], START_TIMEOUT)[0]
    line = stream.readline().decode("ascii", "replace").split() if ready else []
    if len(line) != 2 or line[0] != "port":
        raise InputError(
            f"udp_controller.py: the process did not print its UDP port within {START_TIMEOUT:g} s"
        )
    return int(line[1])


def open_session(network: Network, axes: int, name: str = "udp_controller.py") -> int:
    """Request a session until the controller's process answers; return the session's number.

    Raise InputError if there is no answer within `START_TIMEOUT`, or if the controller has another number of
    axes than the rig.
    """
    number = secrets.randbits(64)
    until = time.monotonic() + START_TIMEOUT
    while time.monotonic() < until:
        packet = network.ask(encode_session_request(number, axes), REQUEST_INTERVAL)
        try:
            opening = decode_opening(packet or b"", number)
        except PacketError:
            continue
        if opening.axes == axes:
            return opening.session
        network.close()
        raise InputError(f"{name}: controller's axes: found {opening.axes}, expected {axes} like the rig")
    network.close()
    raise InputError(f"{name}: the process did not answer a request for a session within {START_TIMEOUT:g} s")


def build_loop_report(
    timing: PacketTimes, network: Network, controller: dict[str, Any], period: float
) -> LoopReport:
    """Build the report of one loop from the records of the rig's and of the controller's process."""
    ticks = timing.ticks
    record = {name: np.array(values, np.int64) for name, values in controller.pop("ticks").items()}
    within = record["sequence"] < ticks
    wall, cpu = (1e-9 * record[name][within] for name in ("wall", "cpu"))
    overspent = np.zeros(ticks, bool)
    replay = controller["replayed"]
    for number, time_ns in zip(replay["sequence"], replay["cpu"], strict=True):
        if number < ticks and 1e-9 * time_ns > MAX_CPU_SHARE * period:
            overspent[number] = True
    in_time = np.array(timing.answered_in_time[:ticks], bool)
    round_trip = 1e-9 * np.array(timing.round_trip[:ticks], float)
    delay = 1e-9 * np.array(network.injected_delay[:ticks], float)
    lost = np.array(network.lost[:ticks], bool)
    causes = find_miss_causes(in_time, overspent, round_trip, delay, lost, ANSWER_SHARE * period)
    late = 1e-9 * np.array(timing.late[:ticks], float)
    trips = round_trip[round_trip > 0]
    metrics = LoopMetrics(
        ticks=ticks,
        missed=int(np.sum(~in_time)),
        missed_by_controller=int(np.sum(causes == CAUSE_CONTROLLER)),
        missed_by_injection=int(np.sum(causes == CAUSE_INJECTION)),
        missed_by_machine=int(np.sum(causes == CAUSE_MACHINE)),
        stood_still=1e-9 * timing.clock_shift,
        tick_time=compute_quantiles(wall),
        tick_cpu=compute_quantiles(cpu),
        round_trip=compute_quantiles(trips),
        lateness=compute_quantiles(late),
    )
    return LoopReport(metrics, LoopTimes(wall, trips), causes, controller)


NOT_MISSED, CAUSE_CONTROLLER, CAUSE_INJECTION, CAUSE_MACHINE = 0, 1, 2, 3


def find_miss_causes(
    in_time: np.ndarray,
    overspent: np.ndarray,
    round_trip: np.ndarray,
    injected_delay: np.ndarray,
    lost: np.ndarray,
    allowance: float,
) -> np.ndarray:
    """Return the cause of each missed tick.

    Injection is the cause in three cases: injection lost the packet or its answer; the answer would have been
    in time without the injected delay; or a delayed packet was not answered, because a newer packet overtook
    it.

    Args:
        in_time: whether the answer was in time, (ticks,).
        overspent: whether the controller used more CPU time than `MAX_CPU_SHARE` allows, (ticks,).
        round_trip: time from the packet to the answer [s], 0 without an answer, (ticks,).
        injected_delay: injected delay of the packet and its answer [s], (ticks,).
        lost: whether injection lost the packet or its answer, (ticks,).
        allowance: longest round-trip time of an answer that is in time [s].

    Returns:
        `NOT_MISSED`, `CAUSE_CONTROLLER`, `CAUSE_INJECTION` or `CAUSE_MACHINE` for each tick, (ticks,).
    """
    in_time_without_delay = np.where(round_trip > 0, round_trip - injected_delay <= allowance, True)
    injected = lost | ((injected_delay > 0) & in_time_without_delay)
    causes = np.where(
        in_time,
        NOT_MISSED,
        np.where(overspent, CAUSE_CONTROLLER, np.where(injected, CAUSE_INJECTION, CAUSE_MACHINE)),
    )
    for number in np.flatnonzero(causes == CAUSE_CONTROLLER):
        following = number + 1
        while following < len(causes) and causes[following] in (CAUSE_INJECTION, CAUSE_MACHINE):
            causes[following] = CAUSE_CONTROLLER
            following += 1
    return causes


def compute_quantiles(values: np.ndarray) -> Quantiles:
    """Return median, 99.9th percentile and maximum of times [s]; NaN if there are no values."""
    if not len(values):
        return Quantiles(math.nan, math.nan, math.nan)
    return Quantiles(*(float(value) for value in (*np.quantile(values, (0.5, 0.999)), np.max(values))))
