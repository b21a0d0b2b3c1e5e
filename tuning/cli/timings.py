"""Measurement of a command's time by kind of work: import, tracing, compilation, reading cached programs.

Overlapping time intervals count once, for example if a program is traced within another one.
"""

import builtins
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tuning import terminal

# Kind of work for each monitoring event of jax.
EVENT_KINDS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "tracing",
    "/jax/core/compile/backend_compile_duration": "compiling",
    "/jax/compilation_cache/cache_retrieval_time_sec": "reading cached programs",
}
# In order of priority: time that belongs to several kinds counts only for the first of them.
WORK_KINDS = ("importing", "reading cached programs", "compiling", "tracing")
TimeInterval = tuple[float, float]


@contextmanager
def report_timings(wanted: bool) -> Iterator[None]:
    """Context manager: measure the time of the `with` block; if `wanted`, report it on standard error."""
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
    """Return a text with the total time and the time of each kind of work [s], the longest time first."""
    times, counted, previous = {}, [], 0.0
    for kind in WORK_KINDS:
        counted += spans[kind]
        total = union_duration(counted)
        times[kind], previous = total - previous, total
    times["all else"] = max(ended - begun - previous, 0.0)
    longest_first = sorted(times.items(), key=lambda item: -item[1])
    listed = ", ".join(f"{kind} {seconds:.2f} s" for kind, seconds in longest_first if seconds >= 0.005)
    return f"{ended - begun:.2f} s in all: {listed}"


def union_duration(spans: list[TimeInterval]) -> float:
    """Return the total length [s] of the union of time intervals."""
    total, until = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


@contextmanager
def _record_times(spans: dict[str, list[TimeInterval]]) -> Iterator[None]:
    """Add the time intervals of imports to `spans` and, once jax is imported, those of jax's events."""
    original_import, listening = builtins.__import__, []

    def listen() -> None:
        if not listening and hasattr(sys.modules.get("jax"), "monitoring"):
            listening.append(True)
            sys.modules["jax"].monitoring.register_event_duration_secs_listener(record_event)

    def record_event(event: str, seconds: float, **_: object) -> None:
        if event in EVENT_KINDS:
            now = time.monotonic()
            spans[EVENT_KINDS[event]].append((now - seconds, now))

    def timed_import(name: str, *arguments, **keywords):
        begun = time.monotonic()
        try:
            return original_import(name, *arguments, **keywords)
        finally:
            ended = time.monotonic()
            if ended - begun > 1e-4:  # time of an import [s]; below it, the module was already imported
                spans["importing"].append((begun, ended))
            listen()

    listen()
    builtins.__import__ = timed_import
    try:
        yield
    finally:
        builtins.__import__ = original_import
