"""What commands print: tables and JSON on standard output, progress and notes on standard error."""

import json
import math
import os
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import rich.progress
from rich import box
from rich.console import Console, RenderableType
from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn
from rich.table import Column, Table
from rich.text import Text

from jaxhil.errors import InputError, one_line

WIDTH = 110  # where there is no terminal to ask
SECONDS_BETWEEN_LINES = 10.0  # where there is no terminal for a bar
SECONDS_OF_SILENCE = 20.0  # after which the last line is said again, with the time left by then
KNOWN_FROM = 0.05  # share of the work that has to be done before a rate is known


def emit(*things: RenderableType, wrap: bool = True) -> None:
    """Print on standard output, long texts on several lines. A reader that has gone away is no error."""
    with _writing_output():
        for thing in things:
            console = _console(sys.stdout)
            if isinstance(thing, Table):
                console.width = _fitted(thing, console)
            console.print(thing, soft_wrap=not wrap)
        sys.stdout.flush()


def emit_line(text: str) -> None:
    """Print one line on standard output, however long it is."""
    emit(text, wrap=False)


def emit_json(document: Mapping[str, Any]) -> None:
    """Print one JSON document, as `as_json` has it."""
    with _writing_output():
        print(as_json(document), end="", flush=True)


def as_json(document: Mapping[str, Any]) -> str:
    """A document as lines of JSON, in ASCII; what is not finite as null."""
    return json.dumps(finite(document), indent=2, allow_nan=False) + "\n"


def warn(texts: Iterable[str]) -> None:
    """Say on standard error what may be wrong, a line each."""
    for text in texts:
        note(f"warning: {text}")


def note(text: str) -> None:
    """Say something on standard error; the work goes on where that cannot be written."""
    try:
        _console(sys.stderr).print(text, soft_wrap=True)
    except OSError:
        _detach(sys.stderr)


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


def ratio(value: float, ideal: float) -> str:
    """Return a number over that of the ideal contact, in three decimals; a dash where there is none."""
    found = value / ideal if ideal else math.nan
    return f"{found:.3f}" if math.isfinite(found) and math.isfinite(ideal) else "-"


