"""Comparison of a controller with a rig's logs: the metrics of each contact, and causes of differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from tuning.shadow_mode.diagnosis import explain
from tuning.shadow_mode.logged_ticks import LoggedTicks
from tuning.shadow_mode.replay import ReplayedRun, compare_commands, relative_difference, replay_logs


class CommandDifference(msgspec.Struct, frozen=True):
    """Metrics of the controller's commands minus the logged ones in one contact, for forces or moments."""

    largest: float | None  # largest difference of a component [N, N m]; None if nothing is compared
    time: float | None  # instant of this difference, from the log's first row [s]
    rms: float | None  # root mean square of the difference's norm [N, N m]
    range: float  # range of the logged commands, including 0 [N, N m]


class FaultEntry(msgspec.Struct, frozen=True):
    """Fault that the controller has raised in a contact."""

    name: str
    ticks: int  # number of ticks with the fault
    first: float  # instant of the first such tick, from the log's first row [s]


class Trip(msgspec.Struct, frozen=True):
    """Trip (latched stop after a fault) of the controller in a contact."""

    time: float  # instant, from the log's first row [s]
    reason: str  # names of the faults that caused the trip


class ShadowContact(msgspec.Struct, frozen=True):
    """Commands, faults and statuses of the controller in one contact (run) of a log."""

    contact: int  # number of the contact in all logs, from 1
    log: str  # name of the log
    begin: float  # instant of the first row, from the log's first row [s]
    ticks: int  # number of logged ticks
    compared: int  # number of compared ticks
    share: float | None  # largest difference, divided by the range of the force or moment commands [1]
    differences: dict[str, CommandDifference]  # "force" and, on six axes, "moment"
    missed: int  # number of missed ticks, by the time stamps
    late: int  # number of late ticks, by the time stamps
    law_status: str  # status of the compensator for the contact
    faults: tuple[FaultEntry, ...]
    trip: Trip | None


@dataclass(frozen=True)
class ShadowComparison:
    """Comparison of a controller with the logs of a rig."""

    contacts: tuple[ShadowContact, ...]
    findings: tuple[str, ...]  # causes of differences that the logs show, one line each
    notes: tuple[str, ...]  # remarks on the logs and on audits that are left out
    logs: tuple[LoggedTicks, ...]
    runs: tuple[tuple[ReplayedRun, ...], ...]  # replayed runs of each log


def compare_with_logs(
    make_controller: Callable[[Sequence[str]], Any],
    logs: Sequence[LoggedTicks],
    mechanism: Any,
    is_session: bool = False,
) -> ShadowComparison:
    """Feed the readings of logs to a controller; compare its commands with the logged ones.

    Args:
        make_controller: Function that takes names of limits; returns a new controller without these limits.
        logs: Readings and commands of each log.
        mechanism: Mechanism of the gain file.
        is_session: Whether all logs belong to one session, in which the controller keeps its estimates.
    """
    replays, notes = replay_logs(make_controller, logs, is_session)
    contacts = []
    for ticks, runs in zip(logs, replays, strict=True):
        contacts += [
            _evaluate(ticks, run, len(contacts) + number) for number, run in enumerate(runs, start=1)
        ]
    return ShadowComparison(
        contacts=tuple(contacts),
        findings=tuple(
            line for pair in zip(logs, replays, strict=True) for line in explain(*pair, mechanism)
        ),
        notes=(*(note for ticks in logs for note in ticks.notes), *notes),
        logs=tuple(logs),
        runs=tuple(map(tuple, replays)),
    )


def _evaluate(ticks: LoggedTicks, run: ReplayedRun, number: int) -> ShadowContact:
    """Return the metrics of one run, which is contact `number` of all logs."""
    difference, ranges = compare_commands(ticks, run)
    instant = ticks.instant[run.rows]
    compared = int(np.count_nonzero(np.all(np.isfinite(difference), axis=1)))
    parts = zip(("force", "moment"), np.split(difference, len(ranges), axis=1), ranges, strict=False)
    return ShadowContact(
        contact=number,
        log=ticks.label,
        begin=float(instant[0]),
        ticks=len(instant),
        compared=compared,
        share=relative_difference(difference, ranges) if compared else None,
        differences={name: _measure(part, float(size), instant) for name, part, size in parts},
        missed=run.missed,
        late=run.late,
        law_status=run.law_status,
        faults=tuple(FaultEntry(*fault) for fault in run.faults),
        trip=None if run.trip is None else Trip(*run.trip),
    )


def _measure(difference: np.ndarray, size: float, instant: np.ndarray) -> CommandDifference:
    """Return the metrics of `difference`, (rows, components); `size` is the range of the logged commands."""
    finite = np.all(np.isfinite(difference), axis=1)
    if not finite.any():
        return CommandDifference(None, None, None, size)
    largest = np.max(np.abs(difference[finite]), axis=1)
    return CommandDifference(
        largest=float(np.max(largest)),
        time=float(instant[finite][np.argmax(largest)]),
        rms=float(np.sqrt(np.mean(np.sum(difference[finite] ** 2, axis=1)))),
        range=size,
    )
