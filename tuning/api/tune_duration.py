"""Estimate of the time that a tuning takes, from the last tuning of the same compensator on this computer.

After each tuning, its time and its simulated ticks are stored in the cache folder, with the axes and the
compensator. The time of a longer tuning is roughly proportional to its ticks. A shorter tuning takes more
time per tick: it compiles the same programs, and its smaller batches use the processor less well.
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

RECORD_FILE = "tune-times.json"  # time [s] and simulated ticks of the last tuning, by axes and compensator
MIN_TICK_SHARE = 0.5  # smallest ratio of the ticks to those of the last tuning for a proportional time [1]
# largest ratio of the time if the starts disagree to the time with a single batch of starts [1]
MAX_BATCH_FACTOR = 4


def describe_expected_duration(mechanisms: Sequence[AnyMechanism], compensator: str, runs: float) -> str:
    """Return a text on the time that a tuning will take, for the estimated number of simulated runs."""
    work = f"about {float(f'{runs:.2g}'):,.0f} simulated runs"
    seconds, ticks = _read_times().get(_name(mechanisms[0], compensator), (math.nan, math.nan))
    share = runs * _count_ticks(mechanisms) / ticks
    if not math.isfinite(seconds * share):
        return (
            f"tuning {compensator}: {work}; the time is unknown, because no tuning of {compensator} was "
            "measured on this computer. The progress shows the time left"
        )
    expected = f"about {format_duration(seconds * share)} as measured in the last tuning"
    if share < MIN_TICK_SHARE:
        expected = (
            f"{format_duration(seconds * share)} to {format_duration(seconds)}, the time of a longer tuning"
        )
    return (
        f"tuning {compensator}: {work}, {expected} on this computer; up to {MAX_BATCH_FACTOR} times as long "
        "if the starts disagree"
    )


def record_duration(
    mechanisms: Sequence[AnyMechanism], compensator: str, runs: float, seconds: float
) -> None:
    """Store how long a tuning with this number of simulated runs took; without a cache, do nothing."""
    folder = cache_folder()
    if folder is None or runs <= 0:
        return
    ticks = runs * _count_ticks(mechanisms)
    times = {**_read_times(), _name(mechanisms[0], compensator): (seconds, ticks)}
    with contextlib.suppress(OSError):
        write_atomically(folder / RECORD_FILE, json.dumps(times).encode("ascii"))


def _read_times() -> dict[str, tuple[float, float]]:
    """Return time [s] and ticks of the last tunings, by axes and compensator; empty if none is stored."""
    folder = cache_folder()
    try:
        times = json.loads((Path(folder or ".") / RECORD_FILE).read_bytes())
    except (OSError, ValueError):
        return {}
    if folder is None or not isinstance(times, dict):
        return {}
    return {
        name: (values[0], values[1])
        for name, values in times.items()
        if isinstance(values, list) and [type(value) for value in values] == [float, float] and values[1] > 0
    }


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
