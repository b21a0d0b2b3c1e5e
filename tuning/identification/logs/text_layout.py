"""Layout of text logs: delimiter, decimal mark, preamble, line of column names and line of units.

The layout follows from the first lines of a file. The delimiter and the decimal mark are those with which
most cells in the last lines read are numbers. The column names stand above the first lines of data,
with a line of units between them in some files.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from tuning.identification.logs.mapping import TextFormat
from tuning.identification.logs.units import parse_unit

BLANKS = " "  # delimiter that stands for one or more blanks or tabs
DELIMITERS = "\t;," + BLANKS  # candidates, in the order of preference
DIALECT_LINES = 20  # number of lines that show the delimiter and the decimal mark
# least share of numbers in cells [1]; below it, the column names show the delimiter
MIN_SHARE_OF_NUMBERS = 0.1
FIRST_DATA_LINES = 10  # number of successive lines of numbers that show where the data begin
LABVIEW_UNITS = "Y_Unit_Label"  # first cell of the line of units in LabVIEW's measurement files


class TextLayout(NamedTuple):
    """Layout of a text log."""

    names: list[str]  # names of the columns; numbers from 1 if the file has none
    units: list[str]  # unit of each column, empty if the file states none
    delimiter: str
    decimal: str
    skipped: int  # number of lines above the data
    texts: list[bool]  # whether the first non-empty cell of each column is not a number


def detect_layout(lines: Sequence[str], text: TextFormat) -> TextLayout:
    """Detect the layout of a text log.

    Args:
        lines: First lines of the file.
        text: What the user specified; only the rest is detected.
    """
    first = text.skip_rows or 0
    below = [line.strip("\r\n") for line in lines[first:]]
    delimiter, decimal = _detect_dialect(below, text)
    rows = [split_cells(line, delimiter) for line in below]
    header, begin, unit_row = _find_header(rows, below, decimal, text)
    data = rows[begin:]
    if header is None:
        names = [str(index + 1) for index in range(_find_width(data))]
    else:
        names = _split_names(below[header], delimiter, data)
    units = [] if unit_row is None else rows[unit_row]
    for row in rows[: header or 0]:
        if row[:1] == [LABVIEW_UNITS]:
            units = ["s", *row[1:]] if names[:1] == ["X_Value"] else row[1:]
    units = [cell.strip() for cell in (*units, *[""] * len(names))][: len(names)]
    texts = [
        _starts_with_text([row[index] for row in data if index < len(row)], decimal)
        for index in range(len(names))
    ]
    return TextLayout(names, units, delimiter, decimal, first + begin, texts)


def split_cells(line: str, delimiter: str) -> list[str]:
    """Return the cells of a line."""
    if delimiter == BLANKS:
        return line.split()
    return next(csv.reader([line], delimiter=delimiter), [])


def is_number(cell: str, decimal: str) -> bool:
    """Return whether a cell contains a number."""
    try:
        float(cell.strip().replace(decimal, "."))
    except ValueError:
        return False
    return True


def _detect_dialect(lines: Sequence[str], text: TextFormat) -> tuple[str, str]:
    """Return the delimiter and the decimal mark with which most cells of the last lines are numbers."""
    last = [line for line in lines if line.strip()][-DIALECT_LINES:]
    dialects = [
        (delimiter, decimal)
        for delimiter in (text.delimiter or DELIMITERS)
        for decimal in (text.decimal or ".,")
        if delimiter != decimal
    ]

    def share_of_numbers(dialect: tuple[str, str]) -> tuple[bool, float]:
        delimiter, decimal = dialect
        rows = [split_cells(line, delimiter) for line in last]
        width = _find_width(rows)
        cells = [cell for row in rows if len(row) == width for cell in row if cell.strip()]
        total = sum(len(row) for row in rows)
        return width > 1, sum(is_number(cell, decimal) for cell in cells) / max(total, 1)

    best = max(dialects, key=share_of_numbers, default=(text.delimiter or ",", "."))
    if share_of_numbers(best)[1] >= MIN_SHARE_OF_NUMBERS:
        return best
    names = next((line for line in lines if line.strip()), "")
    return next((dialect for dialect in dialects if dialect[0] in names), best)


def _find_header(
    rows: Sequence[Sequence[str]], lines: Sequence[str], decimal: str, text: TextFormat
) -> tuple[int | None, int, int | None]:
    """Return the indices of the line of names (or None), first line of data, and line of units (or None)."""
    is_data = [_is_data(row, decimal) for row in rows]
    width, begin, unit_row = _find_width(rows[-DIALECT_LINES:]), 0, None
    if text.skip_rows is None and rows and len(rows[0]) != width:
        # The lines of a preamble have other numbers of cells than the data.
        follows = [data and len(row) == width for data, row in zip(is_data, rows, strict=True)]
        starts = (i for i in range(len(rows)) if all(follows[i : i + FIRST_DATA_LINES]))
        begin = next(starts, 1)
    elif rows and not (is_data[0] and rows[0][0].strip()[:1] in "+-.0123456789"):
        begin = 1

    def has_units(row: int) -> bool:
        return _is_units(rows[row]) if text.units_row is None else text.units_row

    if begin >= 2 and has_units(begin - 1):
        unit_row = begin - 1
    elif begin == 1 and len(rows) > 1 and has_units(1):
        unit_row, begin = 1, 2
    header = begin - 1 - (unit_row is not None)
    while header > 0 and not lines[header].strip():
        header -= 1
    return (header if header >= 0 else None), begin, unit_row


def _is_data(row: Sequence[str], decimal: str) -> bool:
    """Return whether at least half of the cells that are not empty are numbers."""
    cells = [cell for cell in row if cell.strip()]
    return bool(cells) and 2 * sum(is_number(cell, decimal) for cell in cells) >= len(cells)


def _is_units(row: Sequence[str]) -> bool:
    """Return whether at least half of the cells that are not empty are known units."""
    cells = [cell for cell in row if cell.strip(" -[]()")]
    return bool(cells) and 2 * sum(parse_unit(cell) is not None for cell in cells) >= len(cells)


def _split_names(line: str, delimiter: str, data: Sequence[Sequence[str]]) -> list[str]:
    """Return the column names in a line above the data, without a comment sign."""
    width = _find_width(data)
    line = line.lstrip("#% \t") if line.lstrip().startswith(("#", "%")) else line
    names = split_cells(line, delimiter)
    if delimiter == BLANKS and len(wide := re.split(r"\s{2,}|\t", line.strip())) == width:
        names = wide
    names = [name.strip() for name in names]
    if len(names) == width - 1 and not any(row[-1].strip() for row in data if len(row) == width):
        return [*names, ""]  # The lines of data end in a delimiter.
    if len(names) == width + 1 > 1 and names[-1] in ("", "Comment"):
        return names[:-1]
    return names


def _find_width(rows: Sequence[Sequence[str]]) -> int:
    """Return the most frequent number of cells in rows that are not empty."""
    return max(Counter(len(row) for row in rows if row).items(), key=lambda item: item[1], default=(0, 0))[0]


def _starts_with_text(cells: Sequence[str], decimal: str) -> bool:
    first = next((cell for cell in cells if cell.strip()), "")
    return bool(first) and not is_number(first, decimal)
