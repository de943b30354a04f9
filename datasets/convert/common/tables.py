"""Lists and captions as sets publish them: JSON, JSON lines, CSV, and words in several forms."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path

from motionloom.datasets.convert.common.files import read_text_file
from motionloom.datasets.schema import Caption, UserError, parse_json
from motionloom.datasets.text.clean import clean_caption


def read_json(path: Path, name: str) -> object:
    """The content of a JSON file; `UserError` names it."""
    return parse_json(read_text_file(path, name), name)


def read_json_lines(path: Path, name: str) -> Iterator[tuple[str, dict[str, object]]]:
    """(place, record) of every line that is not blank."""
    for number, line in enumerate(read_text_file(path, name).split("\n"), start=1):
        if line.strip():
            place = f"{name}:{number}"
            yield place, require_record(parse_json(line, place), place)


def require_record(value: object, place: str) -> dict[str, object]:
    """The value, if it is a JSON object."""
    if not isinstance(value, dict):
        raise UserError(f"{place}: a JSON object is expected, found {type(value).__name__}")
    return value


def read_csv(path: Path, columns: Iterable[str]) -> list[tuple[str, dict[str, str]]]:
    """(place, row) of a table with a header; `UserError` names a missing column or a row that is cut."""
    lines = read_text_file(path, path.name).split("\n")
    reader = csv.reader((f"{line}\n" for line in lines), strict=True)
    rows = []
    try:
        header = [name.strip() for name in next(reader, [])]
        missing = [name for name in columns if name not in header]
        if missing:
            raise UserError(
                f"{path.name}: no column '{missing[0]}'; there are {', '.join(header[:12]) or 'none'}"
            )
        for row in reader:
            place = f"{path.name}:{reader.line_num}"
            if any(cell.strip() for cell in row):
                if len(row) != len(header):
                    raise UserError(f"{place}: {len(row)} columns, the header has {len(header)}")
                rows.append((place, dict(zip(header, row, strict=True))))
    except csv.Error as error:
        raise UserError(f"{path.name}:{reader.line_num}: not a table ({error})") from None
    return rows


def captions_of(words: object, source: str, start: float = 0.0, end: float | None = None) -> list[Caption]:
    """A sentence or a list of sentences as captions; anything without words is passed over."""
    listed = words if isinstance(words, list) else [words]
    texts = [clean_caption(text) for text in listed if isinstance(text, str)]
    return [Caption(text=text, source=source, start=start, end=end) for text in dict.fromkeys(texts) if text]
