"""Small logs of a rig with known true parameters, their mapping, and functions to write them."""

from pathlib import Path
from typing import Any

import numpy as np

from tuning.identification.logs.campaign import read_campaign
from tuning.identification.logs.mapping import LogMapping, parse_mapping
from tuning.identification.records import Campaign

PERIOD, MASS, STIFFNESS, LAG = 1e-3, 350.0, 124e3, 6
CHANNELS = {
    "time": "t",
    "position_desired": "xd",
    "position_measured": "xm",
    "force_measured": "F",
    "velocity_desired": "vd",
    "force_command": "Fc",
}

Columns = dict[str, np.ndarray]


def touches(number: int = 1, speed: float = 5e-3, noise: float = 0.3, seed: int = 0) -> Columns:
    """Return contacts of a spring with commanded return motion; the position reading lags its command."""
    random = np.random.default_rng(seed)
    x, v, rows = -1e-3, speed, []
    for _ in range(number * 600):
        if x < -1e-3:
            # Command a motion back towards the hardware.
            x, v = -1e-3, speed
        depth = max(x, 0.0)
        force = STIFFNESS * depth + noise * random.standard_normal() * (depth > 0)
        rows.append((x, v, force))
        v -= PERIOD * force / MASS
        x += PERIOD * v
    samples = np.array(rows).T
    lagged = np.concatenate([samples[0][0] - speed * PERIOD * np.arange(LAG, 0, -1), samples[0][:-LAG]])
    sensed = samples[2] + noise * random.standard_normal(len(lagged))
    times = PERIOD * np.arange(len(lagged))
    return dict(
        zip(
            CHANNELS.values(),
            (times, samples[0], lagged, sensed, samples[1], sensed * 0 + samples[2]),
            strict=True,
        )
    )


def sway(rows: int = 800, amplitude: float = 1e-3) -> Columns:
    """Return a motion with two frequencies, out of contact."""
    times = PERIOD * np.arange(rows + LAG)
    x = amplitude * (np.sin(2 * np.pi * 1.3 * times) + 0.4 * np.sin(2 * np.pi * 7.1 * times))
    return {"t": times[:rows], "xd": x[LAG:], "xm": x[:-LAG]}


def write_csv(path: Path, columns: Columns, delimiter: str = ",", head: str = "") -> Path:
    """Write the log as most loggers do."""
    names, rows = delimiter.join(columns), zip(*(one.tolist() for one in columns.values()), strict=True)
    path.write_text(head + "\n".join([names, *(delimiter.join(map(repr, row)) for row in rows), ""]))
    return path


def mapping(kind: str = "contact", timing: Any = (), text: Any = None, **channels: Any) -> LogMapping:
    """Return the mapping of these columns with changes; None leaves out a channel."""
    named = {name: one for name, one in (CHANNELS | channels).items() if one is not None}
    raw = {
        "schema": "jaxhil/log/1",
        "channels": named,
        "timing": {"control_period": PERIOD, **dict(timing)},
        "bodies": {"equivalent_mass": MASS},
        "runs": [{"files": "*", "kind": kind}],
        **({} if text is None else {"text": text}),
    }
    return parse_mapping(raw, "map")


def read(path: Path, kind: str = "contact", **changes: Any) -> Campaign:
    """Return the campaign of one file."""
    return read_campaign([path], mapping(kind, **changes))
