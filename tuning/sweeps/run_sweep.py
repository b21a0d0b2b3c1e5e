"""Run of a sweep: computation of all chunks that are missing in its store, in this process or on a cluster.

After an interruption, another run computes only the missing chunks. The rows do not depend on interruptions
or on the computer.

A sweep with `until_width` ends with the first chunk after which the confidence interval is narrow enough. The
chunks are evaluated in the order of their numbers, even if they finish in another order, so that the end
depends on the rows only. Later chunks are removed.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from typing import Any, NamedTuple

import numpy as np

from tuning.statistics.intervals import is_narrow_enough
from tuning.sweeps.chunks import Rows, SweepProgram, build_sweep, run_chunk, run_chunks
from tuning.sweeps.columns import SCENARIO_OUTCOMES, list_contact_columns
from tuning.sweeps.store import SweepStore, read_chunk, read_intact_chunk, remove_chunks, write_chunk
from tuning.sweeps.tally import Tally, add_to_tally, build_empty_tally, estimate_failure_probability

COMPARED_SCENARIOS = 4096  # number of scenarios of a float32 sweep that are also run in float64
MAX_WAITING_CHUNKS = 2  # maximum number of chunks in memory that wait to be written

# Called after each chunk with the chunk's number of rows and the tally of all chunks so far.
ChunkProgress = Callable[[int, Tally], None]
# Function that computes the chunks with given numbers, and yields each number with the rows, in any order.
ChunkComputer = Callable[[SweepProgram, Iterable[int]], Generator[tuple[int, Rows], None, None]]


class PrecisionComparison(NamedTuple):
    """Comparison of float32 with float64 results on the first scenarios of a sweep.

    The differences are magnitudes, from all contacts that ended in both precisions; they are None if there is
    no such contact.
    """

    scenarios: int  # number of compared scenarios
    largest_difference: float | None  # largest difference of a contact's error [1]
    median_difference: float | None  # median difference of a contact's error [1]
    changed_outcomes: int  # number of scenarios whose outcome differs
    failed_float32: int  # number of failed scenarios in float32
    failed_float64: int  # number of failed scenarios in float64


def run_sweep(
    store: SweepStore, found: ChunkProgress, computed: ChunkProgress, computer: ChunkComputer = run_chunks
) -> tuple[SweepProgram, Tally]:
    """Compute and write all missing chunks of a sweep; return its compiled program and counts of outcomes.

    `found` is called for every stored chunk, `computed` for every new chunk. Raise `InputError` if a chunk
    cannot be written or a cluster cannot be reached.
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
    for rows in _write_chunks(store, computer(sweep, missing)):
        tally = add_to_tally(tally, rows)
        computed(len(rows["index"]), tally)
    return sweep, tally


def summarise_failures(store: SweepStore) -> dict[str, Any]:
    """Return a dictionary with failure probability, counts and error limit of a stored sweep.

    Raise `InputError` if a chunk is damaged.
    """
    manifest = store.manifest
    looked_at = manifest.until_width is not None
    tally = build_empty_tally(manifest.replicates, manifest.scenarios, looked_at)
    for part in range(manifest.parts):
        rows = read_intact_chunk(store, part)
        if rows is None:
            break
        tally = add_to_tally(tally, rows)
    return {
        "scenarios": tally.scenarios,
        "failed": tally.failed,
        "limit": manifest.limit,
        "failure_probability": estimate_failure_probability(tally)._asdict(),
        "sweep_sha256": manifest.sha256,
    }


def compare_precisions(sweep: SweepProgram, number: int = COMPARED_SCENARIOS) -> PrecisionComparison:
    """Run the first `number` scenarios of a sweep in float32 and in float64, and compare the results."""
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
    """Return the number of scenarios with each outcome, without the outcomes that did not occur."""
    return {name: count for name, count in zip(SCENARIO_OUTCOMES, tally.outcomes, strict=True) if count}


def _write_chunks(store: SweepStore, chunks: Iterable[tuple[int, Rows]]) -> Iterator[Rows]:
    """Encode and write chunks in a thread, while the next are computed; yield the rows of written chunks."""
    waiting = deque()
    with ThreadPoolExecutor(max_workers=1) as writer:
        for part, rows in chunks:
            waiting.append((writer.submit(write_chunk, store, part, rows), rows))
            if len(waiting) == MAX_WAITING_CHUNKS:
                yield _wait_for_chunk(*waiting.popleft())
        for chunk in waiting:
            yield _wait_for_chunk(*chunk)


def _wait_for_chunk(writing: Future[None], rows: Rows) -> Rows:
    """Return the rows of a chunk when its file is written; raise `InputError` if writing failed."""
    writing.result()
    return rows


def _run_until_narrow(
    store: SweepStore,
    sweep: SweepProgram,
    found: ChunkProgress,
    computed: ChunkProgress,
    computer: ChunkComputer,
) -> Tally:
    """Run a sweep until its confidence interval is at most `until_width` wide; return the final tally."""
    manifest = store.manifest
    tally = build_empty_tally(manifest.replicates, manifest.scenarios, looked_at=True)
    width: Any = manifest.until_width
    following, new = 0, set()

    def look(rows: Rows) -> bool:
        """Add the rows of the next chunk to the tally; return whether the sweep ends with this chunk."""
        nonlocal tally, following
        tally = add_to_tally(tally, rows)
        report = computed if following in new else found
        report(len(rows["index"]), tally)
        following += 1
        assert tally.looks is not None
        return is_narrow_enough(tally.looks, width) or following == manifest.parts

    def look_at_stored() -> bool:
        """Add the stored chunks before the first missing chunk to the tally.

        Return whether the sweep ends with one of these chunks.
        """
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
                # A cluster can finish a later chunk first; that chunk stays in the store until it is next.
                if part == following and (look(rows) or look_at_stored()):
                    break
    remove_chunks(store, following)
    return tally
