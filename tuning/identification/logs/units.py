"""Units of logged values, and their factors to SI units."""

from __future__ import annotations

import re

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
SPEED_UNITS = {"m/s": 1.0, "mm/s": 1e-3, "um/s": 1e-6, "in/s": 0.0254}
FORCE_UNITS = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "lbf": 4.4482216152605}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
COUNTS_UNIT = "counts"  # unit of raw sensor counts; the channel's `scale` converts one count to SI units

# Allowed units of each numeric channel, with the SI unit first.
UNITS_OF_CHANNEL = {
    "time": TIME_UNITS,
    "position_desired": LENGTH_UNITS,
    "position_measured": LENGTH_UNITS,
    "force_measured": FORCE_UNITS,
    "velocity_desired": SPEED_UNITS,
    "force_command": FORCE_UNITS,
}

# Other spellings of the units, in lower case.
_SYNONYMS = {
    "sec": "s", "second": "s", "seconds": "s", "msec": "ms", "usec": "us", "nsec": "ns", "newton": "N",
    "newtons": "N", "meter": "m", "meters": "m", "metre": "m", "metres": "m", "micron": "um", "microns": "um",
    "inch": "in", "inches": "in",
}  # fmt: skip
_NO_UNITS = ("MN", "Mm")  # meganewton and megametre; must not be read as mN or mm


def parse_unit(text: str, channel: str | None = None) -> str | None:
    """Return the unit that a log states, in the spelling of `UNITS_OF_CHANNEL`; None if it is unknown.

    Args:
        text: Unit, possibly in brackets.
        channel: Channel that must have this unit; None for any channel.
    """
    word = re.sub(r"^[\[(<]\s*|\s*[\])>]$", "", text.strip()).replace("\u00b5", "u").replace("\u03bc", "u")
    tables = UNITS_OF_CHANNEL.values() if channel is None else [UNITS_OF_CHANNEL.get(channel, {})]
    units = [unit for table in tables for unit in table]
    if word in units or word in _NO_UNITS:
        return word if word in units else None
    words = [_SYNONYMS.get(part, part) for part in word.lower().split("/")]
    return next((unit for unit in units if unit.lower() == "/".join(words).lower()), None)
