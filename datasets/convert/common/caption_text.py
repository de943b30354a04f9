"""Files of captions as text: how they are decoded, where something stands in them, what a form expects.

Every error about such a file reads `FILE:LINE:COLUMN: what is wrong; expected the form`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from motionloom.datasets.schema import UserError


class Form(Enum):
    """The forms of captions that are understood; a value says in one phrase what the form looks like."""

    LINES = 'one JSON object a line: {"id": "walk-001", "captions": ["a person walks"]}'
    LIST = 'a JSON list of records: [{"id": "walk-001", "captions": ["a person walks"]}, ...]'
    OBJECT = 'one JSON object of names and captions: {"walk-001": ["a person walks"], ...}'
    TABLE = "CSV or TSV whose first line names the columns, such as: name,caption"
    PLAIN = "one caption a line in FOLDER/CLIP.txt"
    HUMANML = "HumanML3D's lines caption#tokens#start#end: a person walks#a/DET person/NOUN walk/VERB#0.0#0.0"


def wrong(place: str, what: str, form: Form) -> UserError:
    """The error about `place` (`FILE:LINE:COLUMN`)."""
    return UserError(f"{place}: {what}; expected {form.value}")


@dataclass(frozen=True)
class Record:
    """What a file says about one clip, not yet looked at."""

    values: dict[str, Any]
    at: Callable[[str | None], str]
    """`FILE:LINE:COLUMN` of a key's value; of the record for None and for keys that it lacks."""
    form: Form

    def wrong(self, key: str | None, what: str) -> UserError:
        """The error about a value of this record."""
        return wrong(self.at(key), what, self.form)


def read_text(path: Path) -> str:
    """The text of a UTF-8 file with plain newlines; `UserError` names line and column of any other byte."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot read the captions ({error.strerror})") from None
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise UserError(f"{path}:1:1: UTF-16 text; save the file as UTF-8")
    if raw.startswith((b"PK\x03\x04", b"PAR1", b"\x1f\x8b")):
        raise UserError(f"{path}: not a text file; save the captions as CSV or JSON")
    raw = raw.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        before = raw[: error.start].decode("utf-8")
        byte = raw[error.start]
        meant = bytes([byte]).decode("cp1252", "replace")
        hint = f" (as Latin-1 it would be '{meant}')" if meant.isprintable() and meant != "\ufffd" else ""
        place = place_of(path, before, len(before))
        raise UserError(f"{place}: byte 0x{byte:02x} is not UTF-8{hint}; save the file as UTF-8") from None


def place_of(path: Path, text: str, offset: int) -> str:
    """`FILE:LINE:COLUMN` of a character of the text, both counted from 1."""
    before = text.rfind("\n", 0, offset)
    return f"{path}:{text.count(chr(10), 0, offset) + 1}:{offset - before}"