def finite(value: Any) -> Any:
    """Mappings, lists, named tuples and numbers, NumPy's as Python's, with None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(key): finite(entry) for key, entry in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return finite(value._asdict())  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, (list, tuple)):
        return [finite(entry) for entry in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return finite(value.tolist()) if hasattr(value, "tolist") else value


class Progress:
    """How far a known amount of work is, shown on standard error, unless `quiet`: what is done, the rate, the
    time left, what is going on. A bar on a terminal; elsewhere a line when something else begins, and now and
    then."""

    def __init__(self, total: float, unit: str, bar: rich.progress.Progress | None, quiet: bool):
        self._total, self._unit, self._bar = total, unit, bar
        self._note = (lambda text: None) if quiet else note
        self._task: Any = None if bar is None else bar.add_task("", total=total, pace="")
        self._done, self._skipped, self._begun_stage, self._text = 0.0, 0.0, False, ""
        self._begun = self._shown = time.monotonic()
        self._lock = threading.RLock()

    @property
    def rate(self) -> float | None:
        """Units per second, of those that were worked on."""
        worked, took = self._done - self._skipped, time.monotonic() - self._begun
        return worked / took if worked > 0 and took > 0 else None

    def skip(self, number: float) -> None:
        """So many units were done before."""
        self._done += number
        self._skipped += number
        self._begun = time.monotonic()

    def advance(self, number: float, text: str | None = None) -> None:
        """So many units more are done; `text` says what is known by now."""
        self.reach(self._done + number, text)

    def reach(self, done: float, text: str | None = None) -> None:
        """So many units are done in all."""
        with self._lock:
            self._done = max(self._done, done)
            self._text = self._text if text is None else text
            self._show(due=SECONDS_BETWEEN_LINES)

    def say(self, text: str) -> None:
        """What is going on."""
        with self._lock:
            new, self._text = text != self._text, text
            self._show(due=0.0 if new else SECONDS_BETWEEN_LINES)

    def tell(self, text: str, done: float, skipped: float = 0.0) -> None:
        """What is going on, how many units are done in all, and how many of those were done before."""
        with self._lock:
            self._done, self._skipped = max(self._done, done), skipped
            self.say(text)

    def begin(self, text: str) -> None:
        """The unit before, if any, is done and `text` begins."""
        with self._lock:
            self._end_unit()
            self.say(text)

    def turn_to(self, text: str) -> None:
        """Like `begin`, for what may be over at once: without a bar it is said only if it takes long."""
        with self._lock:
            self._end_unit()
            self.reach(self._done, text)

    def remind(self) -> None:
        """Say again how far it is, if nothing was said for long."""
        with self._lock:
            self._show(due=SECONDS_OF_SILENCE)

    def _end_unit(self) -> None:
        self._done += self._begun_stage
        self._begun_stage = True

    def _show(self, due: float) -> None:
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, description=self._text, pace=self._pace())
        elif time.monotonic() - self._shown >= due and (self._done < self._total or due == 0.0):
            self._shown = time.monotonic()
            self._note(", ".join(filter(None, [self._how_far(), self._pace(), self._text])))

    def _how_far(self) -> str:
        if self._done <= 0:
            return ""
        if self._total == 1:
            return f"{100 * self._done:.0f} %"
        return f"{math.floor(self._done)} of {self._total} {self._unit}"

    def _pace(self) -> str:
        if (rate := self.rate) is None or self._done < KNOWN_FROM * self._total:
            return f"{_span(time.monotonic() - self._begun)} so far"
        left = max(self._total - self._done, 0.0) / rate
        # Of a single thing it is the share whose rate says something.
        scale, unit = (100.0, " %") if self._total == 1 else (1.0, f" {self._unit}")
        hourly = 3600 * scale * rate
        over, per = next((one for one in ((3600, "s"), (60, "min")) if hourly >= one[0]), (1, "h"))
        return f"{figure(hourly / over, 3)}{unit}/{per}, {_span(left)} left"


@contextmanager
def progress(total: float, unit: str, shown: bool = True) -> Iterator[Progress]:
    """A bar on a terminal, a plain line now and then elsewhere; nothing if it is not to be shown."""
    with _bar(shown, SpinnerColumn(), BarColumn(bar_width=10), TaskProgressColumn(), _State()) as bar:
        made = Progress(total, unit, bar, quiet=not shown)
        over = threading.Event()

        def remind() -> None:
            while not over.wait(SECONDS_BETWEEN_LINES):
                made.remind()

        reminding = threading.Thread(target=remind, daemon=True)
        if shown and bar is None:
            reminding.start()
        try:
            yield made
        finally:
            over.set()
            if reminding.is_alive():
                reminding.join()


def stages(total: int, shown: bool = True) -> AbstractContextManager[Progress]:
    """Progress through so many stages."""
    return progress(total, "stages", shown)


class _State(TextColumn):
    """Pace and what is going on. On a narrow terminal their end is cut, and nothing else."""

    def __init__(self) -> None:
        # In the eyes of the table it can be wrapped, so it is the column that gives way.
        super().__init__("{task.fields[pace]}  {task.description}", markup=False, table_column=Column())

    def render(self, task: rich.progress.Task) -> Text:
        text = super().render(task)
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


@contextmanager
def _bar(shown: bool, *columns: rich.progress.ProgressColumn) -> Iterator[rich.progress.Progress | None]:
    """A bar if it is to be shown and there is a terminal, else none."""
    console = _console(sys.stderr)
    if not shown or not console.is_terminal:
        yield None
        return
    with rich.progress.Progress(*columns, console=console, transient=True) as bar:
        yield bar


def _fitted(table: Table, console: Console) -> int:
    """The width at which a table loses no digit and breaks no word, at least the terminal's. Where that is
    narrow its headings take a line a word; what is wider even so is for the terminal to wrap."""

    def natural() -> int:
        return console.measure(table, options=console.options.update(max_width=10_000)).maximum

    if natural() <= console.width:
        return console.width
    table.padding, broken = 0, 0
    for column in table.columns:
        column.header = "\n".join(str(column.header).split())
        cells = [str(cell) for cell in column.cells]
        if not column.no_wrap:
            words = [word for text in (*cells, column.header) for word in text.split()]
            broken += max(map(len, cells), default=0) - max(map(len, words), default=0)
    return max(console.width, natural() - max(broken, 0))


def _span(seconds: float) -> str:
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


class _Console(Console):
    def on_broken_pipe(self) -> None:
        _detach(self.file)


def _console(stream) -> Console:
    # Names come from files: they are text, never markup.
    console = _Console(file=stream, markup=False, emoji=False, highlight=False)
    if not console.is_terminal:
        console.width = WIDTH
    return console


@contextmanager
def _writing_output() -> Iterator[None]:
    """Raise `InputError` if standard output cannot be written; a reader that has gone away is no error."""
    try:
        yield
    except BrokenPipeError:
        _detach(sys.stdout)
    except OSError as error:
        _detach(sys.stdout)
        reason = one_line(error.strerror or str(error), 100)
        raise InputError(f"standard output: cannot be written: {reason}") from None


def _detach(stream: Any) -> None:
    """Let what is still printed go nowhere: the exit code remains the verdict."""
    try:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
    except (OSError, ValueError):
        pass
