"""Where the time of a command went: importing, making programs, reading kept ones, and all the rest.

Of what overlaps, as a program that is traced within another, the time counts once.
"""

import builtins
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from tuning import terminal

# What jax tells of its programs, by the names of its events.
EVENTS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "tracing",
    "/jax/core/compile/backend_compile_duration": "compiling",
    "/jax/compilation_cache/cache_retrieval_time_sec": "reading kept programs",
}
# In this order: what lies within one before is not of one after.
KINDS = ("importing", "reading kept programs", "compiling", "tracing")
Span = tuple[float, float]


@contextmanager
def measured(wanted: bool) -> Iterator[None]:
    """Say on standard error where the time within went, if that is wanted."""
    if not wanted:
        yield
        return
    begun, spans = time.monotonic(), {kind: [] for kind in KINDS}
    try:
        with _imports(spans):
            yield
    finally:
        terminal.note(f"took: {said(begun, time.monotonic(), spans)}")


def said(begun: float, ended: float, spans: dict[str, list[Span]]) -> str:
    """The shares in words, the largest first [s]."""
    shares, counted, before = {}, [], 0.0
    for kind in KINDS:
        counted += spans[kind]
        together = covered(counted)
        shares[kind], before = together - before, together
    shares["all else"] = max(ended - begun - before, 0.0)
    parts = sorted(shares.items(), key=lambda one: -one[1])
    listed = ", ".join(f"{kind} {seconds:.2f} s" for kind, seconds in parts if seconds >= 0.005)
    return f"{ended - begun:.2f} s in all: {listed}"


def covered(spans: list[Span]) -> float:
    """How much time intervals cover together [s]."""
    total, until = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, until))
        until = max(until, end)
    return total


@contextmanager
def _imports(spans: dict[str, list[Span]]) -> Iterator[None]:
    """Note the times of imports and, from when jax is there, of what it tells."""
    plain, listening = builtins.__import__, []

    def listen() -> None:
        if not listening and hasattr(sys.modules.get("jax"), "monitoring"):
            listening.append(True)
            sys.modules["jax"].monitoring.register_event_duration_secs_listener(heard)

    def heard(event: str, seconds: float, **_: object) -> None:
        if event in EVENTS:
            now = time.monotonic()
            spans[EVENTS[event]].append((now - seconds, now))

    def timed(name: str, *others, **more):
        begun = time.monotonic()
        try:
            return plain(name, *others, **more)
        finally:
            ended = time.monotonic()
            if ended - begun > 1e-4:  # the module was not there yet
                spans["importing"].append((begun, ended))
            listen()

    listen()
    builtins.__import__ = timed
    try:
        yield
    finally:
        builtins.__import__ = plain
