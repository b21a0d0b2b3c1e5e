"""Parts of a sweep computed by the workers of a dask.distributed cluster (`tuning.sweeps.worker`).

A worker that dies costs the time of the parts that it had. A part of which several died, and any part while
there are no workers, is computed here.
"""

from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any

from jaxhil.errors import InputError, one_line, shown
from tuning.sweeps.chunks import Rows, Sweep, run_chunk
from tuning.sweeps.manifest import encode
from tuning.sweeps.run import Computer
from tuning.sweeps.worker import run_part

PATIENCE = 20.0  # s without a part done, after which it is asked whether there are workers


def on_cluster(address: str) -> Computer:
    """Parts computed by the workers of the scheduler at this address."""
    return lambda sweep, parts: _run(sweep, parts, address)


def _run(sweep: Sweep, parts: Iterable[int], address: str) -> Generator[tuple[int, Rows], None, None]:
    """The parts in the order in which workers finish them; a few are under way per worker."""
    with _client(address) as client, _connected(address):
        content, waiting, running = encode(sweep.manifest), iter(parts), {}

        def submit(number: int) -> None:
            for part in islice(waiting, number):
                key = f"jaxhil-{sweep.manifest.sha256[:16]}-{part}"
                running[client.submit(run_part, content, part, key=key, pure=False)] = part

        submit(max(2, 2 * _workers(client)))
        while running:
            ended = _ended(client, list(running))
            if not ended and not _workers(client):
                ended = [next(iter(running))]
                ended[0].cancel()
            for future in ended:
                part = running.pop(future)
                submit(1)
                rows = _rows(future)
                yield part, run_chunk(sweep, *sweep.manifest.part_rows(part)) if rows is None else rows


def _workers(client: Any) -> int:
    return len(client.scheduler_info(n_workers=-1)["workers"])


def _ended(client: Any, futures: list[Any]) -> list[Any]:
    """Those that have ended; none if that takes long."""
    from distributed import wait  # pyright: ignore[reportMissingImports]

    try:
        with client.as_current():
            ended: Any = wait(futures, timeout=PATIENCE, return_when="FIRST_COMPLETED")
        return list(ended.done)
    except TimeoutError:
        return []


def _client(address: str) -> Any:
    try:
        from distributed import Client  # pyright: ignore[reportMissingImports]
    except ImportError:
        missing = "nothing installed for it, allowed once `pip install jaxhil[distributed]` was done"
        raise InputError(f"--scheduler: found {missing}") from None
    try:
        return Client(address, timeout=10, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = one_line(str(error), 100)
        raise InputError(f"--scheduler: found {shown(address)}, allowed a scheduler's: {reason}") from None


def _rows(future: Any) -> Rows | None:
    """What a worker found of a part; None if several died of it, or there are none."""
    from distributed import KilledWorker  # pyright: ignore[reportMissingImports]

    if future.cancelled():
        return None
    try:
        return future.result()
    except KilledWorker:
        return None
    except ImportError as error:
        reason = one_line(str(error), 100)
        raise InputError(f"--scheduler: a worker: {reason}, allowed workers with jaxhil installed") from None
    finally:
        future.release()


@contextmanager
def _connected(address: str) -> Iterator[None]:
    """A scheduler that is lost is an `InputError`, one line."""
    from distributed import CancelledError  # pyright: ignore[reportMissingImports]

    try:
        yield
    except (CancelledError, OSError) as error:
        reason = one_line(f"{type(error).__name__}: {error}", 100)
        kept = "what is there is kept, --resume goes on"
        raise InputError(f"--scheduler: {one_line(address)}: lost, {reason}; {kept}") from None
