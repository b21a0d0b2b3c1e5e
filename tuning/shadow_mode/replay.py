"""Replay of a log's readings through the rig's controller, and comparison with the logged commands.

The controller gets the readings of each logged tick, with the time stamp of the log. The calls are those on
the rig: a position command before a run, then `step` and `position_command` in every tick, and `next_contact`
before each further run. After a trip, the comparison of the run ends, and the next run has a new controller.

Two kinds of audits of the watchdog assume that the numerical model moves under the controller's own
commands. In shadow mode it moved under the logged commands. An audit is therefore left out if the logged
commands differ too much from the controller's commands: see `AUDITS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from jaxhil.rig.faults import CONTACT_TOO_LONG, ENERGY_BALANCE, RESTITUTION, fault_names
from jaxhil.rig.six_axes.faults import ENERGY_GAIN, MOMENTUM, UNPAID_IMPULSE
from tuning.shadow_mode.logged_ticks import LoggedTicks

ENDED_SHARE = 0.05  # a contact has ended if the last force is at most this share of the run's largest one


class Audit(NamedTuple):
    """Kind of watchdog audit (check); it is left out if the logged commands are not the controller's."""

    name: str  # name in notes
    faults: int  # bits of the faults that the audit raises
    limits: tuple[str, ...]  # names of the limits that the audit checks
    tolerance: (
        float  # largest difference of commands, divided by their range, for which the audit is valid [1]
    )


AUDITS = (
    Audit("energy and momentum", ENERGY_BALANCE | MOMENTUM, ("energy_balance", "momentum_error"), 1e-9),
    Audit(
        "restitution, duration, released energy and impulse",
        RESTITUTION | CONTACT_TOO_LONG | ENERGY_GAIN | UNPAID_IMPULSE,
        ("restitution_margin", "longest_contact", "energy_gain", "unpaid_impulse"),
        0.01,
    ),
)


class ReplayedRun(NamedTuple):
    """Commands and faults of the controller in one run (usually one contact) of a log."""

    rows: slice  # rows of the log
    commands: np.ndarray  # controller's commands, (rows, axes); NaN in rows that are not compared
    faults: tuple[tuple[str, int, float], ...]  # name, number of ticks and first instant [s] of each fault
    cause: int  # bits of the faults that tripped the controller; 0 without a trip
    trip: tuple[float, str] | None  # instant [s] and reason of the trip
    missed: int  # number of missed ticks, by the time stamps
    late: int  # number of late ticks
    law_status: str  # status of the compensator for the last audited contact of the run


def replay_log(
    make_controller: Callable[[], Any], ticks: LoggedTicks, controller: Any = None
) -> tuple[list[ReplayedRun], Any]:
    """Feed a log's readings to a controller, one run (usually one contact) after another.

    Args:
        make_controller: Function that returns a new `Controller` or `Controller6`.
        ticks: Readings of the log.
        controller: Controller that replayed the session's previous log; None for a new session.

    Returns:
        The replayed runs, and the controller after the last run.
    """
    edges = [*ticks.starts.tolist(), len(ticks.tick)]
    runs = []
    for first, last in pairwise(edges):
        if controller is None or controller.tripped:
            # As after `reset`, the controller forgets what it has identified.
            controller = make_controller()
        else:
            controller.next_contact()
        runs.append(_replay_run(controller, ticks, slice(first, last)))
    return runs, controller


def _replay_run(controller: Any, ticks: LoggedTicks, rows: slice) -> ReplayedRun:
    """Feed the readings of one run to the controller; return its commands and faults up to a trip."""
    unwrap = ticks.axes == 1
    columns = [
        getattr(ticks, name)[rows, 0].tolist() if unwrap else getattr(ticks, name)[rows].tolist()
        for name in ("force", "position_desired", "velocity_desired", "position_measured")
    ]
    _, position, velocity, _ = columns
    stamps = None if ticks.time is None else ticks.time[rows].tolist()
    tick, instant = ticks.tick[rows].tolist(), ticks.instant[rows].tolist()
    move: Callable[..., Any] = controller.position_command if unwrap else controller.pose_command
    move(position[0], velocity[0], 0.0)
    counts = controller.missed_ticks, controller.late_ticks
    audited = controller.last_contact.number
    commands = np.full((len(tick), ticks.axes), np.nan)
    seen: dict[int, list[float]] = {}  # number of ticks and first instant of each fault's bit
    trip = None
    for row, readings in enumerate(zip(*columns, strict=True)):
        command = controller.step(*readings, None if stamps is None else stamps[row])
        faults = controller.faults
        if row + 1 < len(tick) and tick[row + 1] == tick[row] + 1 and not controller.tripped:
            # All integrators compute v(n+1) = v(n) + T a, so that the log determines a.
            rate = (velocity[row + 1] - velocity[row]) / ticks.period if unwrap else None
            move(position[row + 1], velocity[row + 1], rate)
            faults |= controller.faults
        _count(seen, faults, instant[row])
        if controller.tripped:
            trip = instant[row], controller.status
            break
        commands[row] = command
    if trip is None and _has_ended(ticks.force[rows]):
        controller.next_contact()  # this call audits the contact
        _count(seen, controller.faults, instant[-1])
        trip = (instant[-1], controller.status) if controller.tripped else None
    record = controller.last_contact
    return ReplayedRun(
        rows=rows,
        commands=commands,
        faults=tuple(
            (name, int(number), first)
            for bit, (number, first) in sorted(seen.items(), key=lambda item: item[1][1])
            for name in fault_names(bit, controller.fault_table)
        ),
        cause=controller.cause,
        trip=trip,
        missed=controller.missed_ticks - counts[0],
        late=controller.late_ticks - counts[1],
        law_status=record.status if record.number > audited else "unstated",
    )


