"""Session of a rehearsal: the controller's process, an empty loop for comparison, the run, and its faults.

The rig's process, which is this one, starts the controller's process, simulates the rig and stops it. The
cause of each missed tick is determined afterwards. It is the controller if its process took more than
`MAX_CPU_SHARE` of the period of CPU time for the tick, both live and in a replay of the packets, or if only
missed ticks lie between such a tick and this one. Otherwise it is an injected fault, if one affected its
packets; otherwise it is the machine: another process or virtual machine used the processor.
"""

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
from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_watch import RigContact
from tuning.rig.loop import ANSWER_SHARE, EmptyTask, PacketTimes, answered_packet_number, run_loop
from tuning.rig.network import Injection, Network
from tuning.rig.rig_task import CommandRange, RigTask
from tuning.rig.udp_controller import MAX_CPU_SHARE, request_real_time_priority
from tuning.rig.udp_protocol import (
    STOP,
    PacketError,
    ReadingPacket,
    decode_session,
    encode_reading,
    encode_session_request,
)

START_TIMEOUT = 30.0  # limit on the time in which the controller's process must listen, and answer [s]
REQUEST_INTERVAL = 0.1  # wait for an answer before the next request [s]
END_TIMEOUT = 120.0  # limit on the time in which the process must end, its replay included [s]
SILENCE_TIMEOUT = 2.0  # time without a packet after which the process ends by itself [s]

SOURCE_FOLDER = Path(__file__).parent
STOP_READING = ReadingPacket(
    event=STOP,
    sequence=0xFFFFFFFF,
    run=0,
    tick=0,
    time=0.0,
    force=0.0,
    position=0.0,
    start_position=0.0,
    start_velocity=0.0,
)


class Quantiles(NamedTuple):
    """Quantiles of a time [s]."""

    median: float
    p999: float  # 99.9th percentile
    maximum: float


class LoopMetrics(NamedTuple):
    """Metrics of one loop."""

    ticks: int  # number of played ticks
    missed: int  # number of missed ticks
    missed_by_controller: int  # number of ticks missed because of the controller
    missed_by_injection: int  # number of ticks missed because of injected faults
    missed_by_machine: int  # number of ticks missed because of the machine
    stood_still: float  # time by which the rig's clock was shifted [s]
    tick_time: Quantiles  # controller's time per tick [s]
    tick_cpu: Quantiles  # controller's CPU time per tick [s]
    round_trip: Quantiles  # time from a packet to its answer [s]
    lateness: Quantiles  # delay with which packets were sent [s]


class LoopTimes(NamedTuple):
    """Times behind `LoopMetrics`, for plots."""

    tick_time: np.ndarray  # controller's time per tick [s]
    round_trip: np.ndarray  # time from a packet to its answer [s]


class LoopReport(NamedTuple):
    """Report of one loop."""

    figures: LoopMetrics  # metrics
    times: LoopTimes  # times for plots
    causes: np.ndarray  # cause of each missed tick (`find_miss_causes`)
    controller: dict[str, Any]  # record that the controller's process wrote at its end


class SessionReport(NamedTuple):
    """Report of a session."""

    empty: LoopReport | None  # empty loop; None if it was not reached
    run: LoopReport | None  # run against the rig; None if it was not reached
    contacts: tuple[RigContact, ...]  # contacts that ended
    commanded: CommandRange | None  # range of the commands
    tripped: str  # reason of the controller's trip; empty without one
    interrupted: bool  # whether the session was interrupted
    # reasons of trips after which the controller was reset, since the machine had delayed its commands
    resets: tuple[str, ...] = ()


class SessionSettings(NamedTuple):
    """Settings of a session."""

    folder: Path  # folder of the controller's process: that of a bundle, or `SOURCE_FOLDER`
    gains: Path  # gain file of the controller
    mechanism: Mechanism  # mechanism in the gain file
    stroke: tuple[float, float]  # lowest and highest position of the drives [m]
    duration: float  # duration of the run [s]
    empty_duration: float  # duration of the empty loop before it [s]
    injection: Injection  # faults injected into the run
    seed: int  # seed of all draws
    priority: bool = False  # whether to request a real-time priority for both processes


def run_session(
    setup: SessionSettings, scratch: Path, say: Callable[[str], None], progress: Callable[[int, int], None]
) -> SessionReport:
    """Play an empty loop, then the rig.

    Records are written to the folder `scratch`. `say` is called with a description of each stage, `progress`
    once a second with the completed and the total number of ticks. Raise InputError if the controller's
    process does not start or does not write its record.
    """
    task = RigTask(setup.mechanism, setup.seed, setup.stroke, resets=not setup.injection.any)
    period, empty, run, interrupted = setup.mechanism.rig.control_period, None, None, False
    try:
        if setup.empty_duration >= period:
            say(f"empty loop at {1 / period:g} Hz, {setup.empty_duration:g} s")
            faultless = Injection()
            empty, interrupted = _run_controller_loop(
                setup, EmptyTask(), setup.empty_duration, faultless, scratch, progress
            )
        if not interrupted:
            say(f"{setup.mechanism.name} at {1 / period:g} Hz, {setup.duration:g} s")
            run, interrupted = _run_controller_loop(
                setup, task, setup.duration, setup.injection, scratch, progress
            )
    except KeyboardInterrupt:
        interrupted = True
    task.finish()
    return SessionReport(empty, run, task.contacts, task.commanded, task.tripped, interrupted, task.forgiven)


