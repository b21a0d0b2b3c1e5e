"""Running a sweep: the parts that its store lacks, computed here or by a cluster, written here.

What is computed where makes no difference to the rows. Interrupted at any moment, the store keeps the parts
that were written, and running again goes on with those that are missing.

A sweep until its interval is as narrow as wanted looks at its parts in the order of their numbers, whatever
order they come in, and ends at the first after which it is: where, follows from the rows alone, and parts
beyond are removed.
"""

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from tuning.statistics.intervals import enough
from tuning.sweeps.chunks import Rows, Sweep, build_sweep, run_chunk, run_parts
from tuning.sweeps.columns import OUTCOMES, slots
from tuning.sweeps.store import Store, read_part, remove_parts, write_part
from tuning.sweeps.tally import Tally, add_rows, empty_tally

COMPARED = 4096  # scenarios that a float32 sweep runs in float64 too

# Called with the number of rows that are there now and the tally so far: those found, then those computed.
Progress = Callable[[int, Tally], None]
# Runs some parts of a sweep and gives their rows, in any order.
Computer = Callable[[Sweep, Iterable[int]], Generator[tuple[int, Rows], None, None]]


class Precision(NamedTuple):
    """The first scenarios of a sweep in float64 beside float32."""

    scenarios: int  # how many
    largest_difference: float | None  # of a contact's error where both ended; None if none did
    median_difference: float | None  # of the same
    changed_outcomes: int  # scenarios with another outcome
    failed_float32: int
    failed_float64: int


def run_sweep(
    store: Store, found: Progress, computed: Progress, computer: Computer = run_parts
) -> tuple[Sweep, Tally]:
    """Compute and write every part that is missing, as far as it goes: the sweep and its tally.

    Raises `InputError` when a part cannot be written or a cluster cannot be reached.
    """
    manifest = store.manifest
    sweep = build_sweep(manifest)
    if manifest.until_width is not None:
        return sweep, _run_until(store, sweep, found, computed, computer)
    tally, missing = empty_tally(manifest.replicates, manifest.scenarios), []
    for part in range(manifest.parts):
        rows = read_part(store, part)
        if rows is None:
            missing.append(part)
            continue
        tally = add_rows(tally, rows)
        found(len(rows["index"]), tally)
    for part, rows in computer(sweep, missing):
        write_part(store, part, rows)
        tally = add_rows(tally, rows)
        computed(len(rows["index"]), tally)
    return sweep, tally


def compare_precisions(sweep: Sweep, number: int = COMPARED) -> Precision:
    """What float32 changes, on the first `number` scenarios."""
    number = min(number, sweep.manifest.chunk, sweep.manifest.scenarios)
    single, double = (run_chunk(sweep, 0, number, precision) for precision in ("float32", "float64"))
    names = [slot.error for slot in slots(sweep.mechanism)]
    both = np.concatenate([np.abs(single[name].astype(float) - double[name]) for name in names])
    both = both[np.isfinite(both)]
    return Precision(
        number,
        float(np.max(both)) if len(both) else None,
        float(np.median(both)) if len(both) else None,
        int(np.sum(single["outcome"] != double["outcome"])),
        int(np.sum(single["failed"])),
        int(np.sum(double["failed"])),
    )


def describe_outcomes(tally: Tally) -> dict[str, int]:
    """Number of scenarios of each outcome that was met."""
    return {name: count for name, count in zip(OUTCOMES, tally.outcomes, strict=True) if count}


def _run_until(store: Store, sweep: Sweep, found: Progress, computed: Progress, computer: Computer) -> Tally:
    """The tally at the first part after which the interval is narrow enough, or at the last one."""
    manifest = store.manifest
    tally = empty_tally(manifest.replicates, manifest.scenarios, looked_at=True)
    width: Any = manifest.until_width
    following, own = 0, set()

    def look(rows: Rows) -> bool:
        """Take the following part; whether it is the last."""
        nonlocal tally, following
        tally = add_rows(tally, rows)
        tell = computed if following in own else found
        tell(len(rows["index"]), tally)
        following += 1
        assert tally.looks is not None
        return enough(tally.looks, width) or following == manifest.parts

    def look_at_stored() -> bool:
        """Take what is there, up to the first gap."""
        while (rows := read_part(store, following)) is not None:
            if look(rows):
                return True
        return False

    if not look_at_stored():
        missing = (part for part in range(following, manifest.parts) if read_part(store, part) is None)
        with closing(computer(sweep, missing)) as parts:
            for part, rows in parts:
                write_part(store, part, rows)
                own.add(part)
                # A cluster's come in any order: one that comes early waits in the store.
                if part == following and (look(rows) or look_at_stored()):
                    break
    remove_parts(store, following)
    return tally
