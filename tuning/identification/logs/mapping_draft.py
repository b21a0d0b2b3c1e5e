"""Draft of a mapping file from the names and values of a log's columns, for the user to check.

The draft contains a line for every channel. If the names do not determine a channel, its line is a comment
that lists the candidate columns.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from jaxhil.errors import InputError, to_one_line
from tuning.identification.logs import checks
from tuning.identification.logs.channel_guess import (
    MAX_LISTED_COLUMNS,
    MIN_EVIDENCE_ROWS,
    choose_columns,
    guess_channels,
    match_columns,
)
from tuning.identification.logs.contact_detection import estimate_contact_threshold, estimate_resting_force
from tuning.identification.logs.log_sample import ChannelGuess, LogSample, sample_log
from tuning.identification.logs.mapping import KINDS, SCHEMA, TextFormat
from tuning.identification.logs.readers import DEFAULT_TEXT_FORMAT, OpenLog, open_log
from tuning.identification.logs.row_rate import MAX_ROWS_PER_PERIOD, find_command_phase
from tuning.identification.logs.time_guess import find_step
from tuning.identification.logs.units import UNITS_OF_CHANNEL

# Common control rates [Hz].
COMMON_CONTROL_RATES = (
    100, 125, 200, 250, 400, 500, 800, 1000, 1024, 1250, 1600, 2000, 2048, 2500, 4000, 5000, 8000
)  # fmt: skip


def draft_mapping(paths: Sequence[Path], text: TextFormat = DEFAULT_TEXT_FORMAT) -> str:
    """Draft a mapping file for logs and return its text.

    Args:
        paths: Paths of the logs.
        text: What the user specified about the format of text files.

    Raises:
        InputError: If no log is given, or if a log cannot be read.
    """
    if not paths:
        raise InputError("logs: found none, expected one or more files")
    logs = {path: open_log(path, text) for path in paths}
    matches = match_columns(next(iter(logs.values())))
    kinds = {path: _guess_kind(path, log, matches) for path, log in logs.items()}
    # Only a log of kind contact shows the signs.
    best = logs[next((path for path, kind in kinds.items() if kind == "contact"), paths[0])]
    named = [name for names in matches.values() for name in names]
    is_clear = all(
        len(matches.get(name, ())) == 1 for name in ("time", "position_desired", "position_measured")
    )
    sample = sample_log(best, named if is_clear else [*named, *_list_columns(best)])
    chosen = choose_columns(sample, matches)
    guesses = guess_channels(sample, chosen)
    return "\n".join(
        [
            *_format_channels(guesses),
            *_format_timing(sample, guesses),
            *_format_text(text),
            *_format_runs(paths, kinds),
            "",
        ]
    )


def _list_columns(log: OpenLog) -> list[str]:
    """Return the first columns that do not contain time stamps, as candidates for unrecognised channels."""
    return [name for name in log.names if name and name not in log.reader.stamps][: 4 * MAX_LISTED_COLUMNS]


def _guess_kind(path: Path, log: OpenLog, matches: Mapping[str, Sequence[str]]) -> str:
    """Guess the kind of experiment from the file name or, if the name states no kind, from the values."""
    named = [kind for kind in KINDS if kind in path.stem.lower()]
    if named:
        return named[0]
    forces = [name for name in matches.get("force_measured", ()) if name in log.names]
    positions = [name for name in matches.get("position_desired", ()) if name in log.names]
    sample = sample_log(log, [*forces, *positions])
    x = [values for name in positions if len(values := sample.numbers(name)) > MIN_EVIDENCE_ROWS]
    if x and not any(np.ptp(values) for values in x):
        return "rest"
    readings = [values for name in forces if len(values := sample.numbers(name)) > MIN_EVIDENCE_ROWS]
    if not readings:
        return "free" if x else "contact"
    return "contact" if any(map(_has_contact, readings)) else "free"


def _has_contact(force: np.ndarray) -> bool:
    is_high = np.abs(force - estimate_resting_force(force)) > 2 * estimate_contact_threshold(force)
    return bool(np.mean(is_high) > 0.01)


def _format_channels(guesses: Mapping[str, ChannelGuess]) -> list[str]:
    lines = ["# A draft: check every line. Values are sign * (scale * number + offset), in the unit."]
    lines += ["# Next: jaxhil identify LOGS --map FILE, with this draft in FILE.", ""]
    lines += [f'schema = "{SCHEMA}"', "", "[channels]"]
    if "time" not in guesses:
        lines.append("time = { rate = 1000.0 }  # Hz; no column name indicates time stamps")
    for channel in [name for name in (*UNITS_OF_CHANNEL, "mode", "contact_index") if name in guesses]:
        guess = guesses[channel]
        if guess.column is None:
            names = [_quote(name) for name in guess.candidates[:MAX_LISTED_COLUMNS]]
            more = ", ..." * (len(guess.candidates) > len(names))
            which = f"which of: {', '.join(names)}{more}" if names else "no column can be this channel"
            lines.append(f'# {channel} = {{ column = "" }}  # {which}')
            continue
        items = [f"column = {_quote(guess.column)}"]
        items += [f"nanoseconds = {_quote(guess.nanoseconds)}"] if guess.nanoseconds else []
        items += [f'time_format = "{guess.time_format}"'] if guess.time_format else []
        items += [f'unit = "{guess.unit}"'] if guess.unit else []
        items += [f"sign = {guess.sign}"] if guess.sign < 0 else []
        lines.append(f"{channel} = {{ {', '.join(items)} }}  # {to_one_line(guess.why)}")
    return lines


def _quote(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _format_timing(sample: LogSample, guesses: Mapping[str, ChannelGuess]) -> list[str]:
    period, rows, time, x = 0.001, 1, guesses.get("time"), np.empty(0)
    if (column := guesses["position_desired"].column) is not None:
        x = sample.numbers(column)
        x = x[sample.present[column]] if len(x) else x
    if time is not None and (step := find_step(sample, time, column)):
        rows = _count_rows_per_period(x)
        period = rows * step
        usual = 1.0 / min(COMMON_CONTROL_RATES, key=lambda rate: abs(rate * period - 1.0))
        period = usual if abs(period / usual - 1.0) < 0.05 else float(f"{period:.3g}")
    return [
        "",
        "[timing]",
        f"control_period = {period!r}",
        *([f"rows_per_period = {rows}  # rows of the log per command"] if rows > 1 else []),
        'command_hold = "linear"  # or "zoh": input of the drives between two ticks',
        "command_latency = 0  # periods until a command reaches the drives: 0 or 1",
        'row = "tick"  # or "sent": with the next tick\'s command; "after": with the next tick\'s readings',
        "",
        "# [bodies]  # of the numerical model; required without a prior",
        "# equivalent_mass = 350.0",
    ]


def _count_rows_per_period(x: np.ndarray) -> int:
    """Return the number of rows per command, or 1 if the commands do not show this number."""
    if len(x) < checks.MIN_LOG_ROWS:
        return 1
    if (rows := checks.find_change_interval(x)) > 1:
        return rows
    ticks = np.arange(len(x))
    candidates = range(MAX_ROWS_PER_PERIOD, 1, -1)
    return next((n for n in candidates if np.ptp(x) and find_command_phase(ticks, x, n) is not None), 1)


def _format_text(text: TextFormat) -> list[str]:
    stated = {name: getattr(text, name) for name in text.__struct_fields__ if getattr(text, name) is not None}
    lines = [f"{name} = {json.dumps(value)}" for name, value in stated.items()]
    return ["", "[text]", *lines] if lines else []


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
