"""Draft of a mapping file from the names and values of a log's columns, for the user to check.

The name of a column indicates the channel and, in brackets or after an underscore, the unit. If a unit is
missing, it is guessed from the values. The signs are also guessed from the values, for the convention that
positions increase towards contact and that a force which pushes the bodies apart is positive.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxhil.errors import InputError, to_one_line
from tuning.identification.logs import checks
from tuning.identification.logs.contact_detection import estimate_contact_threshold, estimate_resting_force
from tuning.identification.logs.mapping import KINDS, SCHEMA
from tuning.identification.logs.readers import ColumnsByName, OpenLog, open_log
from tuning.identification.logs.units import UNITS_OF_CHANNEL

# Patterns of column names for each channel. A column belongs to the first channel whose pattern matches.
CHANNEL_PATTERNS = {
    "time": r"^t$|time|stamp|clock",
    "velocity_desired": r"^v_?d$|vel\w*_?(des|cmd|com|ref)|(des|cmd|com|ref)\w*_?vel",
    "force_command": r"^f_?c$|(force|f)_?(cmd|com|ref)|(cmd|com|ref)\w*_?force",
    "contact_index": r"^contact(_?(index|number|no))?$|touch_?(index|number|no)",
    "mode": r"^mode$|^state$|^phase$",
    "force_measured": r"force|load|^f_?m?$|^f_?[xyz]$|newton|cell",
    "position_desired": r"^x_?d$|cmd|command|desired|demand|set_?point|target|reference|(^|_)ref",
    "position_measured": r"^x_?m$|^x_?a$|pos|meas|actual|feedback|disp|lvdt|encoder|^x$",
}
REQUIRED_CHANNELS = ("position_desired", "position_measured")
# Maximum plausible range of a channel in SI units; a larger range indicates mm or um.
TYPICAL_MAXIMUM = {"position_desired": 0.5, "position_measured": 0.5, "velocity_desired": 1.0}
MAX_SAMPLED_ROWS = 200_000  # maximum number of rows that are read
# Common control rates [Hz].
COMMON_CONTROL_RATES = (
    100,
    125,
    200,
    250,
    400,
    500,
    800,
    1000,
    1024,
    1250,
    1600,
    2000,
    2048,
    2500,
    4000,
    5000,
    8000,
)
MAX_CONTROL_PERIOD = 0.02  # s, longest plausible time between rows

_UNIT_SUFFIXES = {unit for units in UNITS_OF_CHANNEL.values() for unit in units if unit != "m"}


class ChannelGuess(NamedTuple):
    """Guess of a channel's column, unit and sign, with the reason for the guess."""

    column: str
    unit: str | None  # None for the SI unit
    sign: int
    why: str


def draft_mapping(paths: Sequence[Path]) -> str:
    """Draft a mapping file for logs and return its text.

    Raises:
        InputError: If no log is given, or if no column name matches a required channel.
    """
    if not paths:
        raise InputError("logs: found none, expected one or more files")
    logs = {path: open_log(path) for path in paths}
    first = next(iter(logs.values()))
    columns = _match_columns(first.names)
    for name in REQUIRED_CHANNELS:
        if name not in columns:
            names = ", ".join(to_one_line(column, 40) for column in first.names[:12])
            raise InputError(
                f"{first.label}: found no column with a name like {name}, expected one; columns: {names}"
            )
    kinds = {path: _guess_kind(path, log, columns) for path, log in logs.items()}
    # Only a log of kind contact shows the signs.
    best = next((path for path, kind in kinds.items() if kind == "contact"), paths[0])
    guesses = _guess_channels(logs[best], columns)
    return "\n".join(
        [*_format_channels(guesses), *_format_timing(logs[best], guesses), *_format_runs(paths, kinds), ""]
    )


def _match_columns(names: Sequence[str]) -> dict[str, str]:
    """Return the column of each channel, by the patterns of names in `CHANNEL_PATTERNS`."""
    result: dict[str, str] = {}
    for name in names:
        bare = _strip_unit(name)
        for channel, pattern in CHANNEL_PATTERNS.items():
            if re.search(pattern, bare):
                result.setdefault(channel, name)
                break
    return result


