"""The six forms in which people bring captions, read into records: text, JSON, tables, folders.

Every error about such a file reads `FILE:LINE: what is wrong; expected the form`.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from motionloom.datasets.convert.captions.humanml_text import parse_caption
from motionloom.datasets.schema import Caption, UserError


class Form(Enum):
    """The forms of captions that are understood; a value says in one phrase what the form looks like."""

    LINES = 'one JSON object a line: {"id": "walk-001", "captions": ["a person walks"]}'
    LIST = 'a JSON list of records: [{"id": "walk-001", "captions": ["a person walks"]}, ...]'
    OBJECT = 'one JSON object of names and captions: {"walk-001": ["a person walks"], ...}'
    TABLE = "CSV or TSV whose first line names the columns, such as: name,caption"
    PLAIN = "one caption a line in FOLDER/CLIP.txt"
    HUMANML = "HumanML3D's lines caption#tokens#start#end: a person walks#a/DET person/NOUN walk/VERB#0.0#0.0"


def wrong(place: str, what: str, form: Form) -> UserError:
    """The error about a place in a file."""
    return UserError(f"{place}: {what}; expected {form.value}")


@dataclass(frozen=True)
class Record:
    """What a file says about one clip, not yet looked at."""

    values: dict[str, object]
    where: str
    """`FILE:LINE`, or the file and which of its records."""
    form: Form

    def wrong(self, what: str) -> UserError:
        return wrong(self.where, what, self.form)


def read_text(path: Path) -> str:
    """The text of a UTF-8 file with plain newlines; `UserError` names the line of any other byte."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot read the captions ({error.strerror})") from None
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UserError(f"{path}: UTF-16 text; save the file as UTF-8")
    if raw.startswith((b"PK\x03\x04", b"PAR1", b"\x1f\x8b")):
        raise UserError(f"{path}: not a text file; save the captions as CSV or JSON")
    raw = raw.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        byte = raw[error.start]
        meant = bytes([byte]).decode("cp1252", "replace")
        hint = f" (as Latin-1 it would be '{meant}')" if meant.isprintable() and meant != "\ufffd" else ""
        line = raw[: error.start].count(b"\n") + 1
        raise UserError(
            f"{path}:{line}: byte 0x{byte:02x} is not UTF-8{hint}; save the file as UTF-8"
        ) from None


def json_records(path: Path, text: str, is_record: Callable[[dict[str, object]], bool]) -> Iterator[Record]:
    """The records of a text that starts with a bracket or brace.

    `is_record` tells a record (it names its clip) from an object whose keys are the names.
    """
    if text.lstrip()[0] == "[":
        for number, value in enumerate(_decode(path, text, Form.LIST), start=1):
            yield _record(value, f"{path}: record {number}", Form.LIST)
        return
    if path.suffix.lower() in (".jsonl", ".ndjson") or _is_lines(text, is_record):
        for number, line in enumerate(text.split("\n"), start=1):
            if line.strip():
                yield _record(_decode(path, line, Form.LINES, number), f"{path}:{number}", Form.LINES)
        return
    named = _decode(path, text, Form.OBJECT)
    if not isinstance(named, dict):
        raise wrong(str(path), "neither a list nor an object", Form.OBJECT)
    for name, value in named.items():
        values = {"id": name} | (value if isinstance(value, dict) else {"captions": value})
        yield Record(values, f"{path}: '{name[:40]}'", Form.OBJECT)


def _is_lines(text: str, is_record: Callable[[dict[str, object]], bool]) -> bool:
    """Whether an object is the first of several, or a record by itself."""
    start = len(text) - len(text.lstrip())
    try:
        first, end = json.JSONDecoder().raw_decode(text, start)
    except (ValueError, RecursionError):  # broken inside, which its reader says
        return False
    return bool(text[end:].strip()) or is_record(first)


def _record(value: object, where: str, form: Form) -> Record:
    if not isinstance(value, dict):
        raise wrong(where, f"{kind_of(value)} where a record belongs", form)
    return Record(value, where, form)


def kind_of(value: object) -> str:
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


