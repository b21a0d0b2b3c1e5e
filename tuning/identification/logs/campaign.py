"""Reading and checks of a campaign: from log files and their mapping to runs with one row per tick.

A run has at most one contact. A log with several contacts is therefore divided in the middle between
successive contacts. If the log has no channel `contact_index`, the contacts of a file are numbered in their
order. The number of a contact is its index into the lists in `[contact]`.
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
from tuning.identification.logs import checks, clock, contact_detection, row_rate
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
MIN_SEGMENT_ROWS = 50  # minimum number of rows in a segment between gaps
# A simulated contact begins with the rebound velocity of the contact before it, reversed. Minimum jump of the
# velocity there, relative to the speed and to the velocity's change in as many ticks before or after it.
RESTART_SPAN_TICKS = 5  # ticks between the two positions of a velocity, which may be rounded
MIN_JUMP_PER_SPEED, MIN_JUMP_PER_CHANGE = 1.2, 3.0


def read_campaign(
    logs: Sequence[Path], mapping: LogMapping | None = None, prior: Mechanism | None = None
) -> Campaign:
    """Read all runs of a campaign from log files and check them.

    The runs have the order of the `[[runs]]` entries in the mapping and, within an entry, the order of the
    files. A file without a run is omitted, with a note, if another file of the entry has runs. Without a
    mapping, the columns must have the names of `jaxhil simulate --log`, and the files must contain contacts.
    If the mapping omits the timing or the mass, the prior provides them.

    Args:
        logs: Paths of the log files.
        mapping: Mapping of columns to channels, or None.
        prior: Prior mechanism, or None.

    Returns:
        The runs with their timing.

    Raises:
        InputError: If a log cannot be read or fails a check. The message names the file and the row or
            column.
    """
    mapping = mapping or make_simulation_mapping()
    if not logs:
        raise InputError("logs: found none, expected one or more files")
    timing, mass = make_timing(mapping, prior), find_equivalent_mass(mapping, prior)
    if mass is None:
        raise InputError(
            "bodies.equivalent_mass: found nothing, expected a number > 0 kg in the mapping or in a prior"
        )
    check_names(logs, mapping.runs)
    runs: list[LoggedRun] = []
    notes: dict[str, list[str]] = {}  # for each note, the names of the logs that it concerns
    clocks = []
    for entry in mapping.runs:
        paths = [path for path in logs if entry.names(path)]
        readings = [_RunsOfFile(path, entry, mapping, timing, mass, prior) for path in paths]
        _check_any_run(readings)
        for reading in readings:
            runs += reading.runs
            for note in reading.notes:
                notes.setdefault(note.removeprefix(f"{reading.label}: "), []).append(reading.label)
            if reading.runs:
                clocks.append(reading.ticks.clock)
    integrator = detect_common_integrator(runs, timing.control_period) or (prior and prior.rig.integrator)
    if not timing.two_clocks:
        check_row_convention(runs, timing, integrator)
    timing = replace(timing, clock=max(clocks, key=lambda reading_clock: reading_clock.jitter))
    sources = {path.name: _hash_log(path) for path in logs}
    return Campaign(tuple(runs), timing, mass, sources, _merge_notes(notes), integrator)


def check_names(logs: Sequence[Path], entries: Sequence[RunFiles]) -> None:
    """Raise `InputError` if no `[[runs]]` entry matches the name of a log."""
    for path in logs:
        if not any(entry.names(path) for entry in entries):
            patterns = ", ".join(format_value(pattern) for entry in entries for pattern in entry.files)
            raise InputError(
                f"{to_one_line(str(path))}: found a name that no [[runs]] entry matches, expected {patterns}"
            )


def _check_any_run(readings: Sequence[_RunsOfFile]) -> None:
    """Raise `InputError` if none of the files of a `[[runs]]` entry has a run."""
    if readings and not any(reading.runs for reading in readings):
        more, rows = len(readings) - 1, sum(len(reading.ticks.tick) for reading in readings)
        raise InputError(
            f"{readings[0].label}{f' and {more} more' * (more > 0)}: found no run in {rows} rows, "
            f"expected at least {MIN_SEGMENT_ROWS} successive rows; for the kinds contact and tap, with a "
            "contact"
        )


def _merge_notes(notes: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return every note once, with the name of its first log and the number of the other logs."""
    lines = []
    for note, labels in notes.items():
        more = len(set(labels)) - 1
        lines.append(f"{labels[0]}{f' and {more} more' * (more > 0)}: {note}")
    return tuple(lines)