def _strip_unit(name: str) -> str:
    """Return the name of a column in lower case and without its unit."""
    bare = re.sub(r"\s*[\[(][^\])]*[\])]\s*$", "", name).strip().lower().replace(" ", "_").replace("-", "_")
    head, _, tail = bare.rpartition("_")
    return head if head and any(tail == unit.lower() for unit in _UNIT_SUFFIXES) else bare


def _find_unit(name: str, channel: str) -> str | None:
    """Return the unit at the end of a column name, in brackets or after an underscore, or None.

    The ending `_m` is not a unit, because it often means "measured".
    """
    match = re.search(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$|_([A-Za-z]+)$", name)
    if match is None or match.group(2) == "m":
        return None
    word = (match.group(1) or match.group(2)).replace("\u00b5", "u").lower()
    return next((unit for unit in UNITS_OF_CHANNEL.get(channel, {}) if unit.lower() == word), None)


def _guess_kind(path: Path, log: OpenLog, columns: Mapping[str, str]) -> str:
    """Guess the kind of experiment from the file name or, if it contains none, from the values."""
    named = [kind for kind in KINDS if kind in path.stem.lower()]
    if named:
        return named[0]
    wanted = [columns[name] for name in ("position_desired", "force_measured") if name in columns]
    read = _sample_rows(log, wanted)
    if np.all(read[columns["position_desired"]] == read[columns["position_desired"]][0]):
        return "rest"
    force = read.get(columns.get("force_measured", ""))
    if force is None or force.dtype == object:
        return "free"
    return (
        "contact"
        if np.mean(np.abs(force - estimate_resting_force(force)) > 2 * estimate_contact_threshold(force))
        > 0.01
        else "free"
    )


def _sample_rows(log: OpenLog, names: Sequence[str]) -> ColumnsByName:
    """Read the given columns and return the first rows, without rows in which a value is missing."""
    read = log.read(names)
    # Columns with other time stamps may have other lengths.
    rows = min(MAX_SAMPLED_ROWS, *(len(values) for values in read.values()))
    read = {name: values[:rows] for name, values in read.items()}
    valid = [
        np.abs(values) <= checks.MAX_ABSOLUTE_VALUE for values in read.values() if values.dtype != object
    ]
    used = np.all(valid, axis=0) if valid else slice(None)
    read = {name: values[used] for name, values in read.items()}
    rows = len(next(iter(read.values())))
    if rows < checks.MIN_LOG_ROWS:
        raise InputError(
            f"{log.label}: found {rows} rows of numbers, expected at least {checks.MIN_LOG_ROWS}"
        )
    return read


def _guess_channels(log: OpenLog, columns: Mapping[str, str]) -> dict[str, ChannelGuess]:
    """Guess the unit and sign of each channel."""
    read = _sample_rows(log, list(dict.fromkeys(columns.values())))
    signs = _guess_signs(read, columns)
    result = {}
    for channel, column in columns.items():
        unit, why = _find_unit(column, channel), "by its name"
        values = read[column]
        if unit is None and channel == "time" and values.dtype != object:
            step = float(np.median(np.diff(values)))
            unit = next(
                (name for name, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)) if step * size <= 0.02), "ns"
            )
            why += f"; rows are {step:.4g} {unit} apart"
        elif (
            unit is None
            and channel in TYPICAL_MAXIMUM
            and values.dtype != object
            and np.ptp(values) > TYPICAL_MAXIMUM[channel]
        ):
            size = float(np.ptp(values))
            unit = "um" if size > 1000 * TYPICAL_MAXIMUM[channel] else "mm"
            unit += "/s" * (channel == "velocity_desired")
            why += f"; values span {size:.3g}"
        result[channel] = ChannelGuess(column, unit, signs.get(channel, 1), why)
    return result


