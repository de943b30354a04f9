"""Captions that people bring for their clips, in any of six forms that are recognised by themselves.

| form | by |
|---|---|
| one JSON object a line | `.jsonl`, `.ndjson`, or several objects in one file |
| a JSON list of such objects | `[` |
| one JSON object, name -> caption(s) | `{` |
| CSV, TSV with a header | anything else that is a file |
| a folder of .txt files with the clips' names, a caption a line | a folder |
| the same with HumanML3D's lines `caption#tokens#start#end` | the first lines |
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from motionloom.datasets.convert.captions.forms import (
    Record,
    folder_records,
    json_records,
    kind_of,
    read_text,
    table_records,
)
from motionloom.datasets.convert.common.files import check_id
from motionloom.datasets.convert.common.splits import SplitNames
from motionloom.datasets.schema import Caption, Split, UserError

SOURCE = "captions"
"""`source` of captions that state none."""
ID_KEYS = ("id", "clip_id", "clip", "name")
FILE_KEYS = ("file", "filename", "file_name", "path")
TEXT_KEYS = ("caption", "text", "description")
"""What a caption's key may be called, in the order of preference; also with an `s` or a number at the end."""

_TEXT = {word: re.compile(rf"{word}s?(?:_?\d+)?") for word in TEXT_KEYS}
_SUFFIX = re.compile(r"\.(?:bvh|npz|npy|pkl|fbx|c3d|glb|txt|json|csv|mp4|wav)$", re.IGNORECASE)
NEEDED = (
    f"a column for the clip ({', '.join((*ID_KEYS, *FILE_KEYS))}) and one for the caption "
    f"({', '.join(TEXT_KEYS)})"
)


Times = tuple[float, float | None]
"""Start and end of a caption in seconds; end None is the clip's."""


@dataclass(frozen=True)
class CaptionRow:
    """What is said about one clip."""

    id: str
    texts: tuple[Caption, ...]
    file: str | None
    """Its path in the source, where the captions state one."""
    split: Split | None
    left_out: bool
    """The clip is in a split that is not wanted."""
    fps: float | None
    record: Record
    """What it was made of; knows where it stands."""

    def names(self) -> tuple[str, ...]:
        """What the clip is called, without suffix; the file first."""
        return tuple(dict.fromkeys(bare(name) for name in (self.file, self.id) if name))


def bare(name: str) -> str:
    """A clip's name without the suffix of a motion file, with plain slashes."""
    name = name.strip().replace("\\", "/").removeprefix("./")
    return name[: -len(end[0])] if (end := _SUFFIX.search(name)) else name


def is_record(values: dict[str, object]) -> bool:
    """Whether the keys name a clip and its captions."""
    return any(key in values for key in (*ID_KEYS, *FILE_KEYS)) and bool(_text_keys(values))


def _text_keys(values: Iterable[str]) -> tuple[str, ...]:
    """The keys that hold captions: of the first word that any key has."""
    return _captions_among(tuple(values))


@lru_cache(maxsize=64)
def _captions_among(values: tuple[str, ...]) -> tuple[str, ...]:
    for pattern in _TEXT.values():
        if keys := tuple(key for key in values if pattern.fullmatch(key)):
            return keys
    return ()


def row_of(record: Record, splits: SplitNames) -> tuple[CaptionRow, bool]:
    """The row of a record, and whether it holds all captions of its clip (a list) and not one of them."""
    values = record.values
    given, file = _name(record, ID_KEYS), _name(record, FILE_KEYS)
    keys = _text_keys(values)
    if given is None and file is None:
        raise record.wrong("the record does not name its clip ('id', 'name' or 'file')")
    if not keys:
        raise record.wrong("the record has no 'caption' and no 'captions'")
    clip_id = bare(given) if given is not None else _id_of(file or "")
    try:
        check_id(clip_id, "")
    except UserError as error:
        raise record.wrong(str(error).removeprefix(": ")) from None
    is_list = any(isinstance(values[key], list) for key in keys)
    times = (0.0, None) if is_list else _times(record, values)
    texts = tuple(text for key in keys for text in _captions(record, key, times))
    split = values.get("split")
    if split is not None and not isinstance(split, str):
        raise record.wrong(f"'split' is {kind_of(split)}, not a text")
    choice = splits.of(split, lambda: record.where) if split and split.strip() else None
    fps = _number(record, values, "fps")
    stated = None if choice == "drop" else choice
    return CaptionRow(clip_id, texts, file, stated, choice == "drop", fps, record), is_list


def _id_of(file: str) -> str:
    """The id of a clip that only its file names: the path without suffix, or an absolute path's last name."""
    name = bare(file)
    return name.rsplit("/", 1)[-1] if name.startswith("/") or re.match(r"[A-Za-z]:/", name) else name


def _name(record: Record, keys: tuple[str, ...]) -> str | None:
    for key in keys:
        value = record.values.get(key)
        if isinstance(value, int) and not isinstance(value, bool):
            value = str(value)
        if value is None:
            continue
        if not isinstance(value, str) or not value.strip():
            shown = "empty" if value == "" or isinstance(value, str) else kind_of(value)
            raise record.wrong(f"'{key}' is {shown}, not the name of a clip")
        return value.strip().replace("\\", "/").removeprefix("./")
    return None