class _RunsOfFile:
    """Runs in one log file, according to one `[[runs]]` entry of the mapping."""

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
        # Number of contacts so far; last tick and force at rest of a contact that a gap interrupts.
        self._contact_count, self._open_contact = 0, None
        self._integrator = "semi_implicit_euler" if prior is None else prior.rig.integrator
        # If there are more contacts than list entries, the other contacts use the last entry.
        lists = () if prior is None else (prior.contact.stiffness, prior.contact.damping)
        self._last = max(map(len, lists)) - 1 if lists else sys.maxsize
        log = open_log(path, mapping.text)
        columns, stamps, self._begin, notes = read_channels(log, mapping, timing.control_period)
        self.notes += notes
        used = select_rows(stamps, entry, timing.control_period)
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
        modes = classify_rows(columns.pop("mode", None), mapping, entry.kind, self.label)
        channels = {name: columns.get(name) for name in (*NUMERIC_CHANNELS, FORCE_LATE_CHANNEL)}
        for name, values in channels.items():
            if values is not None:
                checks.check_values(self.label, name, values)
        if (index := channels["contact_index"]) is not None:
            channels["contact_index"] = index.astype(np.int64)
        self.runs = self._split_runs(channels, modes)

    def _split_runs(
        self, channels: dict[str, np.ndarray | None], modes: np.ndarray | None
    ) -> list[LoggedRun]:
        """Divide the log into runs: at gaps, at changes of the mode, at restarts, and between contacts."""
        tick, x = self.ticks.tick, channels["position_desired"]
        assert x is not None
        cuts = find_restarts(x, channels["contact_index"])
        if modes is not None:
            cuts = np.union1d(cuts, np.flatnonzero(modes[1:] != modes[:-1]) + 1)
        segments: list[tuple[RunKind, LogSegment]] = []
        for segment in split_at_gaps(tick, channels, cuts, self._timing.control_period, self._mass):
            if len(segment.tick) < MIN_SEGMENT_ROWS:
                self.notes.append(f"{self.label}: {len(segment.tick)} rows between gaps are omitted")
                continue
            kind: RunKind = self.kind
            if modes is not None:
                kind = KINDS[int(modes[np.searchsorted(tick, segment.tick[:1])][0])]
            segments.append((kind, segment))
        # Check the longest part of each kind: a short one between two gaps may show too little of the motion.
        longest = dict(sorted(segments, key=lambda entry: len(entry[1].tick)))
        runs: list[LoggedRun] = []
        for kind, segment in segments:
            runs += self._make_runs(segment, kind, segment is longest[kind])
        return runs

    def _make_runs(self, segment: LogSegment, kind: RunKind, has_motion: bool) -> list[LoggedRun]:
        """Check a segment of the log and return its runs: one per contact, or a single run.

        `has_motion` states whether the segment is long enough to check its motion.
        """
        period, force = self._timing.control_period, segment.channels["force_measured"]
        if has_motion:
            self.notes += checks.check_motion(self.label, kind, segment, period, self._timing.command_hold)
        self._ignore_channel(segment, "velocity_desired", check_velocity(self.label, segment, period))
        if kind not in ("press", *KINDS_SPLIT_AT_CONTACTS):
            return [self._make_run(segment, kind, slice(None), None, None)]
        if force is None:
            raise InputError(f"{self.label}: force_measured: found no such channel, needed for kind {kind}")
        contacts = self._detect_contacts(segment.tick, force)
        holds = kind == "contact" and self._is_command_valid(segment, contacts)
        self.notes += checks.check_force(self.label, kind, segment, contacts, period, self._mass, holds)
        if kind == "press":
            return [self._make_run(segment, kind, slice(None), None, None)]
        if not contacts:
            self.notes.append(f"{self.label}: {len(segment.tick)} rows without contact are omitted")
        middles = [(contact[1] + two[0]) // 2 for contact, two in pairwise(contacts)]
        parts = [slice(*edges) for edges in pairwise([0, *middles, len(segment.tick)])]
        first = self._contact_count - len(contacts)
        return [
            self._make_run(segment, kind, part, contact, min(first + number, self._last))
            for number, (part, contact) in enumerate(zip(parts, contacts, strict=False))
        ]

    def _is_command_valid(self, segment: LogSegment, contacts: list[tuple[int, int]]) -> bool:
        """Return whether the force command explains the motion; if not, remove the channel and add a note."""
        if segment.channels["force_command"] is None:
            return False
        timing = self._timing
        holds, note = check_command(
            self.label, segment, contacts, timing.control_period, self._mass, timing.row, self._integrator
        )
        if holds:
            self.notes += [note] if note else []
        else:
            self._ignore_channel(segment, "force_command", note)
        return holds

    def _ignore_channel(self, segment: LogSegment, channel: str, note: str | None) -> None:
        """Remove a channel from a segment and record the reason, `note`; do nothing if there is no note."""
        if note is not None:
            self.notes.append(note)
            segment.channels[channel] = None

    def _detect_contacts(self, tick: np.ndarray, force: np.ndarray) -> list[tuple[int, int]]:
        """Return the row ranges of the contacts in a segment; count the contacts of the file.

        A contact that a gap interrupts is counted once.
        """
        period, rest = self._timing.control_period, None
        if (
            self._open_contact is not None
            and (tick[0] - self._open_contact[0]) * period < contact_detection.MIN_CONTACT_GAP
        ):
            rest = self._open_contact[1]
        contacts = contact_detection.detect_contacts(force, period, rest)
        continues = rest is not None and bool(contacts) and contacts[0][0] == 0
        self._contact_count += len(contacts) - continues
        ended = not contacts or contacts[-1][1] < len(force) - contact_detection.MIN_CONTACT_TICKS
        self._open_contact = (
            None
            if ended
            else (tick[-1], contact_detection.estimate_resting_force(force) if rest is None else rest)
        )
        return contacts

    def _make_run(
        self,
        segment: LogSegment,
        kind: RunKind,
        part: slice,
        contact: tuple[int, int] | None,
        number: int | None,
    ) -> LoggedRun:
        """Convert part of a segment to a run; `number` is the run's contact index if the log has none."""
        channels = {
            name: None if values is None else values[part] for name, values in segment.channels.items()
        }
        tick, index = segment.tick[part], channels["contact_index"]
        if index is None and number is not None:
            index = np.full(len(tick), number, np.int64)
        x, measured = segment.channels["position_desired"], channels["position_measured"]
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
            valid=segment.valid[part],
            contact_index=index,
            speed=None
            if contact is None
            else _estimate_approach_speed(x, contact[0], self._timing.control_period),
            begin=self._begin,
            force_late=channels[FORCE_LATE_CHANNEL],
        )


