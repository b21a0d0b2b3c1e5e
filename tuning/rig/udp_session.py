"""A session: the controller's process, an empty loop for comparison, the run, and whose fault what was.

A missed tick is the controller's if its process took more than `CPU_SHARE` of the period of CPU time for that
tick, live and when the same packets were gone through again, or if it follows such a tick without one in
between that was met; else it is an injected fault's, if one hit its packets; else the machine's: the operating
system, or another machine on the same processor, ran something else.
"""

import json
import math
import os
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxhil.errors import InputError, one_line
from jaxhil.mechanism import Mechanism
from tuning.rig.contact_watch import ContactResult
from tuning.rig.udp_controller import CPU_SHARE, STOP, Reading, encode_reading, realtime
from tuning.rig.udp_loop import ANSWER_SHARE, EmptyTask, Task, Timing, answered_by, play
from tuning.rig.udp_network import Injection, Network
from tuning.rig.udp_rig import Commanded, RigTask

STARTING = 30.0  # s in which the controller's process has to listen
ENDING = 120.0  # s in which it has to end, going through its packets again included
SILENCE = 2.0  # s without a packet, after which it ends by itself

SOURCE = Path(__file__).parent


class Quantiles(NamedTuple):
    """Of a time [s]: median, 99.9th percentile, maximum."""

    median: float
    p999: float
    maximum: float


class LoopFigures(NamedTuple):
    """One loop: ticks played and missed, and whose fault the missed ones were; the controller's own time per
    tick and the CPU time in it, the round trip, and by how much packets left late; all quantiles in s."""

    ticks: int
    missed: int
    missed_by_controller: int
    missed_by_injection: int
    missed_by_machine: int
    tick_time: Quantiles
    tick_cpu: Quantiles
    round_trip: Quantiles
    lateness: Quantiles


class LoopTimes(NamedTuple):
    """What `LoopFigures` are made of: the controller's time per tick and round trips [s], for pictures."""

    tick_time: np.ndarray
    round_trip: np.ndarray


class LoopReport(NamedTuple):
    """One loop: figures and times; what the controller's process said at its end."""

    figures: LoopFigures
    times: LoopTimes
    controller: dict[str, Any]


class SessionReport(NamedTuple):
    """The empty loop and the run (None where not reached); contacts that are over; what was commanded; why
    the controller tripped, if it did; whether the session was interrupted."""

    empty: LoopReport | None
    run: LoopReport | None
    contacts: tuple[ContactResult, ...]
    commanded: Commanded | None
    tripped: str
    interrupted: bool


def run_session(
    folder: Path,
    gains: Path,
    mechanism: Mechanism,
    stroke: tuple[float, float],
    duration: float,
    empty_duration: float,
    injection: Injection,
    seed: int,
    scratch: Path,
    say: Callable[[str], None],
    real_time_priority: bool = False,
) -> SessionReport:
    """Play an empty loop, then the rig, against the controller of `folder` (a bundle, or `SOURCE`).

    Durations in s; `scratch` is a folder for records; `stroke` [m] as in `RigTask`; `real_time_priority` asks the system
    for a real-time priority for both processes. Raises InputError when the controller's process does not
    start.
    """
    options = ("--realtime",) if real_time_priority else ()
    period, empty, run = mechanism.rig.control_period, None, None
    task = RigTask(mechanism, seed, stroke)
    interrupted = False
    try:
        if empty_duration >= period:
            say(f"empty loop, {empty_duration:g} s")
            begun = _Loop(
                folder, gains, period, empty_duration, Injection(), seed, scratch, ("--empty", *options)
            )
            empty = begun.play(EmptyTask(), lambda: None)
            interrupted = begun.interrupted
        if not interrupted:
            say(f"{mechanism.name} at {1 / period:g} Hz, {duration:g} s")
            begun = _Loop(folder, gains, period, duration, injection, seed, scratch, options)
            run = begun.play(task, lambda: None)
            interrupted = begun.interrupted
    except KeyboardInterrupt:
        interrupted = True
    task.finish()
    return SessionReport(empty, run, task.contacts, task.commanded, task.tripped, interrupted)


class _Loop:
    """One loop against a process of its own."""

    def __init__(
        self,
        folder: Path,
        gains: Path,
        period: float,
        duration: float,
        injection: Injection,
        seed: int,
        scratch: Path,
        options: Sequence[str],
    ) -> None:
        self._period, self._ticks = period, max(1, round(duration / period))
        self._record = scratch / f"ticks{''.join(options)}.json"
        self._injection, self._seed = injection, seed
        self.interrupted, self._realtime = False, "--realtime" in options
        silence = max(SILENCE, 100 * period)
        arguments = ["--gains", str(gains.resolve()), "--record", str(self._record)]
        arguments += ["--ticks", str(self._ticks), "--silence", str(silence), *options]
        self._process = start_controller(folder, arguments)

    def play(self, task: Task, said: Callable[[], None]) -> LoopReport:
        """Play until the end, an interruption included."""
        process = self._process
        try:
            port = listening_port(process)
            ticks, period = self._ticks, self._period
            network = Network(("127.0.0.1", port), self._injection, self._seed, ticks, answered_by)
            timing = Timing(ticks)
            try:
                with real_time(self._realtime):
                    play(task, network, period, timing, said)
            except KeyboardInterrupt:
                self.interrupted = True
            finally:
                # The last packet is past all injection; twice, as the first may meet a full buffer.
                for _ in range(2):
                    network.send_plainly(
                        encode_reading(Reading(STOP, 0xFFFFFFFF, 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0))
                    )
                network.close()
            process.wait(ENDING)
            document = json.loads(self._record.read_text(encoding="utf-8"))
        except (OSError, ValueError, subprocess.TimeoutExpired) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"the controller's process did not end well: {one_line(str(error), 200)}"
            ) from None
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stdout is not None:
                process.stdout.close()
        return loop_report(timing, network, document, period)


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
        ticks,
        int(np.sum(~met)),
        *(int(np.sum(causes == cause)) for cause in (CONTROLLER, INJECTED, MACHINE)),
        *(quantiles(values) for values in (wall, cpu, trips, late)),
    )
    return LoopReport(figures, LoopTimes(wall, trips), controller)


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

    `overspent`: the controller took more CPU time than its share; `round_trip` [s], 0 without an answer; `held`
    back by injection [s]; `lost` by it; `allowance` [s] for an answer. Injection is to blame for what was lost,
    for what would have come in time had it not been held back, and for what was held back and never answered
    (a newer packet overtook it).
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
