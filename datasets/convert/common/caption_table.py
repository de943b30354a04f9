"""Captions in a table: CSV or TSV whose first line names the columns, one caption a row."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

from motionloom.datasets.convert.common.caption_text import Form, Record, wrong

_DELIMITERS = (",", "\t", ";")


def table_records(
    path: Path, text: str, is_header: Callable[[list[str]], bool], needed: str
) -> Iterator[Record]:
    """The rows as records by the names of the header, in lower case.

    `is_header` says whether names suffice; `needed` says in words which these are.
    """
    lines = text.split("\n")
    first = next((number for number, line in enumerate(lines) if line.strip()), 0)
    delimiter, names = _header(path, lines[first], first, is_header, needed)
    # The reader wants the newlines back: those inside quotes belong to the caption.
    reader = csv.reader((f"{line}\n" for line in lines[first + 1 :]), delimiter=delimiter, strict=True)
    before = 0
    while True:
        number = first + 2 + before  # the line on which the next row starts

        def at(key: str | None, number: int = number) -> str:
            column = names.index(key) if key in names else 0
            return f"{path}:{number}:{_column(lines[number - 1], delimiter, column)}"

        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error:
            column = _open_quote(lines[number - 1], delimiter)
            place = f"{path}:{number}:{column}"
            raise wrong(
                place, "a quote that opens here is not closed before the next column", Form.TABLE
            ) from None
        before = reader.line_num
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            column = _column(lines[number - 1], delimiter, min(len(row), len(names)))
            sign = {"\t": "a tab", ",": "a ','", ";": "a ';'"}[delimiter]
            raise wrong(
                f"{path}:{number}:{column}",
                f"{len(row)} columns, but the first line names {len(names)}; put a caption that holds "
                f"{sign} in quotes",
                Form.TABLE,
            )
        yield Record(dict(zip(names, row, strict=True)), at, Form.TABLE)


def _header(
    path: Path, line: str, number: int, is_header: Callable[[list[str]], bool], needed: str
) -> tuple[str, list[str]]:
    """The delimiter, and the names of the columns."""
    usual = "\t" if path.suffix.lower() in (".tsv", ".tab") else ","
    for delimiter in dict.fromkeys(chain((usual,), _DELIMITERS)):
        try:
            fields = next(csv.reader([line], delimiter=delimiter))
        except csv.Error:
            continue
        names = [re.sub(r"[\s-]+", "_", field.strip().lower()) for field in fields]
        if is_header(names):
            twice = next((name for place, name in enumerate(names) if name and name in names[:place]), None)
            if twice is not None:
                last = len(names) - 1 - names[::-1].index(twice)
                place = f"{path}:{number + 1}:{_column(line, delimiter, last)}"
                raise wrong(place, f"a second column '{twice}'", Form.TABLE)
            return delimiter, names
    shown = line.strip()[:60]
    raise wrong(f"{path}:{number + 1}:1", f"the first line must name {needed}, but is '{shown}'", Form.TABLE)


def _column(line: str, delimiter: str, field: int) -> int:
    """Where a field of a row starts on the row's first line, counted from 1."""
    starts = _starts(line, delimiter)
    return starts[field] if field < len(starts) else len(line) + 1


def _starts(line: str, delimiter: str) -> list[int]:
    """Where every field starts; one that goes on in the next line is the last."""
    one = re.compile(rf'"(?:[^"]|"")*"?[^{re.escape(delimiter)}]*|[^{re.escape(delimiter)}]*')
    starts, at = [], 0
    while at <= len(line):
        starts.append(at + 1)
        found = one.match(line, at)
        at = (found.end() if found else at) + 1
    return starts


def _open_quote(line: str, delimiter: str) -> int:
    """Where the first field starts that opens a quote and does not end with one."""
    ends = re.compile(rf'"(?:[^"]|"")*"(?={re.escape(delimiter)}|$)')
    bad = (
        start for start in _starts(line, delimiter)
        if line[start - 1 : start] == '"' and not ends.match(line, start - 1)
    )  # fmt: skip
    return next(bad, 1)
