"""Lists and captions as sets publish them: JSON, JSON lines, CSV, and words in several forms."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.records import Caption
from motionloom.datasets.convert.common.config import END_TOLERANCE
from motionloom.datasets.convert.common.files import read_text_file
from motionloom.datasets.text.clean import clean_caption

DELIMITERS = {",": "a ','", "\t": "a tab", ";": "a ';'"}
_LONGEST_ROW = 100
"""Lines of a row, whose text may hold newlines in quotes; beyond that a quote was not closed."""


def read_json(path: Path, name: str) -> object:
    """The content of a JSON file; `UserError` names it."""
    return parse_json(read_text_file(path, name), name)


BadRows = dict[str, str]
"""What is wrong with a row of a table, by its place or, where it says one, the clip that it is of. A table of
a hundred thousand rows is not refused for one of them."""


@contextmanager
def reading_row(place: str, bad: BadRows, needs: str = "is not as expected") -> Iterator[None]:
    """Note a row as bad, and why, where what is read of it within fails; `needs` says what it must hold."""
    try:
        yield
    except (UserError, LookupError, TypeError, ValueError) as error:
        bad[place] = str(error) if isinstance(error, UserError) else f"{place}: {needs} ({error})"


def read_json_lines(path: Path, name: str, bad: BadRows) -> Iterator[tuple[str, dict[str, object]]]:
    """(place, record) of every line that is not blank; those that are no record go into `bad`."""
    for number, line in enumerate(read_text_file(path, name).split("\n"), start=1):
        if line.strip():
            place = f"{name}:{number}"
            record = None
            with reading_row(place, bad):
                record = require_record(parse_json(line, place), place)
            if record is not None:
                yield place, record


def require_record(value: object, place: str) -> dict[str, object]:
    """The value, if it is a JSON object."""
    if not isinstance(value, dict):
        raise UserError(f"{place}: a JSON object is expected, found {type(value).__name__}")
    return value


def read_csv(path: Path, columns: Iterable[str], bad: BadRows) -> list[tuple[str, dict[str, str]]]:
    """(place, row) of a table with a header; rows that are cut go into `bad`. `UserError` names a missing
    column.
    """
    lines = read_text_file(path, path.name).split("\n")
    try:
        header = [name.strip() for name in next(csv.reader(lines[:1]), [])]
    except csv.Error as error:
        raise UserError(f"{path.name}:1: {error}") from None
    missing = [name for name in columns if name not in header]
    if missing:
        raise UserError(
            f"{path.name}: no column '{missing[0]}'; there are {', '.join(header[:12]) or 'none'}"
        )
    rows = []
    for place, row in table_rows(lines[1:], 2, header, ",", path.name):
        if isinstance(row, UserError):
            bad[place] = str(row)
        else:
            rows.append((place, row))
    return rows


def table_rows(
    lines: Sequence[str], first: int, header: Sequence[str], delimiter: str, name: str
) -> Iterator[tuple[str, dict[str, str] | UserError]]:
    """(place, row) of the lines below a header, which begin at line `first`; blank rows say nothing.

    In place of a row that is cut stands a `UserError` with its line, and the line after it is read as a row
    again: a quote that is not closed takes no other row with it.
    """
    at = 0
    while at < len(lines):
        place = f"{name}:{first + at}"
        begin = at
        # The reader wants the newlines back: those inside quotes belong to the text.
        reader = csv.reader(
            (f"{line}\n" for line in lines[at : at + _LONGEST_ROW]), delimiter=delimiter, strict=True
        )
        try:
            row = next(reader)
            at += reader.line_num
        except csv.Error as error:
            at += 1
            reason = "a quote is not closed before the next column"
            if "field larger" in str(error):
                reason = f"a column of more than {csv.field_size_limit():,} letters"
            yield place, UserError(f"{place}: {reason}")
            continue
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(header):
            at = begin + 1
            problem = (
                f"{place}: {len(row)} columns, the header has {len(header)} ({', '.join(header[:12])}); put "
                f"text that holds {DELIMITERS[delimiter]} in quotes"
            )
            yield place, UserError(problem)
            continue
        yield place, dict(zip(header, row, strict=True))


def captions_within(
    texts: Iterable[Caption], seconds: float, clip: str, notes: list[str]
) -> tuple[Caption, ...]:
    """The captions of a clip of that length, ending with it; those of other times are left out and noted."""
    kept = []
    # Which frames a caption beyond the clip describes is unknown; a little beyond is rounding.
    for text in texts:
        if text.start < seconds and (text.end is None or text.end <= seconds + END_TOLERANCE):
            end = None if text.end is None else min(text.end, seconds)
            kept.append(text if end == text.end else text.model_copy(update={"end": end}))
        else:
            what = f"starts at {text.start:g} s" if text.start >= seconds else f"ends at {text.end:g} s"
            notes.append(f"{clip}: a caption {what}, beyond its {seconds:.1f} s")
    return tuple(kept)


def captions_of(words: object, source: str, start: float = 0.0, end: float | None = None) -> list[Caption]:
    """A sentence or a list of sentences as captions; anything without words is passed over."""
    listed = words if isinstance(words, list) else [words]
    texts = [clean_caption(text) for text in listed if isinstance(text, str)]
    return [Caption(text=text, source=source, start=start, end=end) for text in dict.fromkeys(texts) if text]
