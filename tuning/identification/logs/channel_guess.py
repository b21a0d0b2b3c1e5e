"""Guesses of channels, units and signs from the names, units and values of a log's columns.

The name of a column and the unit that the file states indicate the channel. If several columns fit equally,
or none does, the guess lists them and the user decides. A unit that the file does not state is guessed from
the values, and both positions get the same unit. The signs are also guessed from the values. By convention,
positions increase towards contact, and a force that pushes the bodies apart is positive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tuning.identification.logs.column_names import find_unit, match_channel
from tuning.identification.logs.contact_detection import estimate_contact_threshold, estimate_resting_force
from tuning.identification.logs.log_sample import ChannelGuess, LogSample
from tuning.identification.logs.readers import OpenLog
from tuning.identification.logs.time_guess import find_step, guess_time
from tuning.identification.logs.units import LENGTH_UNITS, SPEED_UNITS, parse_unit

POSITIONS = ("position_desired", "position_measured")
NEEDED_CHANNELS = (*POSITIONS, "force_measured")  # channels that are listed as unknown if no name fits
MIN_EVIDENCE_ROWS = 10  # minimum number of rows for guesses from values
MAX_LISTED_COLUMNS = 12  # maximum number of columns in a list of candidates
TYPICAL_STROKE = 0.5  # a larger stroke without a unit indicates mm or um [m]
MAX_EQUAL_UNIT_RATIO = 30.0  # maximum ratio of the strokes of two positions in the same unit


def match_columns(log: OpenLog) -> dict[str, list[str]]:
    """Return for each channel the columns whose names fit best: one, or several that fit equally well."""
    matches: dict[str, list[tuple[int, str]]] = {}
    for name in dict.fromkeys(log.names):
        match = match_channel(name, log.reader.units.get(name) or find_unit(name))
        if match is not None:
            matches.setdefault(match.channel, []).append((match.certainty, name))
    best = {channel: max(found)[0] for channel, found in matches.items()}
    return {
        channel: [name for certainty, name in found if certainty == best[channel] or channel == "time"]
        for channel, found in matches.items()
    }


def choose_columns(sample: LogSample, matches: Mapping[str, Sequence[str]]) -> dict[str, list[str]]:
    """Return the columns of each channel: normally one; several or none if the user must decide.

    If several columns have a fitting name, constant columns are left out.
    """
    result: dict[str, list[str]] = {}
    for channel, names in matches.items():
        moving = [name for name in names if len(values := sample.numbers(name)) and np.ptp(values) > 0.0]
        result[channel] = list(moving if moving and len(names) > 1 else names)
    for channel in ("force_command", "velocity_desired"):
        if all(
            len(values := sample.numbers(name)) and np.ptp(values) == 0.0 for name in result.get(channel, ())
        ):
            result.pop(channel, None)
    for channel in NEEDED_CHANNELS:
        if channel not in result:
            used = {
                name
                for other, names in result.items()
                for name in names
                if len(names) == 1 or other not in POSITIONS
            }
            result[channel] = [
                name for name in sample.values if name not in used and len(sample.numbers(name))
            ]
            if channel == "force_measured" and all(len(result[name]) == 1 for name in POSITIONS):
                del result[channel]  # A log of a free motion needs no force.
    return result


def guess_channels(sample: LogSample, chosen: Mapping[str, Sequence[str]]) -> dict[str, ChannelGuess]:
    """Guess the unit and sign of each channel."""
    columns = {channel: names[0] for channel, names in chosen.items() if len(names) == 1}
    time = guess_time(sample, chosen.get("time", ()), columns.get("position_desired", ""))
    signs = _guess_signs(sample, columns)
    units = _guess_lengths(sample, columns)
    step = None if time is None else find_step(sample, time, columns.get("position_desired"))
    result = {} if time is None else {"time": time}
    for channel, names in chosen.items():
        if channel == "time":
            continue
        if channel not in columns:
            rest = [name for name in names if time is None or name != time.column]
            result[channel] = ChannelGuess(None, candidates=rest)
            continue
        column, why = columns[channel], "by its name"
        stated = sample.units.get(column)
        unit = parse_unit(stated, channel) if stated else None
        if unit is not None:
            why = "by its name and unit"
        elif stated:
            why = f'by its name; unit {stated!r} is not known: specify unit, or scale with unit = "counts"'
        elif channel in units:
            unit, reason = units[channel]
            why += reason
        elif channel == "velocity_desired" and step and "position_desired" in columns:
            unit = _guess_speed_unit(sample, columns, units, step)
        result[channel] = ChannelGuess(column, unit, signs.get(channel, 1), why)
    return result


def _guess_lengths(sample: LogSample, columns: Mapping[str, str]) -> dict[str, tuple[str | None, str]]:
    """Guess the unit of each position whose unit the file does not state; return unit and reason."""
    strokes = {
        name: float(np.ptp(values))
        for name in POSITIONS
        if len(values := sample.numbers(columns.get(name, ""))) and np.ptp(values) > 0.0
    }
    stated = {
        name: unit
        for name in strokes
        if (unit := parse_unit(sample.units.get(columns.get(name, ""), ""), name)) is not None
    }
    result: dict[str, tuple[str | None, str]] = {}
    largest = max(strokes.values(), default=0.0)
    for name, stroke in strokes.items():
        if name in stated:
            continue
        if stated:
            ((other, unit),) = stated.items()
            size = LENGTH_UNITS[unit] * strokes[other]
            reason = f"; in the unit of {other}"
            if not 1 / MAX_EQUAL_UNIT_RATIO < stroke / strokes[other] < MAX_EQUAL_UNIT_RATIO:
                unit = min(LENGTH_UNITS, key=lambda unit: abs(np.log(LENGTH_UNITS[unit] * stroke / size)))
                reason = f"; moves as {other} does"
            result[name] = (None if unit == "m" else unit), reason
            continue
        # Both positions have the same unit, unless one moves so much more that only another unit explains it.
        span = largest if largest < MAX_EQUAL_UNIT_RATIO * stroke else stroke
        if span > TYPICAL_STROKE:
            result[name] = "um" if span > 1000 * TYPICAL_STROKE else "mm", f"; values span {stroke:.3g}"
        else:
            result[name] = None, ""
    return result


def _guess_speed_unit(
    sample: LogSample, columns: Mapping[str, str], units: Mapping[str, tuple[str | None, str]], step: float
) -> str | None:
    """Return the unit in which the desired velocity is nearest to the rate of the desired position."""
    position = columns["position_desired"]
    unit = (
        parse_unit(sample.units.get(position, ""), "position_desired")
        or units.get("position_desired", ("m",))[0]
    )
    x, v = sample.numbers(position), sample.numbers(columns["velocity_desired"])
    rate = LENGTH_UNITS[unit or "m"] * np.median(np.abs(np.diff(x))) / step if len(x) > 1 else 0.0
    speed = float(np.median(np.abs(v))) if len(v) else 0.0
    if not (rate > 0.0 and speed > 0.0):
        return None
    best = min(SPEED_UNITS, key=lambda name: abs(np.log(SPEED_UNITS[name] * speed / rate)))
    return None if best == "m/s" else best


def _guess_signs(sample: LogSample, columns: Mapping[str, str]) -> dict[str, int]:
    """Return the signs for which positions increase towards contact and contact forces are positive."""
    force, command, x, measured = (
        sample.numbers(columns.get(name, "")) for name in ("force_measured", "force_command", *POSITIONS)
    )
    if len(x) < MIN_EVIDENCE_ROWS or len(measured) != len(x):
        return {}  # The reader of the mapping rejects columns of texts.
    signs = {}
    towards = 1
    if len(force) == len(x):
        contact_force = force - estimate_resting_force(force)
        in_contact = np.abs(contact_force) > estimate_contact_threshold(force)
        if np.any(in_contact) and not np.all(in_contact):
            signs["force_measured"] = int(np.sign(np.median(contact_force[in_contact])) or 1)
            towards = int(np.sign(np.mean(x[in_contact]) - np.mean(x[~in_contact])) or 1)
            if len(command) == len(x) and np.any(command[in_contact]):
                signs["force_command"] = int(np.sign(np.median(command[in_contact])) or 1)
    together = int(np.sign(np.dot(x - np.mean(x), measured - np.mean(measured))) or 1)
    return signs | {
        "position_desired": towards,
        "velocity_desired": towards,
        "position_measured": towards * together,
    }