def _count(seen: dict[int, list[float]], faults: int, instant: float) -> None:
    """Add the faults of one tick (bits) to `seen`, which holds the count and first instant of each fault."""
    while faults:
        bit = faults & -faults
        seen.setdefault(bit, [0, instant])[0] += 1
        faults ^= bit


def _has_ended(force: np.ndarray) -> bool:
    """Return whether a run ends without contact force, so that the watchdog can audit (check) the contact."""
    size = np.linalg.norm(force, axis=1)
    return bool(size[-1] <= ENDED_SHARE * np.nanmax(size)) if np.any(np.isfinite(size)) else False


def compare_commands(ticks: LoggedTicks, run: ReplayedRun) -> tuple[np.ndarray, np.ndarray]:
    """Return the controller's commands minus the logged ones, (rows, axes), and the logged commands' ranges.

    Rows in which a command is missing are NaN. The first row of a run is NaN if its logged command is 0,
    because rigs with a noisy sensor command no force in the first tick. Each range also includes 0;
    force and moment have separate ranges.
    """
    logged = ticks.command[run.rows]
    difference = run.commands - logged
    if not np.any(logged[0]):
        difference[0] = np.nan
    parts = [logged[:, :3], logged[:, 3:]] if ticks.axes == 6 else [logged]
    ranges = [float(np.nanmax(part, initial=0.0) - np.nanmin(part, initial=0.0)) for part in parts]
    return difference, np.array(ranges)


def relative_difference(difference: np.ndarray, ranges: np.ndarray) -> float:
    """Return the largest difference of force or moment commands, divided by the range of these commands."""
    parts = np.split(difference, len(ranges), axis=1)
    return max(
        _divide(float(np.nanmax(np.abs(part), initial=0.0)), float(size))
        for part, size in zip(parts, ranges, strict=True)
    )


def _divide(value: float, size: float) -> float:
    return value / size if size > 0.0 else (0.0 if value == 0.0 else math.inf)


def replay_logs(
    make_controller: Callable[[Sequence[str]], Any], logs: Sequence[LoggedTicks], is_session: bool
) -> tuple[list[list[ReplayedRun]], list[str]]:
    """Replay all logs, without the watchdog's audits (checks) that are not valid for these logs.

    Args:
        make_controller: Function that takes names of limits; returns a new controller without these limits.
        logs: Readings of each log.
        is_session: Whether all logs belong to one session.

    Returns:
        The runs of each log, and notes on the audits that were left out.
    """
    left_out: list[Audit] = []
    while True:
        make = partial(make_controller, [name for audit in left_out for name in audit.limits])
        replays, controller = [], None
        for ticks in logs:
            runs, controller = replay_log(make, ticks, controller if is_session else None)
            replays.append(runs)
        invalid = [audit for audit in AUDITS if audit not in left_out and _is_invalid(audit, logs, replays)]
        if not invalid:
            return replays, [
                f"the watchdog's audit of {audit.name} is left out: the model in the logs moved under other "
                f"commands (difference above {audit.tolerance:g} of their range), or rows are lost"
                for audit in left_out
            ]
        left_out += invalid


def _is_invalid(audit: Audit, logs: Sequence[LoggedTicks], replays: Sequence[Sequence[ReplayedRun]]) -> bool:
    """Return whether an audit trips without meaning: rows are lost, or controller and log disagree."""
    for ticks, runs in zip(logs, replays, strict=True):
        for run in runs:
            has_gaps = np.any((ticks.gaps >= run.rows.start) & (ticks.gaps < run.rows.stop))
            if run.cause & audit.faults and (
                has_gaps or relative_difference(*compare_commands(ticks, run)) > audit.tolerance
            ):
                return True
    return False
