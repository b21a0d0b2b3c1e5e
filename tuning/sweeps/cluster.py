"""Parts of a sweep computed by the workers of a cluster (`tuning.caches.cluster`)."""

from collections.abc import Generator, Iterable
from functools import lru_cache

from tuning.caches.cluster import Piece, on_workers
from tuning.caches.worker import differs
from tuning.sweeps.chunks import Rows, Sweep, build_sweep, run_chunk
from tuning.sweeps.manifest import decode, encode, unlike_here
from tuning.sweeps.run import Computer


def on_cluster(address: str) -> Computer:
    """Parts computed by the workers of the scheduler at this address."""
    return lambda sweep, parts: _run(sweep, parts, address)


def run_part(content: bytes, part: int) -> Rows:
    """A part's rows, from the content of a manifest file. Raises `InputError` where they might differ from
    those of the process that asks."""
    sweep = _sweep(content)
    return run_chunk(sweep, *sweep.manifest.part_rows(part))


def _run(sweep: Sweep, parts: Iterable[int], address: str) -> Generator[tuple[int, Rows], None, None]:
    content = encode(sweep.manifest)
    pieces = (Piece(part, (content, part)) for part in parts)
    # The manifest says what a worker has to be like.
    return on_workers(address, run_part, pieces, None, sweep.manifest.sha256[:16])


@lru_cache(maxsize=2)
def _sweep(content: bytes) -> Sweep:
    manifest = decode(content, "sweep")
    for one in unlike_here(manifest):
        raise differs(one, one.startswith("xla_flags"))
    return build_sweep(manifest)
