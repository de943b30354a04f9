"""Captions in JSON: one object a line, a list of records, or one object of names and captions.

Values are decoded one by one, so that an error knows where its record starts in the file.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from motionloom.datasets.convert.common.caption_text import Form, Record, place_of, wrong

_DECODER = json.JSONDecoder()
_SPACE = re.compile(r"[ \t\n]*")


def json_form(path: Path, text: str, is_record: Callable[[dict[str, Any]], bool]) -> Form:
    """Which of the three a text that starts with a bracket or brace is.

    `is_record` tells a record (it names its clip) from an object whose keys are the names.
    """
    start = _skip(text, 0)
    if text[start : start + 1] == "[":
        return Form.LIST
    if path.suffix.lower() in (".jsonl", ".ndjson"):
        return Form.LINES
    try:
        first, end = _DECODER.raw_decode(text, start)
    except (ValueError, RecursionError):  # broken inside: the reader of the form says where
        return Form.OBJECT
    if _skip(text, end) < len(text) or (isinstance(first, dict) and is_record(first)):
        return Form.LINES
    return Form.OBJECT


def json_records(path: Path, text: str, form: Form) -> Iterator[Record]:
    """The records of a file in one of JSON's forms."""
    if form is Form.LINES:
        yield from _lines(path, text)
    elif form is Form.LIST:
        for start, end, value in _items(path, text):
            yield _record(path, text, start, end, value, Form.LIST)
    else:
        yield from _named(path, text)


def _lines(path: Path, text: str) -> Iterator[Record]:
    start = 0
    for line in text.split("\n"):
        if line.strip():
            value, stop = _decode(path, text, _skip(text, start), Form.LINES, end=start + len(line))
            if (rest := _skip(text, stop)) < start + len(line):
                raise wrong(place_of(path, text, rest), "more after the end of the object", Form.LINES)
            yield _record(path, text, _skip(text, start), start + len(line), value, Form.LINES)
        start += len(line) + 1


def _items(path: Path, text: str) -> Iterator[tuple[int, int, Any]]:
    """(start, end, value) of every item of the list."""
    form = Form.LIST
    at = _skip(text, 0) + 1
    if text[(inside := _skip(text, at)) : inside + 1] == "]":
        at = inside
    while text[at : at + 1] != "]":
        start = _skip(text, at)
        value, end = _decode(path, text, start, form)
        yield start, end, value
        at = _separator(path, text, end, "]", form)
    _nothing_after(path, text, at + 1, form)


def _named(path: Path, text: str) -> Iterator[Record]:
    """The entries of one object as records; the names must be different."""
    form, at = Form.OBJECT, _skip(text, 0)
    if text[at : at + 1] != "{":
        raise wrong(place_of(path, text, at), "neither a list nor an object", form)
    at += 1
    if text[(inside := _skip(text, at)) : inside + 1] == "}":
        at = inside
    while text[at : at + 1] != "}":
        start = _skip(text, at)
        name, colon = _decode(path, text, start, form)
        if not isinstance(name, str):
            raise wrong(place_of(path, text, start), "a name in quotes is missing", form)
        colon = _skip(text, colon)
        if text[colon : colon + 1] != ":":
            raise wrong(place_of(path, text, colon), f"a ':' is missing after '{name[:40]}'", form)
        inner = _skip(text, colon + 1)
        value, end = _decode(path, text, inner, form)
        if isinstance(value, dict):
            yield _record(path, text, start, end, {"id": name} | value, form)
        else:
            yield _record(path, text, start, end, {"id": name, "captions": value}, form, {"captions": inner})
        at = _separator(path, text, end, "}", form)
    _nothing_after(path, text, at + 1, form)


def _record(
    path: Path,
    text: str,
    start: int,
    end: int,
    value: Any,
    form: Form,
    known: dict[str, int] | None = None,
) -> Record:
    """A record between two offsets; `known` are offsets of values that no key of the text names."""
    if not isinstance(value, dict):
        raise wrong(place_of(path, text, start), f"{kind_of(value)} where a record belongs", form)

    def at(key: str | None) -> str:
        if known and key in known:
            return place_of(path, text, known[key])
        found = re.compile(rf"{re.escape(json.dumps(key))}\s*:\s*").search(text, start, end) if key else None
        return place_of(path, text, found.end() if found else start)

    return Record(value, at, form)


def kind_of(value: Any) -> str:
    """A JSON value's kind in words."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, (int, float)):
        return "a number"
    if isinstance(value, str):
        return "a text"
    return "a list" if isinstance(value, list) else "an object"


def _decode(path: Path, text: str, start: int, form: Form, end: int | None = None) -> tuple[Any, int]:
    """The value at an offset and where it ends; within one line where `end` is given."""
    try:
        value, stop = _DECODER.raw_decode(
            text if end is None else text[start:end], start if end is None else 0
        )
    except json.JSONDecodeError as error:
        at = error.pos + (start if end is not None else 0)
        raise wrong(place_of(path, text, at), f"not valid JSON ({error.msg.lower()})", form) from None
    except (ValueError, RecursionError):
        raise wrong(
            place_of(path, text, start), "not valid JSON (too deep, or a number too long)", form
        ) from None
    return value, stop + (start if end is not None else 0)


def _skip(text: str, at: int) -> int:
    """The offset of the next character that is no blank."""
    found = _SPACE.match(text, at)
    return found.end() if found else at


def _separator(path: Path, text: str, at: int, closing: str, form: Form) -> int:
    """After an item: past its comma, or at the closing bracket."""
    at = _skip(text, at)
    here = text[at : at + 1]
    if here == closing:
        return at
    if here != ",":
        raise wrong(place_of(path, text, at), f"not valid JSON (',' or '{closing}' is missing)", form)
    after = _skip(text, at + 1)
    if text[after : after + 1] == closing:
        raise wrong(place_of(path, text, at), f"not valid JSON (a ',' before '{closing}')", form)
    return at + 1


def _nothing_after(path: Path, text: str, at: int, form: Form) -> None:
    if (rest := _skip(text, at)) < len(text):
        raise wrong(place_of(path, text, rest), "more after the end of the JSON", form)
