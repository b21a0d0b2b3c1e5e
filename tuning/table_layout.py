"""Layout of tables for narrow terminals: no number and no word is broken."""

import textwrap

from rich.console import Console
from rich.table import Column, Table

MIN_WRAPPED_TEXT = 12  # length of the shortest text that a narrow table wraps [characters]
MIN_BROKEN_NAME = 24  # length of the shortest dotted name that a narrow table breaks [characters]


def fit_table(table: Table, console: Console) -> int:
    """Fit a table to the console; return the larger of the table's and the console's width [characters].

    If the console is too narrow, wrap each heading at the width of its column's cells, and wrap texts
    between words. If necessary, also break dotted names before their last part. The table may still be too
    wide; the terminal then wraps its lines.
    """

    def full_width() -> int:
        return console.measure(table, options=console.options.update(max_width=10_000)).maximum

    if full_width() <= console.width:
        return console.width
    table.padding = 0
    for column in table.columns:
        longest = max(map(len, (*map(str, column.cells), *str(column.header).split())), default=1)
        column.header = "\n".join(textwrap.wrap(str(column.header), max(longest, 1)))
        column.no_wrap = column.no_wrap or longest < MIN_WRAPPED_TEXT
    if full_width() - sum(map(_count_breakable, table.columns)) > console.width:
        for column in table.columns:
            column._cells = [_break_name(str(cell)) for cell in column._cells]
    columns = [column for column in table.columns if _count_breakable(column)]
    widths = [max(map(len, _lines(column))) for column in columns]
    least = [width - _count_breakable(column) for width, column in zip(widths, columns, strict=True)]
    for _ in range(full_width() - console.width):
        # Narrow the widest column that still has a break.
        _, index = max(((width, n) for n, width in enumerate(widths) if width > least[n]), default=(0, -1))
        if index >= 0:
            widths[index] -= 1
    for column, width in zip(columns, widths, strict=True):
        column.width = width
    return max(console.width, full_width())


def _count_breakable(column: Column) -> int:
    """Return how much narrower a column can become by line breaks between words [characters]."""
    if column.no_wrap:
        return 0
    lines = _lines(column)
    return max(map(len, lines)) - max(len(word) for line in lines for word in line.split())


def _lines(column: Column) -> list[str]:
    """Return the text lines of a column's heading and cells."""
    return [line for cell in (*column.cells, column.header) for line in str(cell).splitlines()]


def _break_name(text: str) -> str:
    """Break a long dotted name before its last part."""
    head, dot, tail = text.rpartition(".")
    return f"{head}{dot}\n{tail}" if len(text) >= MIN_BROKEN_NAME and dot and " " not in text else text