def _captions(record: Record, key: str, times: Times) -> list[Caption]:
    """The captions that hold words under one key; `times` are those of a bare text."""
    value = record.values[key]
    made = []
    for item in value if isinstance(value, list) else [] if value is None else [value]:
        if isinstance(item, Caption):  # read by its grammar already, and clean
            made.append(item)
            continue
        if isinstance(item, str):
            given: dict[str, object] = {"text": item, "start": times[0], "end": times[1], "source": SOURCE}
        elif isinstance(item, dict):
            given = _caption_object(record, key, item)
        else:
            raise record.wrong(f"'{key}' holds {kind_of(item)} where a text belongs")
        words = " ".join(str(given["text"]).split())
        try:
            words.encode("utf-8")
        except UnicodeEncodeError:
            raise record.wrong(f"'{key}' holds half a character (\\ud800 to \\udfff)") from None
        if words:
            made.append(Caption(**given | {"text": words}))
    return made


def _caption_object(record: Record, key: str, item: dict[str, object]) -> dict[str, object]:
    known = ("text", "caption", "start", "end", "source", "tokens")
    extra = sorted(set(item) - set(known))
    text = item.get("text", item.get("caption"))
    if extra:
        raise record.wrong(f"a caption has the unknown key '{extra[0]}' (known: {', '.join(known)})")
    if not isinstance(text, str):
        raise record.wrong("a caption has no 'text'")
    tokens, source = item.get("tokens"), item.get("source", SOURCE)
    if not (tokens is None or (isinstance(tokens, list) and all(isinstance(token, str) for token in tokens))):
        raise record.wrong("'tokens' is not a list of texts")
    if not isinstance(source, str):
        raise record.wrong(f"'source' is {kind_of(source)}, not a text")
    start, end = _times(record, item)
    return {"text": text, "start": start, "end": end, "source": source, "tokens": tokens}


def _times(record: Record, values: dict[str, object]) -> Times:
    start = _number(record, values, "start") or 0.0
    end = _number(record, values, "end")
    if start < 0 or (end is not None and end <= start):
        raise record.wrong(f"the caption ends at {end} s and starts at {start:g} s")
    return start, end


def _number(record: Record, values: dict[str, object], key: str) -> float | None:
    value = values.get(key)
    if value is None or (isinstance(value, str) and not value.strip()):
        return None
    try:
        number = (
            float(value) if isinstance(value, (str, int, float)) and not isinstance(value, bool) else math.nan
        )
    except (ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        shown = f"'{value[:20]}'" if isinstance(value, str) else kind_of(value)
        raise record.wrong(f"'{key}' is {shown}, not a number")
    return number


def joined(before: CaptionRow, row: CaptionRow, record: Record) -> CaptionRow:
    """One row of two records that hold a caption each of the same clip."""
    for what in ("file", "split", "fps"):
        old, new = getattr(before, what), getattr(row, what)
        if old is not None and new is not None and old != new:
            there = before.record.where
            raise record.wrong(f"{what} of clip '{row.id}' is '{new}' here and '{old}' at {there}")
    return replace(
        before,
        texts=before.texts + tuple(text for text in row.texts if text not in before.texts),
        file=before.file or row.file,
        split=before.split or row.split,
        left_out=before.left_out or row.left_out,
        fps=before.fps or row.fps,
    )


def read_captions(path: Path, splits: SplitNames | None = None) -> dict[str, CaptionRow]:
    """The rows of a file or folder by clip id; `UserError` names file, line and column of anything malformed.

    `splits` says what other names of splits mean.
    """
    if not path.exists():
        raise UserError(f"{path}: cannot read the captions (no such file or folder)")
    names, rows, files = splits or SplitNames(), dict[str, CaptionRow](), dict[str, str]()
    lists: set[str] = set()
    for record in _records(path):
        row, is_list = row_of(record, names)
        before = rows.get(row.id)
        if row.file and files.setdefault(row.file, row.id) != row.id:
            raise record.wrong(f"file '{row.file}' has a record already ('{files[row.file]}')")
        if before is None:
            rows[row.id] = row
        elif is_list or row.id in lists:
            there = before.record.where
            what = f"clip id '{row.id}' has a line already ({there}); keep all its captions in one record"
            raise record.wrong(what)
        else:
            rows[row.id] = joined(before, row, record)
        if is_list:
            lists.add(row.id)
    if not rows:
        raise UserError(f"{path}: no captions in it")
    names.require_known()
    return rows


def _records(path: Path) -> Iterator[Record]:
    if path.is_dir():
        return folder_records(path)
    text = read_text(path)
    start = text.lstrip()[:1]
    if not start:
        return iter(())
    if start in "[{" or path.suffix.lower() in (".jsonl", ".ndjson", ".json"):
        return json_records(path, text, is_record)
    return table_records(path, text, lambda header: is_record(dict.fromkeys(header)), NEEDED)
