"""Terminal output of commands: tables and JSON on standard output, progress and notes on standard error."""

import json
import math
import os
import re
import shlex
import sys
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import Any

import rich.progress
from rich import box
from rich.console import Console, RenderableType
from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn
from rich.table import Column, Table
from rich.text import Text

from jaxhil.errors import InputError, to_one_line
from tuning.number_format import format_number
from tuning.table_layout import fit_table

DEFAULT_WIDTH = 80  # width of lines if no stream is a terminal [characters]
COLUMN_INDEX = re.compile(r"_(\d+)(?=_\d+|$)")  # one-based index in a sweep's column name, for example `_2`
# Verdicts in JSON documents for exit codes 2 and 130.
UNUSABLE_INPUT, INTERRUPTED = "unusable input", "interrupted"
PROGRESS_INTERVAL = 10.0  # time between progress lines if the output is not a terminal [s]
MAX_SILENCE = 20.0  # time without a line after which the progress is printed again [s]
MIN_SHARE_FOR_RATE = 0.05  # finished share of the work above which the rate is accurate enough to be shown


def emit(*things: RenderableType, wrap: bool = True) -> None:
    """Print tables and texts on standard output; wrap long texts if `wrap` is true; ignore a closed pipe."""
    with _convert_output_errors():
        for thing in things:
            console = _make_console(sys.stdout)
            if isinstance(thing, Table):
                console.print(thing.title or "")  # the table would cut a title that is wider than itself
                thing.title = None
                console.width = fit_table(thing, console)
            console.print(thing, soft_wrap=not wrap)
        sys.stdout.flush()


def emit_line(text: str) -> None:
    """Print one line on standard output, without wrapping."""
    emit(text, wrap=False)


def suggest(*words: str) -> None:
    """Print the next command to run: `jaxhil` followed by `words`."""
    emit_line(f"Next: jaxhil {shlex.join(words)}")


def emit_json(command: str, document: Mapping[str, Any]) -> None:
    """Print the result of a command as JSON on standard output.

    If the document has no schema, add `jaxhil/COMMAND/1`; if it has no verdict, add "good".
    """
    defaults = {"schema": f"jaxhil/{command}/1", "verdict": "good"}
    print_json({**{key: value for key, value in defaults.items() if key not in document}, **document})


def emit_json_error(command: str, verdict: str, problems: Sequence[str]) -> None:
    """Print the JSON document of a failed command: its verdict, and messages of one line each."""
    schema = {"schema": "jaxhil/error/1", "command": command}
    print_json({**schema, "verdict": verdict, "problems": list(problems)})


def print_json(document: Mapping[str, Any]) -> None:
    """Print a document as JSON on standard output, in the form of `format_json`."""
    with _convert_output_errors():
        print(format_json(document), end="", flush=True)


def format_json(document: Mapping[str, Any]) -> str:
    """Return a document as lines of JSON in ASCII, with null for numbers that are not finite."""
    return json.dumps(to_json_data(document), indent=2, allow_nan=False) + "\n"


def warn(texts: Iterable[str]) -> None:
    """Print warnings on standard error, one line each."""
    for text in texts:
        note(f"warning: {text}")


def note(text: str) -> None:
    """Print a text on standard error; ignore it if standard error cannot be written."""
    try:
        _make_console(sys.stderr).print(text, soft_wrap=True)
    except OSError:
        _redirect_to_null(sys.stderr)


def build_table(
    title: str, headings: Sequence[str], rows: Sequence[Sequence[Any]], texts: Sequence[int] = (0,)
) -> Table:
    """Return a table; `texts` holds the indices of the columns that contain text instead of numbers."""
    result = Table(title=Text(title, style="bold"), box=box.SIMPLE_HEAD, pad_edge=False)
    for number, heading in enumerate(headings):
        is_text = number in texts
        result.add_column(
            heading, justify="left" if is_text else "right", overflow="fold", no_wrap=not is_text
        )
    for row in rows:
        result.add_row(*(value if isinstance(value, str) else format_number(value) for value in row))
    return result


def format_error(value: float | None) -> str:
    """Return a restitution error as text with a sign, or a dash if the error is None or NaN."""
    return "-" if value is None or value != value else f"{value:+.4f}"


def format_ratio(value: float, ideal: float) -> str:
    """Return `value / ideal` as text with three decimals, or a dash if the ratio is not finite."""
    quotient = value / ideal if ideal else math.nan
    return f"{quotient:.3f}" if math.isfinite(quotient) and math.isfinite(ideal) else "-"