def _run_controller_loop(
    setup: SessionSettings,
    task: RigTask | EmptyTask,
    duration: float,
    injection: Injection,
    scratch: Path,
    progress: Callable[[int, int], None],
) -> tuple[LoopReport, bool]:
    """Play one loop against a new controller's process; return its report and whether it was interrupted."""
    period = setup.mechanism.rig.control_period
    ticks, record = max(1, round(duration / period)), scratch / f"{type(task).__name__}.json"
    options = ["--empty"] * isinstance(task, EmptyTask) + ["--realtime"] * setup.priority
    options += ["--gains", str(setup.gains.resolve()), "--record", str(record), "--ticks", str(ticks)]
    options += ["--silence", str(max(SILENCE_TIMEOUT, 100 * period))]
    process, interrupted = start_controller(setup.folder, options), False
    timing = PacketTimes(ticks)
    try:
        port = read_listening_port(process)
        network = Network(("127.0.0.1", port), injection, setup.seed, ticks, answered_packet_number)
        session = open_session(network)
        try:
            with real_time_priority(setup.priority):
                run_loop(task, network, session, period, timing, lambda done: progress(done, ticks))
        except KeyboardInterrupt:
            interrupted = True
        finally:
            # Stop packets are sent twice, since a full buffer may drop one.
            for _ in range(2):
                network.send_plainly(encode_reading(STOP_READING, session))
            network.close()
        process.wait(END_TIMEOUT)
        document = json.loads(record.read_text(encoding="utf-8"))
    except (OSError, subprocess.TimeoutExpired, json.JSONDecodeError) as error:
        reason = to_one_line(str(error), 200)
        raise InputError(
            f"udp_controller.py: found no good end ({reason}), expected a record of it"
        ) from None
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
    return build_loop_report(timing, network, document, period), interrupted


@contextmanager
def real_time_priority(wanted: bool) -> Iterator[None]:
    """Give this thread a real-time priority in the context, if `wanted`; raise OSError if refused."""
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
    """Start the controller's process, isolated, in the folder that holds `udp_controller.py`."""
    # In a new session, the process gets no keyboard interrupt; the rig's process stops it in order.
    return subprocess.Popen(
        [sys.executable, "-I", "udp_controller.py", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def read_listening_port(process: subprocess.Popen) -> int:
    """Return the port that the process prints when it listens; raise InputError if it does not."""
    stream = process.stdout
    assert stream is not None
    ready = select.select([stream], [], [], START_TIMEOUT)[0]
    line = stream.readline().decode("ascii", "replace").split() if ready else []
    if len(line) != 2 or line[0] != "port":
        raise InputError("udp_controller.py: found no process that listens, expected one that says its port")
    return int(line[1])


def open_session(network: Network) -> int:
    """Request a session from the controller's process until it answers; return the session's number.

    Raise InputError if it does not answer.
    """
    number = secrets.randbits(64)
    until = time.monotonic() + START_TIMEOUT
    while time.monotonic() < until:
        packet = network.ask(encode_session_request(number), REQUEST_INTERVAL)
        try:
            return decode_session(packet or b"", number)
        except PacketError:
            continue
    network.close()
    raise InputError("udp_controller.py: found no answer, expected one to who asks for a session")


def build_loop_report(
    timing: PacketTimes, network: Network, controller: dict[str, Any], period: float
) -> LoopReport:
    """Combine the records of the rig and of the controller's process."""
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
    figures = LoopMetrics(
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
    return LoopReport(figures, LoopTimes(wall, trips), causes, controller)


NOT_MISSED, CAUSE_CONTROLLER, CAUSE_INJECTION, CAUSE_MACHINE = 0, 1, 2, 3


def find_miss_causes(
    met: np.ndarray,
    overspent: np.ndarray,
    round_trip: np.ndarray,
    held: np.ndarray,
    lost: np.ndarray,
    allowance: float,
) -> np.ndarray:
    """Return the cause of each missed tick, (ticks,), as one of `NOT_MISSED` and `CAUSE_...`.

    Injection is the cause if it lost the packet, if the answer would have been in time without the delay, or
    if a delayed packet was never answered, since a newer one overtook it.

    Args:
        met: whether the answer was in time.
        overspent: whether the controller took more CPU time than its share.
        round_trip: time to the answer [s], 0 without an answer.
        held: injected delay [s].
        lost: whether injection lost the packet or its answer.
        allowance: time in which the answer must arrive [s].
    """
    in_time_without_delay = np.where(round_trip > 0, round_trip - held <= allowance, True)
    injected = lost | ((held > 0) & in_time_without_delay)
    causes = np.where(
        met,
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
    """Return median, 99.9th percentile and maximum; NaN without values."""
    if not len(values):
        return Quantiles(math.nan, math.nan, math.nan)
    return Quantiles(*(float(value) for value in (*np.quantile(values, (0.5, 0.999)), np.max(values))))
