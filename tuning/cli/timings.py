"""Time of a command by kind of work: imports, compilation, reading of cached programs, and the rest.

Overlapping times, such as a program traced within another, are counted once.
"""

import builtins
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tuning import terminal

# Kind of work of jax's monitoring events.
EVENT_KINDS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "tracing",
    "/jax/core/compile/backend_compile_duration": "compiling",
    "/jax/compilation_cache/cache_retrieval_time_sec": "reading kept programs",
}
# Kinds by priority: time that counts for one kind does not count for a later one.
WORK_KINDS = ("importing", "reading kept programs", "compiling", "tracing")
TimeInterval = tuple[float, float]


@contextmanager
def report_timings(wanted: bool) -> Iterator[None]:
    """Report on standard error how the time within the context was spent, if wanted."""
    if not wanted:
        yield
        return
    begun, spans = time.monotonic(), {kind: [] for kind in WORK_KINDS}
    try:
        with _record_times(spans):
            yield
    finally:
        terminal.note(f"took: {format_timings(begun, time.monotonic(), spans)}")


def format_timings(begun: float, ended: float, spans: dict[str, list[TimeInterval]]) -> str:
    """Return a text with the time of each kind of work [s], the largest first."""
    shares, counted, before = {}, [], 0.0
    for kind in WORK_KINDS:
        counted += spans[kind]
        together = union_duration(counted)
        shares[kind], before = together - before, together
    shares["all else"] = max(ended - begun - before, 0.0)
    parts = sorted(shares.items(), key=lambda part: -part[1])
    listed = ", ".join(f"{kind} {seconds:.2f} s" for kind, seconds in parts if seconds >= 0.005)
    return f"{ended - begun:.2f} s in all: {listed}"


def union_duration(spans: list[TimeInterval]) -> float:
    """Return the length of the union of time intervals [s]."""
    total, until = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


@contextmanager
def _record_times(spans: dict[str, list[TimeInterval]]) -> Iterator[None]:
    """Record the times of imports and, once jax is imported, of its events in `spans`."""
    plain, listening = builtins.__import__, []

    def listen() -> None:
        if not listening and hasattr(sys.modules.get("jax"), "monitoring"):
            listening.append(True)
            sys.modules["jax"].monitoring.register_event_duration_secs_listener(heard)

    def heard(event: str, seconds: float, **_: object) -> None:
        if event in EVENT_KINDS:
            now = time.monotonic()
            spans[EVENT_KINDS[event]].append((now - seconds, now))

    def timed(name: str, *arguments, **keywords):
        begun = time.monotonic()
        try:
            return plain(name, *arguments, **keywords)
        finally:
            ended = time.monotonic()
            if ended - begun > 1e-4:  # the module was imported for the first time
                spans["importing"].append((begun, ended))
            listen()

    listen()
    builtins.__import__ = timed
    try:
        yield
    finally:
        builtins.__import__ = plain
