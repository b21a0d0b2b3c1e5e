"""Distribution of work units to the workers of a dask.distributed cluster.

If a worker dies, another one computes its units. If several workers have died while they computed the same
unit, or if there is no worker, this process computes the unit. The workers run `tuning.caches.worker`.
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

SCHEDULER_TIMEOUT = 10  # a scheduler must answer within this time [s]
IDLE_TIMEOUT = 20.0  # waiting time for a finished unit, after which the workers are counted again [s]
WORKER_COUNT_INTERVAL = 2.0  # minimum time between two counts of the workers [s]
UNITS_PER_WORKER = 2  # submitted units per worker, so that a worker need not wait for the next unit


class WorkUnit(NamedTuple):
    """One function call for a worker, with a unique name."""

    name: Any  # unique name of the unit
    arguments: tuple[Any, ...]  # arguments of the function


def run_on_workers(
    address: str,
    function: Callable[..., Any],
    pieces: Iterable[WorkUnit],
    setting: ProcessSetting | None,
    label: str,
) -> Generator[tuple[Any, Any], None, None]:
    """Connect to the scheduler at `address`, and yield the results of `ClusterWorkers.run`."""
    with connect_workers(address) as workers:
        yield from workers.run(function, pieces, setting, label)


@contextmanager
def connect_workers(address: str) -> Iterator["ClusterWorkers"]:
    """Connect to the workers of the scheduler at `address`; raise `InputError` if no scheduler answers."""
    with ExitStack() as stack:
        try:
            import distributed  # pyright: ignore[reportMissingImports]
        except ImportError:
            missing = "found no package dask.distributed, expected it: run `pip install jaxhil[distributed]`"
            raise InputError(f"--scheduler: {missing}") from None
        stack.enter_context(_suppress_logs())
        try:
            # a second thread, because this one may already run an event loop
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, _check_answer(address)).result()
            client = stack.enter_context(
                distributed.Client(address, timeout=SCHEDULER_TIMEOUT, set_as_default=False)
            )
        except (OSError, ValueError, TypeError) as error:  # includes TimeoutError, a subclass of OSError
            reason = to_one_line(str(error), 100)
            raise InputError(
                f"--scheduler: found {format_value(address)}, expected the address of a scheduler: {reason}"
            ) from None
        yield ClusterWorkers(address, client)


async def _check_answer(address: str) -> None:
    """Raise OSError or ValueError if no scheduler answers at `address` within `SCHEDULER_TIMEOUT`.

    This check is needed because a client itself would wait forever.
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
        raise TimeoutError(f"nothing answers within {SCHEDULER_TIMEOUT} s") from None
    except (MemoryError, struct.error):  # the answer does not have the format of a scheduler's greeting
        raise OSError("another program answers") from None
    await greeted.close()


@contextmanager
def _suppress_logs() -> Iterator[None]:
    """Context manager: suppress the logs of dask.distributed; its errors are reported separately."""
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
    """Workers of a scheduler to which this process is connected."""

    def __init__(self, address: str, client: Any):
        self._address, self._client = address, client

    def run(
        self,
        function: Callable[..., Any],
        pieces: Iterable[WorkUnit],
        setting: ProcessSetting | None,
        label: str,
    ) -> Generator[tuple[Any, Any], None, None]:
        """Call `function` for every work unit on the workers; yield (name, result) of each finished unit.

        Workers can join later. `function` must be defined at the top level of a module. `label` is a unique
        name of this call. Raise `InputError` if the connection to the scheduler is lost, or if a worker's
        code, package versions or XLA flags differ from `setting`. If `setting` is None, nothing is compared.
        """
        with _raise_if_lost(self._address):
            from cloudpickle import dumps  # pyright: ignore[reportMissingImports]

            client, waiting, running = self._client, iter(pieces), {}
            ended: SimpleQueue[Any] = SimpleQueue()

            def submit(number: int) -> None:
                for unit in islice(waiting, number):
                    # The worker unpickles the content after setting the flags of JAX, because unpickling can
                    # import JAX.
                    content = dumps((function, unit.arguments))
                    key = f"jaxhil-{label}-{unit.name}"
                    future = client.submit(run_pickled_call, content, setting, key=key, pure=False)
                    running[future] = unit
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
                unit = running.pop(future)
                submit(max(1, UNITS_PER_WORKER * workers - len(running)))
                yield unit.name, function(*unit.arguments) if result is None else result[0]


def _count_workers(client: Any) -> int:
    return client.scheduler_info(n_workers=0)["n_workers"]


def _wait_for_next(ended: "SimpleQueue[Any]") -> Any:
    """Return the next future that finishes, or None if none finishes within `IDLE_TIMEOUT`."""
    try:
        return ended.get(timeout=IDLE_TIMEOUT)
    except Empty:
        return None


def _get_result(future: Any) -> tuple[Any] | None:
    """Return a work unit's result as a tuple of length 1, or None if the unit killed several workers."""
    from distributed import KilledWorker  # pyright: ignore[reportMissingImports]

    try:
        return (future.result(),)
    except KilledWorker:
        return None
    except ImportError as error:
        reason = to_one_line(str(error), 100)
        raise InputError(
            f"--scheduler: a worker reports {reason}, expected workers with jaxhil installed"
        ) from None
    finally:
        future.release()


@contextmanager
def _raise_if_lost(address: str) -> Iterator[None]:
    """Context manager: convert errors that mean a lost connection to the scheduler to an `InputError`."""
    from distributed import CancelledError  # pyright: ignore[reportMissingImports]

    try:
        yield
    except (CancelledError, OSError) as error:
        reason = to_one_line(str(getattr(error, "reason", None) or error) or type(error).__name__, 100)
        advice = "finished results are cached; continue with --resume"
        raise InputError(
            f"--scheduler: {to_one_line(address)}: connection lost, {reason}; {advice}"
        ) from None