def make_timing(mapping: LogMapping, prior: Mechanism | None) -> CampaignTiming:
    """Return the timing of the logs, from the mapping or, where the mapping omits it, from the prior.

    Raises:
        InputError: If neither the mapping nor the prior states the control period, or if the rate of the rows
            does not fit the control period.
    """
    spec, rig = mapping.timing, None if prior is None else prior.rig
    period = spec.control_period or (rig and rig.control_period)
    if period is None and mapping.channels.time.rate is not None:
        period = 1.0 / mapping.channels.time.rate
    if period is None:
        raise InputError(
            "timing.control_period: found nothing, expected a number > 0 s in the mapping or in a prior"
        )
    rate, rows = mapping.channels.time.rate, spec.rows_per_period
    if rate is not None:
        ratio = rate * period / (rows or max(round(rate * period), 1))
        if abs(ratio - 1.0) > 1e-6 or rate * period > row_rate.MAX_ROWS_PER_PERIOD + 0.5:
            times = "" if rows in (None, 1) else f"{rows} times "
            raise InputError(
                f"channels.time.rate: found {rate:g} Hz, expected {times}1 / control_period, "
                f"{(rows or 1) / period:g} Hz"
            )
    hold = spec.command_hold or (rig.command_hold if rig else "linear")
    latency = spec.command_latency if spec.command_latency is not None else rig.command_latency if rig else 0
    computing_delay, has_two_clocks = spec.computing_delay, spec.clock == "separate"
    return CampaignTiming(period, hold, latency, spec.row, None, computing_delay, has_two_clocks)


