"""Campaign from log files and their mapping: reading, checks and conversion to the grid of ticks.

A run has at most one contact: a log with several is divided midway between them. Without a channel of contact
numbers, contacts are numbered by their order in the file, like the lists of a mechanism file.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from jaxhil.errors import InputError, format_value, to_one_line
from jaxhil.mechanism.structs import Mechanism
from tuning.identification.logs import checks, clock, contact_detection
from tuning.identification.logs.channels import NUMERIC_CHANNELS, read_channels
from tuning.identification.logs.force_command_check import check_command
from tuning.identification.logs.lost_rows import LogSegment, split_at_gaps
from tuning.identification.logs.mapping import (
    KINDS,
    LogMapping,
    RunFiles,
    find_equivalent_mass,
    make_simulation_mapping,
)
from tuning.identification.logs.readers import open_log
from tuning.identification.logs.resampling import FORCE_LATE_CHANNEL
from tuning.identification.logs.row_convention import check_row_convention, detect_common_integrator
from tuning.identification.logs.scales import SPEED_SPAN_TICKS, check_velocity
from tuning.identification.records import Campaign, CampaignTiming, LoggedRun, RunKind

KINDS_SPLIT_AT_CONTACTS = ("tap", "contact")
MIN_SEGMENT_ROWS = 50  # rows, least length of a segment between gaps
MIN_VELOCITY_JUMP = 0.5  # jump of the velocity between runs of a log, over the 95 % quantile of the speed


def read_campaign(
    logs: Sequence[Path], mapping: LogMapping | None = None, prior: Mechanism | None = None
) -> Campaign:
    """Read all runs of the log files, in the order of the mapping's runs and, within each, of the files.

    Without a mapping the columns must have the names of `jaxhil simulate --log`, and every file is a run of
    contacts. The prior provides the timing and masses that the mapping omits.

    Args:
        logs: Paths of the log files.
        mapping: Mapping of columns to channels, or None.
        prior: Mechanism, or None.

    Returns:
        The runs with their timing.

    Raises:
        InputError: If a log cannot be read or fails a check; the message names file, row or column.
    """
    mapping = mapping or make_simulation_mapping()
    if not logs:
        raise InputError("logs: found none, expected one or more files")
    timing, mass = _make_timing(mapping, prior), find_equivalent_mass(mapping, prior)
    if mass is None:
        raise InputError(
            "bodies.equivalent_mass: found nothing, expected a number > 0 kg, here or in a prior"
        )
    for path in logs:
        if not any(entry.names(path) for entry in mapping.runs):
            patterns = ", ".join(format_value(pattern) for entry in mapping.runs for pattern in entry.files)
            raise InputError(f"{to_one_line(str(path))}: found a log that no run names, expected {patterns}")
    runs: list[LoggedRun] = []
    notes: dict[str, list[str]] = {}  # labels of the logs of each note
    clocks = []
    for entry in mapping.runs:
        for path in logs:
            if entry.names(path):
                reading = _RunsOfFile(path, entry, mapping, timing, mass, prior)
                runs += reading.runs
                for note in reading.notes:
                    notes.setdefault(note.removeprefix(f"{reading.label}: "), []).append(reading.label)
                clocks.append(reading.ticks.clock)
    integrator = detect_common_integrator(runs, timing.control_period) or (prior and prior.rig.integrator)
    if not timing.two_clocks:
        check_row_convention(runs, timing, integrator)
    timing = replace(timing, clock=max(clocks, key=lambda reading_clock: reading_clock.jitter))
    sources = {path.name: _hash_log(path) for path in logs}
    return Campaign(tuple(runs), timing, mass, sources, _merge_notes(notes), integrator)


def _merge_notes(notes: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return each note once, with the name of its first log and the number of further logs."""
    lines = []
    for note, labels in notes.items():
        more = len(set(labels)) - 1
        lines.append(f"{labels[0]}{f' and {more} more' * (more > 0)}: {note}")
    return tuple(lines)


