"""What commands print: tables and JSON on standard output, progress and notes on standard error."""

import json
import math
import os
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import rich.progress
from rich import box
from rich.console import Console, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

WIDTH = 110  # where there is no terminal to ask
SECONDS_BETWEEN_LINES = 10.0  # where there is no terminal for a bar


def emit(*things: RenderableType, wrap: bool = True) -> None:
    """Print on standard output, long texts on several lines. A reader that has gone away is no error."""
    try:
        console = _console(sys.stdout)
        for thing in things:
            console.print(thing, soft_wrap=not wrap)
        sys.stdout.flush()
    except BrokenPipeError:
        _detach()


def emit_line(text: str) -> None:
    """Print one line on standard output, however long it is."""
    emit(text, wrap=False)


def emit_json(document: Mapping[str, Any]) -> None:
    """Print one JSON document, as `as_json` has it."""
    try:
        print(as_json(document), end="", flush=True)
    except BrokenPipeError:
        _detach()


def as_json(document: Mapping[str, Any]) -> str:
    """A document as lines of JSON, in ASCII; what is not finite as null."""
    return json.dumps(finite(document), indent=2, allow_nan=False) + "\n"


def warn(texts: Iterable[str]) -> None:
    """Say on standard error what may be wrong, a line each."""
    for text in texts:
        note(f"warning: {text}")


def note(text: str) -> None:
    """Say something on standard error."""
    _console(sys.stderr).print(text, soft_wrap=True)


def table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[Any]], texts: Sequence[int] = (0,)
) -> Table:
    """A table; columns whose number is in `texts` hold text, the others numbers."""
    # In one line, also above a narrow table.
    heading = Text(title, style="bold", no_wrap=True, overflow="ignore")
    made = Table(title=heading, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for number, heading in enumerate(headings):
        text = number in texts
        made.add_column(heading, justify="left" if text else "right", overflow="fold", no_wrap=not text)
    for row in rows:
        made.add_row(*(value if isinstance(value, str) else figure(value) for value in row))
    return made


def figure(value: Any, digits: int = 4) -> str:
    """A number in `digits` significant digits; a dash for none."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)


def signed(value: float | None) -> str:
    """A restitution error with its sign; a dash for none."""
    return "-" if value is None or value != value else f"{value:+.4f}"


def finite(value: Any) -> Any:
    """Mappings, lists, named tuples and numbers, with None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return finite(value._asdict())  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


class Stages:
    """Progress through a known number of stages, shown on standard error, unless `quiet`."""

    def __init__(self, total: int, bar: rich.progress.Progress | None, quiet: bool):
        self._bar, self._begun = bar, False
        self._task: Any = None if bar is None else bar.add_task("", total=total)
        self._note = (lambda text: None) if quiet else note

    def begin(self, text: str) -> None:
        """The stage before, if any, is over and `text` begins."""
        if self._bar is None:
            self._note(text)
            return
        self._bar.update(self._task, advance=int(self._begun), description=text)
        self._begun = True

    def say(self, text: str) -> None:
        """What is going on; no stage is over by it."""
        if self._bar is None:
            self._note(text)
        else:
            self._bar.update(self._task, description=text)

    def finish(self) -> None:
        """One stage is over, whatever comes next."""
        if self._bar is not None:
            self._bar.update(self._task, advance=1)


@contextmanager
def stages(total: int, shown: bool = True) -> Iterator[Stages]:
    """A bar on a terminal, a plain line per stage elsewhere; nothing if it is not to be shown."""
    columns = SpinnerColumn(), _text(), BarColumn(bar_width=20), MofNCompleteColumn(), TimeElapsedColumn()
    with _bar(shown, *columns) as bar:
        yield Stages(total, bar, quiet=not shown)


class Progress:
    """Progress through a known number of equal pieces of work, shown on standard error, unless `quiet`."""

    def __init__(self, total: int, unit: str, bar: rich.progress.Progress | None, quiet: bool):
        self._total, self._unit, self._bar = total, unit, bar
        self._note = (lambda text: None) if quiet else note
        self._task: Any = None if bar is None else bar.add_task("", total=total)
        self._done, self._skipped = 0, 0
        self._begun = self._shown = time.monotonic()

    @property
    def rate(self) -> float | None:
        """Pieces per second, of those that were worked on."""
        worked, took = self._done - self._skipped, time.monotonic() - self._begun
        return worked / took if worked > 0 and took > 0 else None

    def skip(self, number: int) -> None:
        """So many pieces were done before."""
        self._done += number
        self._skipped += number
        self._begun = time.monotonic()

    def advance(self, number: int, text: str) -> None:
        """So many pieces more are done; `text` says what is known by now."""
        self._done += number
        rate = self.rate
        left = (self._total - self._done) / rate if rate else None
        pace = f"{figure(rate, 3)} {self._unit}/s, {_span(left)} left"
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, description=f"{pace}, {text}")
        elif time.monotonic() - self._shown >= SECONDS_BETWEEN_LINES and self._done < self._total:
            self._shown = time.monotonic()
            self._note(f"{self._done} of {self._total} {self._unit}, {pace}, {text}")


@contextmanager
def progress(total: int, unit: str, shown: bool = True) -> Iterator[Progress]:
    """A bar on a terminal, a plain line now and then elsewhere; nothing if it is not to be shown."""
    with _bar(shown, BarColumn(bar_width=20), MofNCompleteColumn(), _text()) as bar:
        yield Progress(total, unit, bar, quiet=not shown)


@contextmanager
def _bar(shown: bool, *columns: rich.progress.ProgressColumn) -> Iterator[rich.progress.Progress | None]:
    """A bar if it is to be shown and there is a terminal, else none."""
    console = _console(sys.stderr)
    if not shown or not console.is_terminal:
        yield None
        return
    with rich.progress.Progress(*columns, console=console, transient=True) as bar:
        yield bar


def _text() -> TextColumn:
    return TextColumn("{task.description}", markup=False)


def _span(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


class _Console(Console):
    def on_broken_pipe(self) -> None:
        _detach()


def _console(stream) -> Console:
    # Names come from files: they are text, never markup.
    console = _Console(file=stream, markup=False, emoji=False, highlight=False)
    if not console.is_terminal:
        console.width = WIDTH
    return console


def _detach() -> None:
    """Let what is still printed go nowhere: the exit code remains the verdict."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (OSError, ValueError):
        pass
