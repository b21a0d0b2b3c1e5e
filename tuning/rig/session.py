"""A session: the controller's process, an empty loop for comparison, the run, and whose fault what was.

The rig's process, which is this one, starts the controller's, plays the rig to it and stops it. Whose fault a
missed tick is, is found out afterwards. It is the controller's if its process took more than `CPU_SHARE` of
the period of CPU time for that tick, live and when the same packets were gone through again, or if it follows
such a tick without one in between that was met; else it is an injected fault's, if one hit its packets; else
the machine's: the operating system, or another machine on the same processor, ran something else.
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

from jaxhil.errors import InputError, one_line
from jaxhil.mechanism.structs import Mechanism
from tuning.rig.contact_watch import ContactResult
from tuning.rig.hardware import Commanded, RigTask
from tuning.rig.loop import ANSWER_SHARE, EmptyTask, Timing, answered_by, play
from tuning.rig.network import Injection, Network
from tuning.rig.udp_controller import CPU_SHARE, realtime
from tuning.rig.udp_protocol import (
    STOP,
    PacketError,
    Reading,
    ask_for_session,
    decode_session,
    encode_reading,
)

STARTING = 30.0  # s in which the controller's process has to listen, and to answer
ASKING = 0.1  # s to wait for an answer, before asking again
ENDING = 120.0  # s in which it has to end, going through its packets again included
SILENCE = 2.0  # s without a packet, after which it ends by itself

SOURCE = Path(__file__).parent
LAST = Reading(
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
    """Of a time [s]."""

    median: float
    p999: float  # 99.9th percentile
    maximum: float


class LoopFigures(NamedTuple):
    """One loop in figures."""

    ticks: int  # played
    missed: int  # of these
    missed_by_controller: int  # of the missed, by whose fault
    missed_by_injection: int  # likewise
    missed_by_machine: int  # likewise
    stood_still: float  # for how long the rig's clock stood still [s]
    tick_time: Quantiles  # the controller's own time per tick [s]
    tick_cpu: Quantiles  # the CPU time in it [s]
    round_trip: Quantiles  # from a packet to its answer [s]
    lateness: Quantiles  # by how much packets left late [s]


class LoopTimes(NamedTuple):
    """What `LoopFigures` are made of, for pictures."""

    tick_time: np.ndarray  # the controller's time per tick [s]
    round_trip: np.ndarray  # [s]


class LoopReport(NamedTuple):
    """One loop."""

    figures: LoopFigures  # what it comes to
    times: LoopTimes  # for pictures
    causes: np.ndarray  # whose fault each tick was (`attribute`)
    controller: dict[str, Any]  # what the controller's process said at its end


class SessionReport(NamedTuple):
    """A session."""

    empty: LoopReport | None  # the empty loop; None where it was not reached
    run: LoopReport | None  # the run against the rig, likewise
    contacts: tuple[ContactResult, ...]  # those that are over
    commanded: Commanded | None  # what was commanded
    tripped: str  # why the controller tripped; empty if it did not
    interrupted: bool  # whether the session was
    # why the controller tripped and was reset, where the machine had left it without time
    resets: tuple[str, ...] = ()


class Setup(NamedTuple):
    """What a session is to be."""

    folder: Path  # with the controller's process, as in a bundle, or `SOURCE`
    gains: Path  # its gain file
    mechanism: Mechanism  # the one in that
    stroke: tuple[float, float]  # lowest and highest position that the drives take [m]
    duration: float  # of the run [s]
    empty_duration: float  # of the empty loop before it [s]
    injection: Injection  # faults put into the run
    seed: int  # of all draws
    priority: bool = False  # whether to ask the system for a real-time priority for both processes


def run_session(
    setup: Setup, scratch: Path, say: Callable[[str], None], progress: Callable[[int, int], None]
) -> SessionReport:
    """Play an empty loop, then the rig. Records go to the folder `scratch`; `say` is called with what begins,
    and `progress` once a second how many ticks of how many are done.

    Raises InputError when the controller's process does not start.
    """
    task = RigTask(setup.mechanism, setup.seed, setup.stroke, resets=not setup.injection.any)
    period, empty, run, interrupted = setup.mechanism.rig.control_period, None, None, False
    try:
        if setup.empty_duration >= period:
            say(f"empty loop at {1 / period:g} Hz, {setup.empty_duration:g} s")
            none = Injection()
            empty, interrupted = _play(setup, EmptyTask(), setup.empty_duration, none, scratch, progress)
        if not interrupted:
            say(f"{setup.mechanism.name} at {1 / period:g} Hz, {setup.duration:g} s")
            run, interrupted = _play(setup, task, setup.duration, setup.injection, scratch, progress)
    except KeyboardInterrupt:
        interrupted = True
    task.finish()
    return SessionReport(empty, run, task.contacts, task.commanded, task.tripped, interrupted, task.forgiven)


def _play(
    setup: Setup,
    task: RigTask | EmptyTask,
    duration: float,
    injection: Injection,
    scratch: Path,
    progress: Callable[[int, int], None],
) -> tuple[LoopReport, bool]:
    """One loop against a process of its own, and whether it was interrupted."""
    period = setup.mechanism.rig.control_period
    ticks, record = max(1, round(duration / period)), scratch / f"{type(task).__name__}.json"
    options = ["--empty"] * isinstance(task, EmptyTask) + ["--realtime"] * setup.priority
    options += ["--gains", str(setup.gains.resolve()), "--record", str(record), "--ticks", str(ticks)]
    options += ["--silence", str(max(SILENCE, 100 * period))]
    process, interrupted = start_controller(setup.folder, options), False
    timing = Timing(ticks)
    try:
        port = listening_port(process)
        network = Network(("127.0.0.1", port), injection, setup.seed, ticks, answered_by)
        session = open_session(network)
        try:
            with real_time(setup.priority):
                play(task, network, session, period, timing, lambda done: progress(done, ticks))
        except KeyboardInterrupt:
            interrupted = True
        finally:
            # Past all injection; twice, as a full buffer may swallow one.
            for _ in range(2):
                network.send_plainly(encode_reading(LAST, session))
            network.close()
        process.wait(ENDING)
        document = json.loads(record.read_text(encoding="utf-8"))
    except (OSError, subprocess.TimeoutExpired, json.JSONDecodeError) as error:
        reason = one_line(str(error), 200)
        raise InputError(f"udp_controller.py: found no good end ({reason}), allowed a record of it") from None
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()
    return loop_report(timing, network, document, period), interrupted


@contextmanager
def real_time(wanted: bool) -> Iterator[None]:
    """A real-time priority for this thread while it lasts. Raises OSError where that is not to be had."""
    if not wanted:
        yield
        return
    kind, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    realtime()
    try:
        yield
    finally:
        os.sched_setscheduler(0, kind, parameters)


def start_controller(folder: Path, arguments: Sequence[str]) -> subprocess.Popen:
    """The controller's process, isolated, in the folder that holds `udp_controller.py`."""
    # A session of its own: an interruption from the keyboard is the rig's, which stops it in order.
    return subprocess.Popen(
        [sys.executable, "-I", "udp_controller.py", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        start_new_session=True,
    )


def listening_port(process: subprocess.Popen) -> int:
    """The port that the process says it listens on. Raises InputError if it does not."""
    stream = process.stdout
    assert stream is not None
    ready = select.select([stream], [], [], STARTING)[0]
    line = stream.readline().decode("ascii", "replace").split() if ready else []
    if len(line) != 2 or line[0] != "port":
        raise InputError("udp_controller.py: found no process that listens, allowed one that says its port")
    return int(line[1])


def open_session(network: Network) -> int:
    """The number of a session with the controller's process, asked for until it answers. Raises InputError if
    it does not."""
    number = secrets.randbits(64)
    until = time.monotonic() + STARTING
    while time.monotonic() < until:
        packet = network.ask(ask_for_session(number), ASKING)
        try:
            return decode_session(packet or b"", number)
        except PacketError:
            continue
    network.close()
    raise InputError("udp_controller.py: found no answer, allowed one to who asks for a session")


def loop_report(timing: Timing, network: Network, controller: dict[str, Any], period: float) -> LoopReport:
    """Join what the rig and the controller's process have recorded."""
    ticks = timing.ticks
    record = {name: np.array(values, np.int64) for name, values in controller.pop("ticks").items()}
    within = record["sequence"] < ticks
    wall, cpu = (1e-9 * record[name][within] for name in ("wall", "cpu"))
    overspent = np.zeros(ticks, bool)
    again = controller["replayed"]
    for number, took in zip(again["sequence"], again["cpu"], strict=True):
        if number < ticks and 1e-9 * took > CPU_SHARE * period:
            overspent[number] = True
    met = np.array(timing.met[:ticks], bool)
    round_trip = 1e-9 * np.array(timing.round_trip[:ticks], float)
    held = 1e-9 * np.array(network.held_back[:ticks], float)
    lost = np.array(network.lost[:ticks], bool)
    causes = attribute(met, overspent, round_trip, held, lost, ANSWER_SHARE * period)
    late = 1e-9 * np.array(timing.late[:ticks], float)
    trips = round_trip[round_trip > 0]
    figures = LoopFigures(
        ticks=ticks,
        missed=int(np.sum(~met)),
        missed_by_controller=int(np.sum(causes == CONTROLLER)),
        missed_by_injection=int(np.sum(causes == INJECTED)),
        missed_by_machine=int(np.sum(causes == MACHINE)),
        stood_still=1e-9 * timing.stood,
        tick_time=quantiles(wall),
        tick_cpu=quantiles(cpu),
        round_trip=quantiles(trips),
        lateness=quantiles(late),
    )
    return LoopReport(figures, LoopTimes(wall, trips), causes, controller)


MET, CONTROLLER, INJECTED, MACHINE = 0, 1, 2, 3


def attribute(
    met: np.ndarray,
    overspent: np.ndarray,
    round_trip: np.ndarray,
    held: np.ndarray,
    lost: np.ndarray,
    allowance: float,
) -> np.ndarray:
    """Whose fault each missed tick is, (ticks,): `MET`, `CONTROLLER`, `INJECTED` or `MACHINE`.

    `overspent`: the controller took more CPU time than its share; `round_trip` [s], 0 without an answer;
    `held` back by injection [s]; `lost` by it; `allowance` [s] for an answer. Injection is to blame for what
    was lost, for what would have come in time had it not been held back, and for what was held back and never
    answered (a newer packet overtook it).
    """
    in_time_but_for_it = np.where(round_trip > 0, round_trip - held <= allowance, True)
    injected = lost | ((held > 0) & in_time_but_for_it)
    causes = np.where(met, MET, np.where(overspent, CONTROLLER, np.where(injected, INJECTED, MACHINE)))
    for number in np.flatnonzero(causes == CONTROLLER):
        following = number + 1
        while following < len(causes) and causes[following] in (INJECTED, MACHINE):
            causes[following] = CONTROLLER
            following += 1
    return causes


def quantiles(values: np.ndarray) -> Quantiles:
    """Median, 99.9th percentile and maximum; not a number where there are no values."""
    if not len(values):
        return Quantiles(math.nan, math.nan, math.nan)
    return Quantiles(*(float(value) for value in (*np.quantile(values, (0.5, 0.999)), np.max(values))))