def format_key(key: str) -> str:
    """Return a dotted key with list indices in brackets: `a.0` and the sweep column `a_1` become `a[0]`."""
    key = COLUMN_INDEX.sub(lambda match: f".{int(match[1]) - 1}", key)
    return "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in key.split("."))[1:]


def to_json_data(value: Any) -> Any:
    """Convert a value to data that JSON can represent, with None for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): to_json_data(entry) for key, entry in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return to_json_data(value._asdict())  # pyright: ignore[reportAttributeAccessIssue]
    if isinstance(value, (list, tuple)):
        return [to_json_data(entry) for entry in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return to_json_data(value.tolist()) if hasattr(value, "tolist") else value


class Progress:
    """Progress display on standard error for a known amount of work.

    The display shows the work done, the rate, the time left and the current activity. On a terminal, it is a
    bar. Otherwise, a line is printed at regular intervals and when the activity changes; if
    `quiet` is true, nothing is printed.
    """

    def __init__(self, total: float, unit: str, bar: rich.progress.Progress | None, quiet: bool):
        self._total, self._unit, self._bar = total, unit, bar
        self._note = (lambda text: None) if quiet else note
        self._task: Any = None if bar is None else bar.add_task("", total=total, pace="")
        self._done, self._skipped, self._begun_stage, self._text = 0.0, 0.0, False, ""
        self._begun = self._shown = time.monotonic()
        self._lock = threading.RLock()

    @property
    def rate(self) -> float | None:
        """Return the rate [units/s] of the work done in this run; None before any work is done."""
        worked, duration = self._done - self._skipped, time.monotonic() - self._begun
        return worked / duration if worked > 0 and duration > 0 else None

    def skip(self, number: float) -> None:
        """Count `number` units as done by an earlier run; `rate` does not include them."""
        self._done += number
        self._skipped += number
        self._begun = time.monotonic()

    def advance(self, number: float, text: str | None = None) -> None:
        """Count `number` further units as done; if given, `text` becomes the current activity or result."""
        self.reach(self._done + number, text)

    def reach(self, done: float, text: str | None = None) -> None:
        """Set the number of units done so far; if given, `text` becomes the current activity or result."""
        with self._lock:
            self._done = max(self._done, done)
            self._text = self._text if text is None else text
            self._show(due=PROGRESS_INTERVAL)

    def say(self, text: str) -> None:
        """Show `text` as the current activity."""
        with self._lock:
            is_new, self._text = text != self._text, text
            self._show(due=0.0 if is_new else PROGRESS_INTERVAL)

    def tell(self, text: str, done: float, skipped: float = 0.0) -> None:
        """Show `text` as the current activity.

        `done` is the number of units done so far, and `skipped` how many of them an earlier run did.
        """
        with self._lock:
            self._done, self._skipped = max(self._done, done), skipped
            self.say(text)

    def begin(self, text: str) -> None:
        """Count the previous unit, if any, as done, and show `text` as the activity of the next unit."""
        with self._lock:
            self._end_unit()
            self.say(text)

    def turn_to(self, text: str) -> None:
        """Count the previous unit, if any, as done, and make `text` the activity of the next unit.

        Without a bar, print `text` only if no line was printed in the last `PROGRESS_INTERVAL` seconds.
        """
        with self._lock:
            self._end_unit()
            self.reach(self._done, text)

    def remind(self) -> None:
        """Print the current progress again if no line was printed in the last `MAX_SILENCE` seconds."""
        with self._lock:
            self._show(due=MAX_SILENCE)

    def _end_unit(self) -> None:
        """Count the previous unit, if any, as done."""
        self._done += self._begun_stage
        self._begun_stage = True

    def _show(self, due: float) -> None:
        """Update the bar or, without a bar, print a line if the last line is at least `due` seconds old."""
        if self._bar is not None:
            rate = self._format_rate()
            self._bar.update(self._task, completed=self._done, description=self._text, pace=rate)
        elif time.monotonic() - self._shown >= due and (self._done < self._total or due == 0.0):
            self._shown = time.monotonic()
            self._note(", ".join(filter(None, [self._format_done(), self._format_rate(), self._text])))

    def _format_done(self) -> str:
        """Return the work done as text: in units, or in percent if the whole work is a single unit."""
        if self._done <= 0:
            return ""
        if self._total == 1:
            return f"{100 * self._done:.0f} %"
        return f"{math.floor(self._done)} of {self._total} {self._unit}"

    def _format_rate(self) -> str:
        """Return the rate and the time left as text; at the beginning, the time elapsed."""
        if (rate := self.rate) is None or self._done < MIN_SHARE_FOR_RATE * self._total:
            return f"{format_duration(time.monotonic() - self._begun)} so far"
        left = max(self._total - self._done, 0.0) / rate
        # If the whole work is a single unit, the rate is the percentage of it that is done per unit of time.
        scale, unit = (100.0, " %") if self._total == 1 else (1.0, f" {self._unit}")
        hourly = 3600 * scale * rate
        divisor, per = next((pair for pair in ((3600, "s"), (60, "min")) if hourly >= pair[0]), (1, "h"))
        return f"{format_number(hourly / divisor, 3)}{unit}/{per}, {format_duration(left)} left"


@contextmanager
def show_progress(total: float, unit: str, shown: bool = True) -> Iterator[Progress]:
    """Provide a progress display: a bar on a terminal, lines otherwise, nothing if `shown` is false."""
    with _show_bar(
        shown, SpinnerColumn(), BarColumn(bar_width=10), TaskProgressColumn(), _ActivityColumn()
    ) as bar:
        display = Progress(total, unit, bar, quiet=not shown)
        stop = threading.Event()

        def remind() -> None:
            while not stop.wait(PROGRESS_INTERVAL):
                display.remind()

        thread = threading.Thread(target=remind, daemon=True)
        if shown and bar is None:
            thread.start()
        try:
            yield display
        finally:
            stop.set()
            if thread.is_alive():
                thread.join()


def show_stages(total: int, shown: bool = True) -> AbstractContextManager[Progress]:
    """Provide a progress display, like `show_progress`, for work in `total` stages."""
    return show_progress(total, "stages", shown)


class _ActivityColumn(TextColumn):
    """Progress-bar column with rate and current activity; a narrow terminal truncates only this column."""

    def __init__(self) -> None:
        # rich narrows columns that allow line breaks before all others; `render` then truncates the line.
        super().__init__("{task.fields[pace]}  {task.description}", markup=False, table_column=Column())

    def render(self, task: rich.progress.Task) -> Text:
        text = super().render(task)
        text.no_wrap, text.overflow = True, "ellipsis"
        return text


@contextmanager
def _show_bar(shown: bool, *columns: rich.progress.ProgressColumn) -> Iterator[rich.progress.Progress | None]:
    """Provide a progress bar if `shown` is true and standard error is a terminal, else None."""
    console = _make_console(sys.stderr)
    if not shown or not console.is_terminal:
        yield None
        return
    with rich.progress.Progress(*columns, console=console, transient=True) as bar:
        yield bar


def format_duration(seconds: float) -> str:
    """Return a duration as text in hours, minutes and seconds."""
    rounded = round(seconds)
    return f"{rounded // 3600}:{rounded // 60 % 60:02d}:{rounded % 60:02d}"


class _Console(Console):
    """Console that ignores a closed pipe."""

    def on_broken_pipe(self) -> None:
        _redirect_to_null(self.file)


def _make_console(stream) -> Console:
    # Names come from files and must not be interpreted as markup.
    console = _Console(file=stream, markup=False, emoji=False, highlight=False)
    if not console.is_terminal:
        console.width = _width_without_terminal()
    return console


def _width_without_terminal() -> int:
    """Return the width of piped output: `$COLUMNS`, the width of a terminal on a standard stream, or 80."""
    if (columns := os.environ.get("COLUMNS", "")).isdigit() and int(columns) > 0:
        return int(columns)
    for descriptor in range(3):
        with suppress(OSError):
            return os.get_terminal_size(descriptor).columns or DEFAULT_WIDTH
    return DEFAULT_WIDTH


@contextmanager
def _convert_output_errors() -> Iterator[None]:
    """Convert an `OSError` of standard output to an `InputError`; ignore a closed pipe."""
    try:
        yield
    except BrokenPipeError:
        _redirect_to_null(sys.stdout)
    except OSError as error:
        _redirect_to_null(sys.stdout)
        reason = to_one_line(error.strerror or str(error), 100)
        raise InputError(f"standard output: cannot be written: {reason}") from None


def _redirect_to_null(stream: Any) -> None:
    """Redirect a stream to the null device, because a failed flush at exit would change the exit code."""
    try:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)
    except (OSError, ValueError):
        pass
