"""Reader of text logs: CSV and other tables of cells, in any encoding, with a preamble or lines of units."""

from __future__ import annotations

import codecs
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import csv as arrow_csv

from tuning.identification.logs.arrow_columns import to_array
from tuning.identification.logs.log_reader import ColumnsByName, LogReader
from tuning.identification.logs.mapping import TextFormat
from tuning.identification.logs.text_layout import BLANKS, TextLayout, detect_layout

SAMPLE_BYTES = 1 << 18  # number of bytes at the beginning that show the layout
PARSE_BLOCK_BYTES = 1 << 22  # number of bytes that are parsed at once
GROWTH_ROWS = 1 << 19  # number of rows by which a full array is enlarged


def open_text_log(path: Path, text: TextFormat) -> LogReader:
    """Open a text log.

    Args:
        path: Path of the log.
        text: What the user specified about its layout.
    """
    with path.open("rb") as file:
        sample = file.read(SAMPLE_BYTES)
    encoding = _detect_encoding(sample)
    lines = re.split(r"\r\n|\n|\r", sample.decode(encoding, "replace").lstrip("\ufeff"))
    if len(sample) == SAMPLE_BYTES and len(lines) > 1:
        lines.pop()  # The last line is not complete.
    layout = detect_layout(lines, text)
    units = {name: unit for name, unit in zip(layout.names, layout.units, strict=True) if unit}
    return LogReader(layout.names, lambda wanted: _read(path, encoding, layout, wanted), units=units)


def _detect_encoding(sample: bytes) -> str:
    """Return the encoding of a file that begins with these bytes."""
    if sample.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if len(sample) > 1 and 0 in sample[:2] and sample.count(0) > len(sample) // 3:
        return "utf-16-le" if sample[1] == 0 else "utf-16-be"
    try:
        sample[: sample.rfind(b"\n") + 1].decode("utf-8")
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8"


def _open_stream(path: Path, encoding: str, layout: TextLayout):
    """Return the stream that Arrow reads: the file, or its content with blanks replaced by tabs."""
    if layout.delimiter != BLANKS:
        return path
    content = re.sub(
        r"[ \t]+(?=[\r\n]|$)|(?:(?<=\n)|^)[ \t]+", "", path.read_bytes().decode(encoding, "replace")
    )
    return pa.BufferReader(re.sub(r"[ \t]+", "\t", content).encode())


def _read(path: Path, encoding: str, layout: TextLayout, wanted: Sequence[str]) -> ColumnsByName:
    names = layout.names
    unique = [f"{index} {name}" for index, name in enumerate(names)]
    texts = {name for name in wanted if layout.texts[names.index(name)]}
    chosen = {name: unique[names.index(name)] for name in wanted}
    kinds = {chosen[name]: pa.string() if name in texts else pa.float64() for name in wanted}
    is_blank = layout.delimiter == BLANKS
    batches = arrow_csv.open_csv(
        _open_stream(path, encoding, layout),
        arrow_csv.ReadOptions(
            column_names=unique,
            skip_rows=layout.skipped,
            block_size=PARSE_BLOCK_BYTES,
            use_threads=False,
            encoding=encoding if encoding.startswith("utf-16") and not is_blank else "utf8",
        ),
        arrow_csv.ParseOptions(delimiter="\t" if is_blank else layout.delimiter),
        arrow_csv.ConvertOptions(
            column_types=kinds,
            include_columns=list(kinds),
            decimal_point=layout.decimal,
            strings_can_be_null=False,
        ),
    )
    # Arrays that grow with each batch save memory: a whole table needs three times the memory of its numbers.
    # A single thread parses the file, so that error messages name the invalid row.
    columns: ColumnsByName = {name: np.empty(0, object if name in texts else float) for name in chosen}
    rows = 0
    for batch in batches:
        until = rows + batch.num_rows
        for name, unique_name in chosen.items():
            column = columns[name]
            if len(column) < until:
                column.resize(until + GROWTH_ROWS, refcheck=False)
            column[rows:until] = to_array(pa.chunked_array([batch.column(unique_name)]), name)
        rows = until
    return {name: column[:rows] for name, column in columns.items()}
