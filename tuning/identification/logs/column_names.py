"""Channel and unit that the name of a log's column indicates.

A name consists of words: `SetPos`, `x_cmd`, `Position command [mm]`, `/drive/position/act`. One word states
the quantity, another one the role (desired or measured). A name that states no quantity has the quantity of
its unit.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

from tuning.identification.logs.units import FORCE_UNITS, LENGTH_UNITS, SPEED_UNITS, TIME_UNITS, parse_unit

QUANTITIES = {
    "time": "time timestamp stamp clock zeit t tout",
    "velocity": "velocity vel speed v xdot geschwindigkeit",
    "force": "force load loadcell cell newton f fx fy fz kraft effort",
    "position": "position pos x y z displacement disp stroke travel depth lvdt encoder weg lage",
}
ROLES = {
    "desired": "command commanded cmd com desired des demand demanded setpoint set soll target reference ref "
    "goal d c",
    "measured": "measured meas actual act feedback fb current cur ist m a",
}  # fmt: skip
OTHER_QUANTITIES = set(
    "temperature temp torque moment error err acceleration accel acc status enable voltage counter count "
    "mode state phase".split()
)
OTHER_UNITS = set("A mA Nm N*m deg rad rad/s °C C K % bar Hz m/s2 m/s^2".split())
FILLERS = {"data", "value", "values", "out", "signal", "signals"}  # words without quantity or role
QUANTITY_UNITS = {
    "time": TIME_UNITS, "velocity": SPEED_UNITS, "force": FORCE_UNITS, "position": LENGTH_UNITS
}  # fmt: skip
SPECIAL_NAMES = {
    "contact_index": r"contact(_?(index|number|no))?|touch_?(index|number|no)",
    "mode": r"mode|state|phase",
}
CHANNELS = {
    "time": {None: "time", "desired": "time", "measured": "time"},
    "velocity": {"desired": "velocity_desired"},
    "force": {None: "force_measured", "desired": "force_command", "measured": "force_measured"},
    "position": {None: "position_measured", "desired": "position_desired", "measured": "position_measured"},
    None: {"desired": "position_desired", "measured": "position_measured"},
}

_QUANTITY_OF = {word: quantity for quantity, words in QUANTITIES.items() for word in words.split()}
_ROLE_OF = {word: role for role, words in ROLES.items() for word in words.split()}
_WORDS = sorted((word for word in {*_QUANTITY_OF, *_ROLE_OF} if word not in "tmacd"), key=len, reverse=True)
_UNIT_SUFFIXES = {unit.lower() for units in QUANTITY_UNITS.values() for unit in units} - {"m"}
_UNIT_PATTERN = re.compile(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$|\s/\s*(\S+)\s*$|,\s+(\S+)\s*$|_([A-Za-z]+)$")


class NameMatch(NamedTuple):
    """Channel that the name of a column indicates, and the certainty of this match."""

    channel: str
    certainty: int  # 3: the channel's own name; 2: the name states quantity and role; 1: only one of them


def find_unit(name: str) -> str | None:
    """Return the unit at the end of a column name, as it is spelled there, or None.

    The unit is in brackets, or after a slash, comma or underscore. The ending `_m` is not a unit, because it
    often means "measured".
    """
    match = _UNIT_PATTERN.search(name)
    if match is None:
        return None
    suffix = match.group(4)
    if suffix is not None:
        return suffix if suffix.lower() in _UNIT_SUFFIXES else None
    return match.group(1) or match.group(2) or match.group(3)


def match_channel(name: str, unit: str | None) -> NameMatch | None:
    """Return the channel that a column's name and unit indicate, or None.

    Args:
        name: Name of the column.
        unit: Unit that the log states, as it is spelled there.
    """
    bare = _UNIT_PATTERN.sub("", name) if find_unit(name) else name
    for channel, pattern in SPECIAL_NAMES.items():
        if re.fullmatch(pattern, bare.strip().lower().replace(" ", "_")):
            return NameMatch(channel, 3)
    parts = [list(_split_words(part)) for part in re.split(r"[/.]", bare)]
    parts = [[word for word in part if word not in FILLERS] for part in parts]
    while len(parts) > 1 and not parts[-1]:
        parts.pop()
    words = [word for part in parts for word in part]
    if OTHER_QUANTITIES.intersection(words) or (unit is not None and unit.strip("[]() ") in OTHER_UNITS):
        return None
    # Single letters count only at the end of a path; the last word of a path counts most.
    above = [word for part in parts[:-1] for word in part if len(word) > 1]
    quantity = _find_last(_QUANTITY_OF, above, parts[-1])
    role = _find_last(_ROLE_OF, above, parts[-1])
    known_unit = parse_unit(unit) if unit else None
    if known_unit is not None and (quantity is None or known_unit not in QUANTITY_UNITS[quantity]):
        quantity = next(key for key, units in QUANTITY_UNITS.items() if known_unit in units)
    channel = CHANNELS[quantity].get(role)
    if channel is None:
        return None
    if "_".join(parts[-1]) == channel or channel == bare:
        return NameMatch(channel, 3)
    return NameMatch(channel, 1 + (quantity is not None and role is not None))


def _find_last(meanings: dict[str, str], above: list[str], last: list[str]) -> str | None:
    """Return the meaning of the last word that has one; d, c, m, a count only beside one letter (`x_d`)."""
    letters = [word for word in last if len(word) == 1]
    for word in reversed([*above, *last]):
        if word in "dcma" and not (len(letters) >= 2 and len(last) == 2):
            continue
        if word in meanings:
            return meanings[word]
    return None


def _split_words(part: str) -> Iterator[str]:
    """Yield the words in a part of a name, in lower case and without digits: `setpos2` gives `set`, `pos`."""
    for token in re.findall(r"[^\W\d_]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", part)):
        word = token.lower()
        if (match := re.fullmatch(r"([xyzvf])([dcma])", word)) is not None:
            yield from match.groups()
        else:
            yield from _split_at_words(word) or [word]


def _split_at_words(word: str) -> list[str] | None:
    """Split a word into known words; return None if this is not possible."""
    if not word or word in _QUANTITY_OF or word in _ROLE_OF or word in OTHER_QUANTITIES:
        return [word] if word else []
    for begin in _WORDS:
        if word.startswith(begin) and (rest := _split_at_words(word[len(begin) :])) is not None:
            return [begin, *rest]
    return None
