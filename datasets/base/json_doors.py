"""The doors for files of others: plain files of a bounded size, JSON of finite numbers, numbers in bounds."""

from __future__ import annotations

import json
import math
import re
import stat
from pathlib import Path
from typing import Any, BinaryIO

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.os_errors import naming

MOST_JSON_BYTES = 2**28
"""Larger JSON files are refused unread: the manifest of a million clips has a few megabytes."""


def read_plain(path: Path, most: int = MOST_JSON_BYTES, name: str = "") -> bytes:
    """Content of a plain file of at most `most` bytes; `UserError` for anything else, such as a device or a
    pipe, which would be read without end. `FileNotFoundError` when there is none. Errors name it by its path,
    or by `name`.
    """
    size = require_plain(path, name)
    if size > most:
        raise UserError(f"{name or path}: {size:,} bytes; at most {most:,} are read")
    with naming(name or path):
        return path.read_bytes()


def open_plain(path: Path, name: str = "") -> BinaryIO:
    """Open a file of others for reading; `UserError` at once for what `require_plain` refuses."""
    require_plain(path, name)
    return path.open("rb")


def require_plain(path: Path, name: str = "") -> int:
    """Bytes of a plain file; `UserError` for a device or a pipe, which would be waited for without end."""
    try:
        about = path.stat()
    except ValueError:  # a zero byte, in a name that another file says
        raise UserError(f"{name or ascii(str(path))}: no file can have this name") from None
    if not stat.S_ISREG(about.st_mode):
        raise UserError(f"{name or path}: not a plain file")
    return about.st_size


_HALF_LETTER = re.compile(r"\\u[dD][89a-fA-F]")
"""Begins the escape of a surrogate, which with another makes a letter."""


def parse_json(raw: str | bytes, where: str, **how: Any) -> Any:
    """Return JSON decoded, with `how` as for `json.loads`; `UserError` beginning with `where` otherwise.

    All JSON from outside comes through here: numbers are finite, whole ones of 64 bits, and no text holds
    half of a letter, which nothing can be written with. `RecursionError` bounds the depth. Figures of ours
    may be NaN: `parse_constant=float` lets them.
    """
    try:
        text = raw.decode() if isinstance(raw, bytes) else raw
        found = json.JSONDecoder(**_RULES | how).decode(text) if how else _DECODER.decode(text)
        (json.dumps(found, ensure_ascii=False) if _HALF_LETTER.search(text) else text).encode()
    except UnicodeEncodeError:
        raise UserError(f"{where}: not valid JSON (half of a letter, a lone surrogate)") from None
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}: not valid JSON ({error or 'too deep'})") from None
    return found


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"{text:.20} is not a finite number")
    return value


def _of_64_bits(text: str) -> int:
    if len(text) > 20 or not -(2**63) <= (value := int(text)) < 2**63:
        raise ValueError(f"{text:.20} is beyond 64 bits")
    return value


_RULES: dict[str, Any] = {"parse_float": _finite, "parse_int": _of_64_bits, "parse_constant": _finite}
_DECODER = json.JSONDecoder(**_RULES)
"""Made once: for a caption, making one takes as long as decoding it."""
MOST = 1e9
"""No count of frames and no time in seconds is larger."""


def number(value: object, where: str, most: float = MOST, least: float = 0) -> float:
    """Return the number of a field; a `UserError` begins with `where`, also beyond `least` to `most`."""
    try:
        plain = not isinstance(value, str) or (value.isascii() and "_" not in value)
        found = float(value) if plain and isinstance(value, str | int | float) else math.nan
    except (ValueError, OverflowError):
        found = math.nan
    if not least <= found <= most:
        raise UserError(f"{where}: '{value!s:.20}' is no number from {least:g} to {most:g}")
    return found


def whole(value: object, where: str, most: float = MOST, least: float = 0) -> int:
    """The same of a whole number, such as one of frames."""
    if (found := number(value, where, most, least)) % 1:
        raise UserError(f"{where}: '{value!s:.20}' is no whole number")
    return int(found)
