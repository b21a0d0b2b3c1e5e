"""Distribution of work units ("pieces") to the workers of a dask.distributed cluster.

If a worker dies, its pieces are computed again. A piece that several workers died of, and any piece while
there are no workers, is computed in this process. `tuning.caches.worker` is the workers' side.
"""

import asyncio
import logging
import struct
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

from jaxhil.errors import InputError, format_value, to_one_line
from tuning.caches.worker import ProcessSetting, run_pickled_call

SCHEDULER_TIMEOUT = 10  # s; limit on the time in which a scheduler must answer
IDLE_TIMEOUT = 20.0  # s without a finished piece, after which the workers are counted again
WORKER_COUNT_INTERVAL = 2.0  # s; time between counts of the workers
UNITS_PER_WORKER = 2  # number of submitted pieces per worker


class WorkUnit(NamedTuple):
    """Work unit."""

    name: Any  # unique name
    arguments: tuple[Any, ...]  # arguments of the function


def run_on_workers(
    address: str,
    function: Callable[..., Any],
    pieces: Iterable[WorkUnit],
    setting: ProcessSetting | None,
    what: str,
) -> Generator[tuple[Any, Any], None, None]:
    """Call `Workers.run` with the workers of the scheduler at this address."""
    with connect_workers(address) as workers:
        yield from workers.run(function, pieces, setting, what)


@contextmanager
def connect_workers(address: str) -> Iterator["ClusterWorkers"]:
    """Connect to the workers of the scheduler at this address. Raise `InputError` if there is none."""
    with ExitStack() as stack:
        try:
            import distributed  # pyright: ignore[reportMissingImports]
        except ImportError:
            missing = "nothing installed for it, expected once `pip install jaxhil[distributed]` was done"
            raise InputError(f"--scheduler: found {missing}") from None
        stack.enter_context(_suppress_logs())
        try:
            with ThreadPoolExecutor(1) as thread:  # the caller's thread may already run an event loop
                thread.submit(asyncio.run, _check_answer(address)).result()
            client = stack.enter_context(
                distributed.Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
            )
        except (OSError, ValueError, TypeError) as error:  # a TimeoutError is an OSError
            reason = to_one_line(str(error), 100)
            raise InputError(
                f"--scheduler: found {format_value(address)}, expected a scheduler's: {reason}"
            ) from None
        yield ClusterWorkers(address, client)


async def _check_answer(address: str) -> None:
    """Check that a scheduler answers in time, for which a client would wait without limit.

    Raise OSError or ValueError if it does not.
    """
    from distributed import Security  # pyright: ignore[reportMissingImports]
    from distributed.comm.core import connect  # pyright: ignore[reportMissingImports]

    try:
        async with asyncio.timeout(SCHEDULER_TIMEOUT):
            greeted = await connect(
                address, timeout=SCHEDULER_TIMEOUT, **Security().get_connection_args("client")
            )
    except TypeError:
        return  # The client's configuration may contain the missing encryption settings.
    except TimeoutError:
        raise TimeoutError(f"nothing that answers within {SCHEDULER_TIMEOUT} s") from None
    except (MemoryError, struct.error):  # the length and the content of a greeting
        raise OSError("something else answers") from None
    await greeted.close()


@contextmanager
def _suppress_logs() -> Iterator[None]:
    """Suppress the logs of dask.distributed, since a lost scheduler is reported in one line."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if "distributed" in name]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class ClusterWorkers:
    """Workers of a connected scheduler."""

    def __init__(self, address: str, client: Any):
        self._address, self._client = address, client

    def run(
        self,
        function: Callable[..., Any],
        pieces: Iterable[WorkUnit],
        setting: ProcessSetting | None,
        what: str,
    ) -> Generator[tuple[Any, Any], None, None]:
        """Yield (name, result of `function`) of every piece, in the order in which workers finish them.

        Workers may join later. `function` is defined at the top of a module. Workers must have the `setting`;
        with None the function has to check it. `what` is a unique name of the work. Raise `InputError` if the
        cluster is lost or a worker has another setting, and any exception that the function raises.
        """
        with _raise_if_lost(self._address):
            from cloudpickle import dumps  # pyright: ignore[reportMissingImports]

            client, waiting, running = self._client, iter(pieces), {}
            ended: SimpleQueue[Any] = SimpleQueue()

            def submit(number: int) -> None:
                for piece in islice(waiting, number):
                    # Unpickling may import JAX; the worker does it after setting the flags of JAX.
                    content = dumps((function, piece.arguments))
                    key = f"jaxhil-{what}-{piece.name}"
                    future = client.submit(run_pickled_call, content, setting, key=key, pure=False)
                    running[future] = piece
                    future.add_done_callback(ended.put)

            workers, counted = _count_workers(client), time.monotonic()
            submit(max(2, UNITS_PER_WORKER * workers))
            while running:
                future, result = _wait_for_next(ended), None
                if time.monotonic() - counted > WORKER_COUNT_INTERVAL or future is None:
                    workers, counted = _count_workers(client), time.monotonic()
                if future is not None and future in running:
                    result = _get_result(future)
                elif future is None and not workers:
                    future = next(iter(running))
                    future.cancel()
                else:
                    continue
                piece = running.pop(future)
                submit(max(1, UNITS_PER_WORKER * workers - len(running)))
                yield piece.name, function(*piece.arguments) if result is None else result[0]


def _count_workers(client: Any) -> int:
    """Return the number of workers."""
    return client.scheduler_info(n_workers=0)["n_workers"]


def _wait_for_next(ended: "SimpleQueue[Any]") -> Any:
    """Return the next future that ends, or None if this takes longer than `IDLE_TIMEOUT`."""
    try:
        return ended.get(timeout=IDLE_TIMEOUT)
    except Empty:
        return None


def _get_result(future: Any) -> tuple[Any] | None:
    """Return a worker's result as a tuple of length 1, or None if several workers died of the piece."""
    from distributed import KilledWorker  # pyright: ignore[reportMissingImports]

    try:
        return (future.result(),)
    except KilledWorker:
        return None
    except ImportError as error:
        reason = to_one_line(str(error), 100)
        raise InputError(f"--scheduler: a worker: {reason}, expected workers with jaxhil installed") from None
    finally:
        future.release()


@contextmanager
def _raise_if_lost(address: str) -> Iterator[None]:
    """Raise `InputError` if the scheduler is lost."""
    from distributed import CancelledError  # pyright: ignore[reportMissingImports]

    try:
        yield
    except (CancelledError, OSError) as error:
        reason = to_one_line(str(getattr(error, "reason", None) or error) or type(error).__name__, 100)
        advice = "what is finished is kept, --resume goes on"
        raise InputError(f"--scheduler: {to_one_line(address)}: lost, {reason}; {advice}") from None