def _decode(path: Path, text: str, form: Form, line: int = 1) -> Any:
    try:
        return json.loads(text, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        place = f"{path}:{line + error.lineno - 1}"
        raise wrong(place, f"not valid JSON ({error.msg.lower()})", form) from None
    except KeyError as error:
        raise wrong(f"{path}:{line}" if form is Form.LINES else str(path), str(error.args[0]), form) from None
    except (ValueError, RecursionError):
        raise wrong(f"{path}:{line}", "not valid JSON (too deep, or a number too long)", form) from None


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, object]:
    found: dict[str, object] = {}
    for name, value in pairs:
        if name in found:
            raise KeyError(f"'{name[:40]}' appears twice")
        found[name] = value
    return found


_NUMBER = r"\s*(?:nan|[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[-+]?\.\d+)\s*"
_HUMANML = re.compile(rf"[^#].*#.*#{_NUMBER}#{_NUMBER}")


def folder_records(folder: Path) -> Iterator[Record]:
    """A record for each file, named by its path without `.txt`.

    The folder is in HumanML3D's grammar when the first line of any file is: then all lines must be.
    """
    paths = sorted(p for p in folder.rglob("*.txt") if p.is_file() and not p.name.startswith("."))
    if not paths:
        others = sorted(p.name for p in folder.iterdir() if p.is_file())[:3]
        seen = f" (it holds {', '.join(others)}; name the file itself)" if others else ""
        raise UserError(f"{folder}: no .txt file in it{seen}; expected {Form.PLAIN.value}")
    texts = {path: read_text(path).split("\n") for path in paths}
    firsts = (next((line for line in lines if line.strip()), "") for lines in texts.values())
    humanml = any(_HUMANML.fullmatch(line) for line in firsts)
    for path, lines in texts.items():
        name = path.relative_to(folder).as_posix().removesuffix(".txt")
        made = _humanml(path, lines) if humanml else [line for line in lines if line.strip()]
        yield Record({"id": name, "captions": made}, f"{path}:1", Form.HUMANML if humanml else Form.PLAIN)


def _humanml(path: Path, lines: list[str]) -> list[Caption]:
    made = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                made.append(parse_caption(line, seconds=None, source="captions"))
            except UserError as error:
                raise wrong(f"{path}:{number}", str(error), Form.HUMANML) from None
    return made


_DELIMITERS = {",": "a ','", "\t": "a tab", ";": "a ';'"}


def table_records(
    path: Path, text: str, is_header: Callable[[list[str]], bool], needed: str
) -> Iterator[Record]:
    """The rows as records by the names of the header, in lower case.

    `is_header` says whether names suffice; `needed` says in words which these are.
    """
    lines = text.split("\n")
    first = next((number for number, line in enumerate(lines) if line.strip()), 0)
    delimiter, names = _header(path, lines[first], first + 1, is_header, needed)
    # The reader wants the newlines back: those inside quotes belong to the caption.
    reader = csv.reader((f"{line}\n" for line in lines[first + 1 :]), delimiter=delimiter, strict=True)
    while True:
        place = f"{path}:{first + 2 + reader.line_num}"  # the line on which the next row starts
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error:
            raise wrong(place, "a quote is not closed before the next column", Form.TABLE) from None
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            raise wrong(
                place,
                f"{len(row)} columns, but the first line names {len(names)}; put a caption that holds "
                f"{_DELIMITERS[delimiter]} in quotes",
                Form.TABLE,
            )
        yield Record(dict(zip(names, row, strict=True)), place, Form.TABLE)


def _header(
    path: Path, line: str, number: int, is_header: Callable[[list[str]], bool], needed: str
) -> tuple[str, list[str]]:
    usual = "\t" if path.suffix.lower() in (".tsv", ".tab") else ","
    for delimiter in dict.fromkeys((usual, *_DELIMITERS)):
        try:
            fields = next(csv.reader([line], delimiter=delimiter))
        except csv.Error:
            continue
        names = [re.sub(r"[\s-]+", "_", field.strip().lower()) for field in fields]
        if is_header(names):
            twice = next((name for name in names if name and names.count(name) > 1), None)
            if twice is not None:
                raise wrong(f"{path}:{number}", f"a second column '{twice}'", Form.TABLE)
            return delimiter, names
    shown = line.strip()[:60]
    raise wrong(f"{path}:{number}", f"the first line must name {needed}, but is '{shown}'", Form.TABLE)
