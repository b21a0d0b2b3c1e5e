"""Computation of the parts that a sweep's store lacks, in this process or by a cluster.

The rows do not depend on where they are computed. After an interruption the store holds the parts that were
written, and another run computes the missing ones.

A sweep with `until_width` evaluates its parts in order of their numbers, whenever they are computed. It ends
with the first part after which the interval is narrow enough, and removes later parts. The end depends on the
rows only.
"""

from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from tuning.statistics.intervals import is_narrow_enough
from tuning.sweeps.chunks import Rows, SweepProgram, build_sweep, run_chunk, run_chunks
from tuning.sweeps.columns import SCENARIO_OUTCOMES, list_contact_columns
from tuning.sweeps.store import SweepStore, read_chunk, remove_chunks, write_chunk
from tuning.sweeps.tally import Tally, add_to_tally, build_empty_tally

COMPARED_SCENARIOS = 4096  # number of scenarios that a float32 sweep also runs in float64

# Called with the number of rows of a part, found or computed, and the tally so far.
ChunkProgress = Callable[[int, Tally], None]
# Computes parts of a sweep and yields their numbers and rows in any order.
ChunkComputer = Callable[[SweepProgram, Iterable[int]], Generator[tuple[int, Rows], None, None]]


class PrecisionComparison(NamedTuple):
    """Comparison of float32 with float64 on the first scenarios of a sweep."""

    scenarios: int  # number of scenarios
    largest_difference: float | None  # of a contact's error [1] if it ended in both; None if none did
    median_difference: float | None  # of the same [1]
    changed_outcomes: int  # number of scenarios with another outcome
    failed_float32: int
    failed_float64: int


def run_sweep(
    store: SweepStore, found: ChunkProgress, computed: ChunkProgress, computer: ChunkComputer = run_chunks
) -> tuple[SweepProgram, Tally]:
    """Compute and write every missing part, up to the end of the sweep; return the sweep and its tally.

    `found` is called for stored parts, `computed` for new ones. Raise `InputError` if a part cannot be
    written or a cluster cannot be reached.
    """
    manifest = store.manifest
    sweep = build_sweep(manifest)
    if manifest.until_width is not None:
        return sweep, _run_until_narrow(store, sweep, found, computed, computer)
    tally, missing = build_empty_tally(manifest.replicates, manifest.scenarios), []
    for part in range(manifest.parts):
        rows = read_chunk(store, part)
        if rows is None:
            missing.append(part)
            continue
        tally = add_to_tally(tally, rows)
        found(len(rows["index"]), tally)
    for part, rows in computer(sweep, missing):
        write_chunk(store, part, rows)
        tally = add_to_tally(tally, rows)
        computed(len(rows["index"]), tally)
    return sweep, tally


def compare_precisions(sweep: SweepProgram, number: int = COMPARED_SCENARIOS) -> PrecisionComparison:
    """Compare float32 with float64 on the first `number` scenarios."""
    number = min(number, sweep.manifest.chunk, sweep.manifest.scenarios)
    single, double = (run_chunk(sweep, 0, number, precision) for precision in ("float32", "float64"))
    names = [slot.error for slot in list_contact_columns(sweep.mechanism)]
    change = np.concatenate([np.abs(single[name].astype(float) - double[name]) for name in names])
    change = change[np.isfinite(change)]
    return PrecisionComparison(
        number,
        float(np.max(change)) if len(change) else None,
        float(np.median(change)) if len(change) else None,
        int(np.sum(single["outcome"] != double["outcome"])),
        int(np.sum(single["failed"])),
        int(np.sum(double["failed"])),
    )


def count_outcomes(tally: Tally) -> dict[str, int]:
    """Return the number of scenarios of each outcome that occurred."""
    return {name: count for name, count in zip(SCENARIO_OUTCOMES, tally.outcomes, strict=True) if count}


def _run_until_narrow(
    store: SweepStore,
    sweep: SweepProgram,
    found: ChunkProgress,
    computed: ChunkProgress,
    computer: ChunkComputer,
) -> Tally:
    """Run a sweep with `until_width`; return the tally of the parts up to its end."""
    manifest = store.manifest
    tally = build_empty_tally(manifest.replicates, manifest.scenarios, looked_at=True)
    width: Any = manifest.until_width
    following, new = 0, set()

    def look(rows: Rows) -> bool:
        """Add the following part; return whether it is the last."""
        nonlocal tally, following
        tally = add_to_tally(tally, rows)
        report = computed if following in new else found
        report(len(rows["index"]), tally)
        following += 1
        assert tally.looks is not None
        return is_narrow_enough(tally.looks, width) or following == manifest.parts

    def look_at_stored() -> bool:
        """Add the stored parts up to the first missing one; return whether the last part was among them."""
        while (rows := read_chunk(store, following)) is not None:
            if look(rows):
                return True
        return False

    if not look_at_stored():
        missing = (part for part in range(following, manifest.parts) if read_chunk(store, part) is None)
        with closing(computer(sweep, missing)) as parts:
            for part, rows in parts:
                write_chunk(store, part, rows)
                new.add(part)
                # A cluster computes parts in any order; an early one waits in the store.
                if part == following and (look(rows) or look_at_stored()):
                    break
    remove_chunks(store, following)
    return tally