class _RunsOfFile:
    """Runs of one file under one entry of the mapping."""

    def __init__(
        self,
        path: Path,
        entry: RunFiles,
        mapping: LogMapping,
        timing: CampaignTiming,
        mass: float,
        prior: Mechanism | None,
    ):
        self.label, self.notes = to_one_line(str(path)) or "''", list[str]()
        self.kind: RunKind = entry.kind
        self._path, self._timing, self._mass = path, timing, mass
        # Contacts so far; last tick and resting force of a contact that a gap interrupts.
        self._met, self._open = 0, None
        self._integrator = "semi_implicit_euler" if prior is None else prior.rig.integrator
        # The last entry of the contact lists repeats.
        lists = () if prior is None else (prior.contact.stiffness, prior.contact.damping)
        self._last = max(map(len, lists)) - 1 if lists else sys.maxsize
        log = open_log(path, mapping.text)
        columns, stamps, self._begin, notes = read_channels(log, mapping, timing.control_period)
        self.notes += notes
        used = _select_rows(stamps, entry, timing.control_period)
        if stamps is not None:
            self._begin += float(stamps[used][0]) if len(stamps[used]) else 0.0
        stamps, columns = None if stamps is None else stamps[used], {n: c[used] for n, c in columns.items()}
        rows = len(next(iter(columns.values())))
        if rows < checks.MIN_LOG_ROWS:
            allowed = f"at least {checks.MIN_LOG_ROWS}"
            raise InputError(f"{self.label}: found {rows} row{'s' * (rows != 1)}, expected {allowed}")
        period = timing.control_period
        if stamps is None or mapping.timing.clock == "index":
            self.ticks = clock.number_rows(rows, period)
        else:
            self.ticks = clock.assign_ticks(stamps, period, self.label)
        modes = _classify_rows(columns.pop("mode", None), mapping, entry.kind, self.label)
        channels = {name: columns.get(name) for name in (*NUMERIC_CHANNELS, FORCE_LATE_CHANNEL)}
        for name, values in channels.items():
            if values is not None:
                checks.check_values(self.label, name, values)
        if (index := channels["contact_index"]) is not None:
            channels["contact_index"] = index.astype(np.int64)
        self.runs = self._cut(channels, modes)

    def _cut(self, channels: dict[str, np.ndarray | None], modes: np.ndarray | None) -> list[LoggedRun]:
        """Return the runs, divided at gaps, changes of mode, jumps between runs, and contacts."""
        tick, x = self.ticks.tick, channels["position_desired"]
        assert x is not None
        cuts = _find_restarts(x, channels["contact_index"])
        if modes is not None:
            cuts = np.union1d(cuts, np.flatnonzero(modes[1:] != modes[:-1]) + 1)
        runs: list[LoggedRun] = []
        for stretch in split_at_gaps(tick, channels, cuts, self._timing.control_period, self._mass):
            if len(stretch.tick) < MIN_SEGMENT_ROWS:
                self.notes.append(f"{self.label}: {len(stretch.tick)} rows between gaps are left out")
                continue
            kind: RunKind = self.kind
            if modes is not None:
                kind = KINDS[int(modes[np.searchsorted(tick, stretch.tick[:1])][0])]
            runs += self._runs_of_segment(stretch, kind)
        if not runs:
            allowed = (
                f"at least {MIN_SEGMENT_ROWS} without a gap of more than 3, and a contact if the kind has one"
            )
            raise InputError(f"{self.label}: found {len(tick)} rows, expected {allowed}")
        return runs

    def _runs_of_segment(self, stretch: LogSegment, kind: RunKind) -> list[LoggedRun]:
        """Check a segment and return its runs: one for each contact, or a single one."""
        period, force = self._timing.control_period, stretch.channels["force_measured"]
        self.notes += checks.check_motion(self.label, kind, stretch, period, self._timing.command_hold)
        self._ignore(stretch, "velocity_desired", check_velocity(self.label, stretch, period))
        if kind not in ("press", *KINDS_SPLIT_AT_CONTACTS):
            return [self._run(stretch, kind, slice(None), None, None)]
        if force is None:
            allowed = "one where there is contact"
            raise InputError(f"{self.label}: force_measured: found no such channel, expected {allowed}")
        touched = self._touched(stretch.tick, force)
        holds = kind == "contact" and self._command_holds(stretch, touched)
        self.notes += checks.check_force(self.label, kind, stretch, touched, period, self._mass, holds)
        if kind == "press":
            return [self._run(stretch, kind, slice(None), None, None)]
        if not touched:
            self.notes.append(f"{self.label}: {len(stretch.tick)} rows without contact are left out")
        middles = [(contact[1] + two[0]) // 2 for contact, two in pairwise(touched)]
        parts = [slice(*edges) for edges in pairwise([0, *middles, len(stretch.tick)])]
        first = self._met - len(touched)
        return [
            self._run(stretch, kind, part, contact, min(first + number, self._last))
            for number, (part, contact) in enumerate(zip(parts, touched, strict=False))
        ]

    def _command_holds(self, stretch: LogSegment, touched: list[tuple[int, int]]) -> bool:
        """Return whether the force command moves the model; ignore the channel with a note if it cannot."""
        if stretch.channels["force_command"] is None:
            return False
        timing = self._timing
        holds, note = check_command(
            self.label, stretch, touched, timing.control_period, self._mass, timing.row, self._integrator
        )
        if holds:
            self.notes += [note] if note else []
        else:
            self._ignore(stretch, "force_command", note)
        return holds

    def _ignore(self, stretch: LogSegment, channel: str, note: str | None) -> None:
        """Remove a channel of a segment if there is a note with the reason."""
        if note is not None:
            self.notes.append(note)
            stretch.channels[channel] = None

    def _touched(self, tick: np.ndarray, force: np.ndarray) -> list[tuple[int, int]]:
        """Return the contacts of a segment, and count them; a contact may continue after a gap."""
        period, rest = self._timing.control_period, None
        if self._open is not None and (tick[0] - self._open[0]) * period < contact_detection.MIN_CONTACT_GAP:
            rest = self._open[1]
        touched = contact_detection.detect_contacts(force, period, rest)
        goes_on = rest is not None and bool(touched) and touched[0][0] == 0
        self._met += len(touched) - goes_on
        ended = not touched or touched[-1][1] < len(force) - contact_detection.MIN_CONTACT_TICKS
        self._open = (
            None
            if ended
            else (tick[-1], contact_detection.estimate_resting_force(force) if rest is None else rest)
        )
        return touched

    def _run(
        self,
        stretch: LogSegment,
        kind: RunKind,
        part: slice,
        touched: tuple[int, int] | None,
        number: int | None,
    ) -> LoggedRun:
        """Return a part of a segment as a run, with the contact's number if no channel contains it."""
        channels = {
            name: None if values is None else values[part] for name, values in stretch.channels.items()
        }
        tick, index = stretch.tick[part], channels["contact_index"]
        if index is None and number is not None:
            index = np.full(len(tick), number, np.int64)
        x, measured = stretch.channels["position_desired"], channels["position_measured"]
        assert x is not None and measured is not None
        return LoggedRun(
            kind=kind,
            source=self._path.name,
            tick=tick,
            time_stamp_error=self.ticks.clock.jitter,
            position_desired=x[part],
            position_measured=measured,
            force_measured=channels["force_measured"],
            velocity_desired=channels["velocity_desired"],
            force_command=channels["force_command"],
            valid=stretch.valid[part],
            contact_index=index,
            speed=None
            if touched is None
            else _estimate_approach_speed(x, touched[0], self._timing.control_period),
            begin=self._begin,
            force_late=channels[FORCE_LATE_CHANNEL],
        )


def _make_timing(mapping: LogMapping, prior: Mechanism | None) -> CampaignTiming:
    spec, rig = mapping.timing, None if prior is None else prior.rig
    period = spec.control_period or (rig and rig.control_period)
    if period is None and mapping.channels.time.rate is not None:
        period = 1.0 / mapping.channels.time.rate
    if period is None:
        raise InputError("timing.control_period: found nothing, expected a number > 0 s, here or in a prior")
    rate = mapping.channels.time.rate
    if rate is not None and abs(rate * period - 1.0) > 1e-6:
        raise InputError(
            f"channels.time.rate: found {rate:g} Hz, expected 1 / control_period, {1 / period:g} Hz"
        )
    hold = spec.command_hold or (rig.command_hold if rig else "linear")
    latency = spec.command_latency if spec.command_latency is not None else rig.command_latency if rig else 0
    late, separate = spec.computing_delay, spec.clock == "separate"
    return CampaignTiming(period, hold, latency, spec.row, None, late, separate)


def _select_rows(stamps: np.ndarray | None, entry: RunFiles, period: float) -> slice:
    """Return the rows from the begin to the end of an entry."""
    if stamps is None:
        return slice(round(entry.begin / period), None if entry.end is None else round(entry.end / period))
    first = int(np.searchsorted(stamps, entry.begin)) if entry.begin else 0
    return slice(first, None if entry.end is None else int(np.searchsorted(stamps, entry.end)))


def _classify_rows(
    values: np.ndarray | None, mapping: LogMapping, kind: RunKind, label: str
) -> np.ndarray | None:
    """Return the kind of experiment at each row as an index into `KINDS`, or None without a mode channel."""
    channel = mapping.channels.mode
    if values is None or channel is None:
        return None
    named, inverse = np.unique(np.asarray(values, dtype=str), return_inverse=True)
    kinds = []
    for name in named.tolist():
        word = name[:-2] if name.endswith(".0") else name
        kind_name = channel.values.get(word, word)
        if kind_name not in KINDS:
            row = int(np.flatnonzero(inverse == len(kinds))[0]) + 1
            allowed = f"one of {', '.join([*channel.values, *KINDS])}"
            raise InputError(f"{label}: row {row}: mode: found {format_value(word)}, expected {allowed}")
        kinds.append(KINDS.index(kind_name))
    return np.array(kinds)[inverse]


def _find_restarts(x: np.ndarray, index: np.ndarray | None) -> np.ndarray:
    """Return the rows at which another contact begins at another position, as in simulations."""
    if index is None:
        return np.empty(0, int)
    rows = np.flatnonzero(index[1:] != index[:-1]) + 1
    rows = rows[(rows >= 2) & (rows < len(x) - 1)]
    step = np.diff(x)
    return rows[np.abs(step[rows] - step[rows - 2]) > MIN_VELOCITY_JUMP * np.percentile(np.abs(step), 95)]


def _estimate_approach_speed(x: np.ndarray, begin: int, period: float) -> float | None:
    """Return the approach speed of a contact [m/s], or None."""
    # The contact begins some ticks before its force exceeds the noise.
    before = begin - SPEED_SPAN_TICKS
    if before < SPEED_SPAN_TICKS:
        return None
    return float(x[before] - x[before - SPEED_SPAN_TICKS]) / (SPEED_SPAN_TICKS * period)


def _hash_log(path: Path) -> str:
    """Return the hash of a file, or of the names and contents of a folder's files."""
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    digest = hashlib.sha256()
    for part in sorted(entry for entry in path.rglob("*") if entry.is_file()):
        digest.update(f"{_hash_log(part)} {part.relative_to(path).as_posix()}\n".encode())
    return digest.hexdigest()
