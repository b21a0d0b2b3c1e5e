"""Estimate of the time that a tuning takes, from the last tuning of the same compensator on this computer.

The time of a tuning is roughly proportional to its simulated ticks. After each tuning, its time per tick is
stored in the cache folder, with the axes and the compensator.
"""

import contextlib
import json
import math
from collections.abc import Sequence
from pathlib import Path

from jaxhil.files import write_atomically
from jaxhil.mechanism.file import AnyMechanism
from jaxhil.mechanism.structs import Mechanism
from jaxhil.simulation.jax_environment import cache_folder
from tuning.terminal import format_duration

RECORD_FILE = "tune-times.json"  # time per simulated tick [s], by axes and compensator
# largest ratio of the time if the starts disagree to the time with a single batch of starts [1]
MAX_BATCH_FACTOR = 4


def describe_expected_duration(mechanisms: Sequence[AnyMechanism], compensator: str, runs: float) -> str:
    """Return a text on the time that a tuning will take, for the estimated number of simulated runs."""
    work = f"about {float(f'{runs:.2g}'):,.0f} simulated runs"
    seconds = _read_times().get(_name(mechanisms[0], compensator), math.nan)
    expected = seconds * runs * _count_ticks(mechanisms)
    if not math.isfinite(expected):
        return (
            f"tuning {compensator}: {work}; the time is unknown, because no tuning of {compensator} was "
            "measured on this computer. The progress shows the time left"
        )
    return (
        f"tuning {compensator}: {work}, about {format_duration(expected)} as measured in the last tuning on "
        f"this computer; up to {MAX_BATCH_FACTOR} times as long if the starts disagree"
    )


def record_duration(
    mechanisms: Sequence[AnyMechanism], compensator: str, runs: float, seconds: float
) -> None:
    """Store how long a tuning with this number of simulated runs took; without a cache, do nothing."""
    folder = cache_folder()
    if folder is None or runs <= 0:
        return
    times = {**_read_times(), _name(mechanisms[0], compensator): seconds / (runs * _count_ticks(mechanisms))}
    with contextlib.suppress(OSError):
        write_atomically(folder / RECORD_FILE, json.dumps(times).encode("ascii"))


def _read_times() -> dict[str, float]:
    """Return the stored times per tick [s]; an empty dictionary if there are none."""
    folder = cache_folder()
    try:
        times = json.loads((Path(folder or ".") / RECORD_FILE).read_bytes())
    except (OSError, ValueError):
        return {}
    if folder is None or not isinstance(times, dict):
        return {}
    return {name: value for name, value in times.items() if isinstance(value, float)}


def _name(mechanism: AnyMechanism, compensator: str) -> str:
    return f"{1 if isinstance(mechanism, Mechanism) else 6} {compensator}"


def _count_ticks(mechanisms: Sequence[AnyMechanism]) -> float:
    """Return the mean number of ticks of a nominal run; for six axes, the number of ticks in one second."""
    from jaxhil.simulation.plausibility import summarise_mechanism

    ticks = [
        (summarise_mechanism(mechanism).duration if isinstance(mechanism, Mechanism) else 1.0)
        / mechanism.rig.control_period
        for mechanism in mechanisms
    ]
    return sum(ticks) / len(ticks)