def select_rows(stamps: np.ndarray | None, entry: RunFiles, period: float) -> slice:
    """Return the rows of a log from the time `begin` to the time `end` of its `[[runs]]` entry."""
    if stamps is None:
        return slice(round(entry.begin / period), None if entry.end is None else round(entry.end / period))
    first = int(np.searchsorted(stamps, entry.begin)) if entry.begin else 0
    return slice(first, None if entry.end is None else int(np.searchsorted(stamps, entry.end)))


def classify_rows(
    values: np.ndarray | None, mapping: LogMapping, kind: RunKind, label: str
) -> np.ndarray | None:
    """Return, for each row, the index of its kind of experiment into `KINDS`; None without a mode channel."""
    channel = mapping.channels.mode
    if values is None or channel is None:
        return None
    modes, inverse = np.unique(np.asarray(values, dtype=str), return_inverse=True)
    kinds = []
    for name in modes.tolist():
        mode = name[:-2] if name.endswith(".0") else name
        kind_name = channel.values.get(mode, mode)
        if kind_name not in KINDS:
            row = int(np.flatnonzero(inverse == len(kinds))[0]) + 1
            allowed = f"one of {', '.join([*channel.values, *KINDS])}"
            raise InputError(f"{label}: row {row}: mode: found {format_value(mode)}, expected {allowed}")
        kinds.append(KINDS.index(kind_name))
    return np.array(kinds)[inverse]


def find_restarts(x: np.ndarray, index: np.ndarray | None) -> np.ndarray:
    """Return the rows at which the velocity jumps because a simulated log begins the next contact there."""
    if index is None:
        return np.empty(0, int)
    rows = np.flatnonzero(index[1:] != index[:-1]) + 1
    span = RESTART_SPAN_TICKS
    rows = rows[(rows > 2 * span) & (rows < len(x) - 2 * span)]
    before, after = x[rows - 1] - x[rows - 1 - span], x[rows + span] - x[rows]
    earlier = x[rows - 1 - span] - x[rows - 1 - 2 * span]
    later = x[rows + 2 * span] - x[rows + span]
    change = np.minimum(np.abs(before - earlier), np.abs(later - after))
    speed = np.maximum(np.abs(before), np.abs(after))
    jump = np.abs(after - before)
    return rows[(jump > MIN_JUMP_PER_SPEED * speed) & (jump > MIN_JUMP_PER_CHANGE * change)]


def _estimate_approach_speed(x: np.ndarray, begin: int, period: float) -> float | None:
    """Return the approach speed of a contact [m/s], or None if the log does not contain the approach."""
    # A contact begins some ticks before its force exceeds the noise.
    before = begin - SPEED_SPAN_TICKS
    if before < SPEED_SPAN_TICKS:
        return None
    return float(x[before] - x[before - SPEED_SPAN_TICKS]) / (SPEED_SPAN_TICKS * period)


def _hash_log(path: Path) -> str:
    """Return the SHA-256 of a log file; for a log folder, of the names and contents of all its files."""
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    digest = hashlib.sha256()
    for part in sorted(entry for entry in path.rglob("*") if entry.is_file()):
        digest.update(f"{_hash_log(part)} {part.relative_to(path).as_posix()}\n".encode())
    return digest.hexdigest()