def _guess_signs(read: ColumnsByName, columns: Mapping[str, str]) -> dict[str, int]:
    """Return the signs for which positions increase towards contact and contact forces are positive."""

    def of(channel: str) -> np.ndarray | None:
        values = read.get(columns.get(channel, ""))
        return None if values is None or values.dtype == object else values

    force, x, measured = of("force_measured"), of("position_desired"), of("position_measured")
    if x is None or measured is None:
        return {}  # The reader of the mapping rejects columns of texts.
    signs = {}
    towards = 1
    if force is not None:
        contact_force = force - estimate_resting_force(force)
        in_contact = np.abs(contact_force) > estimate_contact_threshold(force)
        if np.any(in_contact) and not np.all(in_contact):
            signs["force_measured"] = int(np.sign(np.median(contact_force[in_contact])) or 1)
            towards = int(np.sign(np.mean(x[in_contact]) - np.mean(x[~in_contact])) or 1)
            command = of("force_command")
            if command is not None and np.any(command[in_contact]):
                signs["force_command"] = int(np.sign(np.median(command[in_contact])) or 1)
    together = int(np.sign(np.dot(x - np.mean(x), measured - np.mean(measured))) or 1)
    return signs | {
        "position_desired": towards,
        "velocity_desired": towards,
        "position_measured": towards * together,
    }


def _format_channels(guesses: Mapping[str, ChannelGuess]) -> list[str]:
    lines = ["# A draft: check every line. Values are sign * (scale * number + offset), in the unit.", ""]
    lines += [f'schema = "{SCHEMA}"', "", "[channels]"]
    if "time" not in guesses:
        lines.append("time = { rate = 1000.0 }  # Hz; no column name indicates time stamps")
    for channel in [name for name in (*UNITS_OF_CHANNEL, "mode", "contact_index") if name in guesses]:
        guess = guesses[channel]
        items = [f"column = {json.dumps(guess.column, ensure_ascii=False)}"]
        items += [f'unit = "{guess.unit}"'] if guess.unit else []
        items += [f"sign = {guess.sign}"] if guess.sign < 0 else []
        lines.append(f"{channel} = {{ {', '.join(items)} }}  # {guess.why}")
    return lines


def _format_timing(log: OpenLog, guesses: Mapping[str, ChannelGuess]) -> list[str]:
    lines, time, period = ["", "[timing]"], guesses.get("time"), 0.001
    stamps = np.empty(0) if time is None else _sample_rows(log, [time.column])[time.column]
    if time is not None and stamps.dtype != object:
        step = float(np.median(np.diff(stamps))) * UNITS_OF_CHANNEL["time"][time.unit or "s"]
        usual = 1.0 / min(COMMON_CONTROL_RATES, key=lambda rate: abs(rate * step - 1.0))
        period = usual if abs(step / usual - 1.0) < 0.05 else float(f"{step:.3g}")
    return [
        *lines,
        f"control_period = {period!r}",
        'command_hold = "linear"  # or "zoh": input of the drives between two ticks',
        "command_latency = 0  # periods until a command reaches the drives: 0 or 1",
        'row = "tick"  # or "sent": with the next tick\'s command; "after": with the next tick\'s readings',
        "",
        "# [bodies]  # of the numerical model; required without a prior",
        "# equivalent_mass = 350.0",
    ]


def _format_runs(paths: Sequence[Path], kinds: Mapping[Path, str]) -> list[str]:
    lines = []
    for kind in dict.fromkeys(kinds.values()):
        names = [path.name for path in paths if kinds[path] == kind]
        suffix = Path(names[0]).suffix
        pattern = f"{kind}*{suffix}"
        matching = {path.name for path in paths if fnmatch(path.name, pattern)}
        files = json.dumps(pattern if matching == set(names) else names, ensure_ascii=False)
        other_kinds = ", ".join(name for name in KINDS if name != kind)
        lines += ["", "[[runs]]", f"files = {files}", f'kind = "{kind}"  # or {other_kinds}']
    return lines
