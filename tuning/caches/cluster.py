"""Pieces of work handed to the workers of a dask.distributed cluster (`tuning.caches.worker`).

A worker that dies costs the time of the pieces that it had. A piece of which several died, and any piece
while there are no workers, is computed here.
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

from jaxhil.errors import InputError, one_line, shown
from tuning.caches.worker import Setting, run

WAIT = 10  # s for a scheduler to answer
PATIENCE = 20.0  # s without a piece done, after which it is asked whether there are workers
RECOUNT = 2.0  # s, after which it is asked how many there are
EACH = 2  # pieces under way per worker


class Piece(NamedTuple):
    """Something to compute."""

    name: Any  # one of its own
    arguments: tuple[Any, ...]  # of the function


def on_workers(
    address: str, function: Callable[..., Any], pieces: Iterable[Piece], setting: Setting | None, what: str
) -> Generator[tuple[Any, Any], None, None]:
    """`Workers.run` of those of the scheduler at this address."""
    with connected(address) as workers:
        yield from workers.run(function, pieces, setting, what)


@contextmanager
def connected(address: str) -> Iterator["Workers"]:
    """The workers of the scheduler at this address. Raises `InputError`, one line, where there is none."""
    with ExitStack() as stack:
        try:
            import distributed  # pyright: ignore[reportMissingImports]
        except ImportError:
            missing = "nothing installed for it, allowed once `pip install jaxhil[distributed]` was done"
            raise InputError(f"--scheduler: found {missing}") from None
        stack.enter_context(_quiet())
        try:
            with ThreadPoolExecutor(1) as thread:  # the caller's may have a loop of its own
                thread.submit(asyncio.run, _answered(address)).result()
            client = stack.enter_context(distributed.Client(address, timeout=WAIT, set_as_default=False))
        except (OSError, ValueError, TypeError) as error:  # a TimeoutError is an OSError
            reason = one_line(str(error), 100)
            raise InputError(
                f"--scheduler: found {shown(address)}, allowed a scheduler's: {reason}"
            ) from None
        yield Workers(address, client)


async def _answered(address: str) -> None:
    """Something there greets as schedulers do, in time: a client would wait for that without end. Raises
    `OSError` or `ValueError` where it does not."""
    from distributed import Security  # pyright: ignore[reportMissingImports]
    from distributed.comm.core import connect  # pyright: ignore[reportMissingImports]

    try:
        async with asyncio.timeout(WAIT):
            greeted = await connect(address, timeout=WAIT, **Security().get_connection_args("client"))
    except TypeError:
        return  # how to encrypt, a client's configuration may tell
    except TimeoutError:
        raise TimeoutError(f"nothing that answers within {WAIT} s") from None
    except (MemoryError, struct.error):  # the length and the content of a greeting
        raise OSError("something else answers") from None
    await greeted.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """A scheduler that is lost is told in one line: what the package logs of it is not shown."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if "distributed" in name]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class Workers:
    """Those of a scheduler that is connected."""

    def __init__(self, address: str, client: Any):
        self._address, self._client = address, client

    def run(
        self, function: Callable[..., Any], pieces: Iterable[Piece], setting: Setting | None, what: str
    ) -> Generator[tuple[Any, Any], None, None]:
        """(name, result of `function`) of every piece, in the order in which workers finish them; a few are
        under way per worker, of those that join later too.

        `function` is one of a module, and is called on workers that are as `setting` says; with None it has
        to see to that itself. `what` names the work, differently from any other under way.

        Raises `InputError`, one line, where the cluster is lost, and where a worker is not as `setting` says;
        and whatever the function raises.
        """
        with _told_if_lost(self._address):
            from cloudpickle import dumps  # pyright: ignore[reportMissingImports]

            client, waiting, running = self._client, iter(pieces), {}
            ended: SimpleQueue[Any] = SimpleQueue()

            def submit(number: int) -> None:
                for piece in islice(waiting, number):
                    # As bytes: what is in it may import jax, which is to start as a command starts it.
                    asked = dumps((function, piece.arguments))
                    future = client.submit(run, asked, setting, key=f"jaxhil-{what}-{piece.name}", pure=False)
                    running[future] = piece
                    future.add_done_callback(ended.put)

            workers, counted = _workers(client), time.monotonic()
            submit(max(2, EACH * workers))
            while running:
                future, found = _next(ended), None
                if time.monotonic() - counted > RECOUNT or future is None:
                    workers, counted = _workers(client), time.monotonic()
                if future is not None and future in running:
                    found = _found(future)
                elif future is None and not workers:
                    future = next(iter(running))
                    future.cancel()
                else:
                    continue
                piece = running.pop(future)
                submit(max(1, EACH * workers - len(running)))
                yield piece.name, function(*piece.arguments) if found is None else found[0]


def _workers(client: Any) -> int:
    return client.scheduler_info(n_workers=0)["n_workers"]


def _next(ended: "SimpleQueue[Any]") -> Any:
    """One that has ended; None if that takes long."""
    try:
        return ended.get(timeout=PATIENCE)
    except Empty:
        return None


def _found(future: Any) -> tuple[Any] | None:
    """What a worker found of a piece; None if several died of it."""
    from distributed import KilledWorker  # pyright: ignore[reportMissingImports]

    try:
        return (future.result(),)
    except KilledWorker:
        return None
    except ImportError as error:
        reason = one_line(str(error), 100)
        raise InputError(f"--scheduler: a worker: {reason}, allowed workers with jaxhil installed") from None
    finally:
        future.release()


@contextmanager
def _told_if_lost(address: str) -> Iterator[None]:
    """A scheduler that is lost is an `InputError`, one line."""
    from distributed import CancelledError  # pyright: ignore[reportMissingImports]

    try:
        yield
    except (CancelledError, OSError) as error:
        reason = one_line(str(getattr(error, "reason", None) or error) or type(error).__name__, 100)
        kept = "what is finished is kept, --resume goes on"
        raise InputError(f"--scheduler: {one_line(address)}: lost, {reason}; {kept}") from None
