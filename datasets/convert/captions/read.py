"""Captions that people bring for their clips, in any of six forms that are recognised by themselves.

JSON lines begin with `{`, one object by clips' names does too, a JSON list begins with `[`, and any other
file is CSV or TSV with a header (docs/sources.md). A folder may hold all of these, and .txt files, which are
HumanML3D's where a first line has its grammar. Every error begins with `FILE:LINE`, and what a record says
passes through pydantic.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from pydantic import AliasChoices, ConfigDict, Field, FiniteFloat

from motionloom.datasets.base.config import Config
from motionloom.datasets.base.errors import UserError, nearest
from motionloom.datasets.base.json_doors import parse_json
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.common.files import check_id, read_text_file
from motionloom.datasets.convert.common.splits import ListLine, split_named
from motionloom.datasets.convert.common.tables import DELIMITERS, table_rows

T = TypeVar("T")

SOURCE = "captions"
"""`source` of captions that state none."""
ID_KEYS = ("id", "clip_id", "clip", "name")
FILE_KEYS = ("file", "filename", "file_name", "path")
TEXT_KEYS = ("caption", "text", "description")
"""Keys of captions, in the order of preference; also with an `s` or a number at the end."""

_TEXT = {word: re.compile(rf"{word}s?(?:_?\d+)?") for word in TEXT_KEYS}
_SUFFIX = re.compile(r"\.(?:bvh|amc|npz|npy|pkl|fbx|c3d|glb|txt|json|csv|mp4|wav)$", re.IGNORECASE)
_NUMBER = re.compile(r"\s*(?:nan|[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[-+]?\.\d+)\s*")
_AMASS = re.compile(r"_(?:poses|stageii)$")
CATALOGUE = "<catalogue>"
_RECORD = '{"id": "walk-001", "captions": ["a person walks"]}'


@dataclass(frozen=True)
class CaptionRow:
    """The captions of one clip, with its file and split."""

    id: str
    texts: tuple[Caption, ...]
    file: str | None
    """Its path in the source, where the captions state one."""
    split: Split | None
    where: str
    """`FILE:LINE`, or the file and which of its records."""
    catalogue: bool = False
    """Whether it is from a list of a whole collection, of which a source need not have every clip."""
    origin: str = ""
    """The file, or the folder of .txt files, that it is from."""
    lines: tuple[ListLine, ...] = ()
    """Its records."""


class _Given(Config):
    """Fields of a record beside its captions."""

    model_config = ConfigDict(extra="ignore", coerce_numbers_to_str=True)

    id: str | None = Field(None, validation_alias=AliasChoices(*ID_KEYS))
    file: str | None = Field(None, validation_alias=AliasChoices(*FILE_KEYS))
    split: str | None = None
    start: FiniteFloat = Field(0.0, ge=0)
    end: FiniteFloat | None = None


def bare(name: str) -> str:
    """A clip's name without the suffix of a motion file, with plain slashes."""
    name = name.strip().replace("\\", "/").removeprefix("./")
    return name[: -len(end[0])] if (end := _SUFFIX.search(name)) else name


_PLACE = re.compile(r"(.+?):(\w+=.+)")
_COLUMNS = {"text": TEXT_KEYS, "file": FILE_KEYS, "id": ID_KEYS}
_OTHER_COLUMNS = ("split", "start", "end")


def place_of(given: Path) -> tuple[Path, dict[str, str]]:
    """The file or folder of `takes.csv:text=Beschreibung,file=Datei`, and its columns by what they hold."""
    found = None if given.exists() else _PLACE.fullmatch(str(given))
    if found is None:
        return given, {}
    columns = dict(pair.partition("=")[::2] for pair in found[2].split(","))
    known = [*_COLUMNS, *_OTHER_COLUMNS]
    for key in columns:
        if key not in known:
            raise UserError(f"{given}: no column is '{key}'{nearest(key, known)}")
    return Path(found[1]), {key: _word(column) for key, column in columns.items()}


def row_of(where: str, values: dict[str, object]) -> tuple[CaptionRow, bool]:
    """The row of a record, and whether it holds all captions of its clip (a list) and not one of them."""
    keys = _text_keys(tuple(values))
    values = {key: value for key, value in values.items() if value is not None and str(value).strip()}
    about = _Given.parse(values, where)
    name = about.id or about.file
    if name is None or not keys:
        lacks = "name its clip (id, name or file)" if name is None else "hold a caption or captions"
        raise UserError(f"{where}: the record does not {lacks}; expected the likes of {_RECORD}")
    # A name without a file's suffix is the id, whatever path or tool wrote it.
    clip_id = bare(name)
    if about.id is None and re.match(r"/|[A-Za-z]:/", clip_id):  # only its own machine knows such a path
        clip_id = clip_id.rsplit("/", 1)[-1]
    check_id(clip_id, where)
    is_list = any(isinstance(values.get(key), list) for key in keys)
    shared: dict[str, object] = {"source": SOURCE}
    if not is_list:
        shared |= {"start": about.start, "end": about.end}
    texts = [text for key in keys for text in _captions(f"{where}: '{key}'", values.get(key), shared)]
    stated = split_named(about.split, where) if about.split else None
    file = about.file and about.file.strip().replace("\\", "/").removeprefix("./")
    row = CaptionRow(clip_id, tuple(texts), file, stated, where)
    return row, is_list


def _captions(where: str, value: object, shared: dict[str, object]) -> Iterator[Caption]:
    """The captions under one key that hold words; `shared` holds what the record says of all."""
    for item in value if isinstance(value, list) else [] if value is None else [value]:
        if isinstance(item, Caption):  # read by its grammar already
            yield item
            continue
        caption = Caption.parse(shared | (item if isinstance(item, dict) else {"text": item}), where)
        if not 0 <= caption.start < (float("inf") if caption.end is None else caption.end):
            raise UserError(f"{where}: the caption ends at {caption.end} s and starts at {caption.start:g} s")
        words = " ".join(caption.text.split())
        if words:
            yield caption.model_copy(update={"text": words})


@lru_cache(maxsize=64)
def _text_keys(keys: tuple[str, ...]) -> tuple[str, ...]:
    """The keys that hold captions: of the first word that any key has."""
    found = (tuple(key for key in keys if pattern.fullmatch(key)) for pattern in _TEXT.values())
    return next((keys for keys in found if keys), ())


_MOST_RECORDS = 1000


def joined(before: CaptionRow, row: CaptionRow) -> CaptionRow:
    """One row of two records of the same clip; `UserError` for those beyond `_MOST_RECORDS`."""
    if len(before.lines) >= _MOST_RECORDS:
        raise UserError(f"{row.where}: clip '{row.id}' has {_MOST_RECORDS} records already")
    for what in ("file", "split"):
        old = getattr(before, what)
        new = getattr(row, what)
        apart = what == "file" and before.origin != row.origin  # in each its own way of naming it
        if old is not None and new is not None and old != new and not apart:
            raise UserError(
                f"{row.where}: {what} of clip '{row.id}' is '{new}' here and '{old}' at {before.where}"
            )
    return replace(
        before,
        texts=before.texts + tuple(text for text in row.texts if text not in before.texts),
        file=before.file or row.file,
        split=before.split or row.split,
        catalogue=before.catalogue and row.catalogue,
        lines=before.lines + row.lines,
    )


Records = Iterator[tuple[str, dict[str, object] | UserError]]
"""(place, values) of every record of a file, or what is wrong with it."""


def records_of(path: Path, columns: dict[str, str]) -> Records:
    """The records of a file, whose columns or keys may have names of the user's own."""
    text = read_text_file(path)
    start = text.lstrip()[:1]
    if start == "{" and not columns and (named := _by_name(path, text)) is not None:
        return iter(named)
    if start == "[" or (start and path.suffix.lower() == ".json" and start != "{"):
        values = _decode(str(path), text)
        listed = enumerate(values if isinstance(values, list) else [values], start=1)
        records = ((f"{path}: record {number}", value) for number, value in listed)
        return _each(records, columns, lambda _, value: value)
    if start not in ("{", ""):
        return _of_table(path, text, columns)
    places = ((f"{path}:{n}", line) for n, line in enumerate(text.split("\n"), start=1) if line.strip())
    return _each(places, columns, _decode)


def _word(name: str) -> str:
    """A column's name as it is compared: small letters, `_` for blanks."""
    return re.sub(r"[\s-]+", "_", name.strip().lower())


def _renamed(names: Iterable[str], columns: dict[str, str]) -> list[str]:
    """The keys that columns stand for: what the user names comes before what has our names."""
    keys = {column: "caption" if kind == "text" else kind for kind, column in columns.items()}
    hidden = {key for kind in columns for key in _COLUMNS.get(kind, (kind,))}
    return [keys.get(_word(name)) or (f"({name})" if name in hidden else name) for name in names]


def _by_name(path: Path, text: str) -> list[tuple[str, dict[str, object] | UserError]] | None:
    """The records of one JSON object by the clips' names; None for any other text.

    A name has a caption, a list of them (as text, or as `{text, start, end}`), or, as in KIT-ML's annotations
    of AMASS, `{path, annotations}`. Sentences about mirror images (`M/…`) are of clips that nobody recorded.
    """
    try:
        named = _decode(str(path), text)
    except UserError:
        return None  # JSON lines; or they will say what is wrong
    if not isinstance(named, dict) or _text_keys(tuple(named)) or {*ID_KEYS, *FILE_KEYS} & named.keys():
        return None
    records: list[tuple[str, dict[str, object] | UserError]] = []
    for name, value in named.items():
        where = f"{path}: '{name}'"
        record = {"id": name, CATALOGUE: True}
        if isinstance(value, dict) and {"path", "annotations"} <= value.keys():
            place = str(value["path"])
            value = value["annotations"]
            if place.startswith("M/"):
                continue
            record |= {"id": _AMASS.sub("", place), "file": place}
        if not isinstance(value, str | list):
            wanted = "a caption, a list of captions, or path and annotations"
            records.append((where, UserError(f"{where}: expected {wanted}")))
            continue
        listed = [value] if isinstance(value, str) else value
        kept = [{k: one[k] for k in ("text", "start", "end") if k in one} if isinstance(one, dict) else one
                for one in listed]  # fmt: skip
        records.append((where, {**record, "captions": kept}))
    return records


def _each(
    values: Iterable[tuple[str, T]], columns: dict[str, str], read: Callable[[str, T], object]
) -> Records:
    """The records that `read` makes of values, each with its place."""
    for where, value in values:
        try:
            record = read(where, value)
            if not isinstance(record, dict):
                raise UserError(f"{where}: no record; expected the likes of {_RECORD}")
        except UserError as error:
            yield where, error
            continue
        yield where, dict(zip(_renamed(record, columns), record.values(), strict=True)) if columns else record


def _decode(where: str, text: str) -> object:
    return parse_json(text, where, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key appears twice")
    return found


def text_records(folder: Path, paths: Iterable[Path]) -> Records:
    """A record for each .txt file by its path; all have HumanML3D's grammar if any first line has."""
    texts: dict[Path, list[str]] = {}
    for path in paths:
        try:
            texts[path] = read_text_file(path).split("\n")
        except UserError as error:
            yield str(path), error
    firsts = (next((line for line in lines if line.strip()), "") for lines in texts.values())
    humanml = any(map(_is_humanml, firsts))
    for path, lines in texts.items():
        name = path.relative_to(folder).as_posix().removesuffix(".txt")
        captions: list[Any] = [line for line in lines if line.strip()]
        if humanml:
            captions, problems = read_humanml_captions(path, seconds=None, source=SOURCE)
            for problem in problems:
                where = f"{path}:{problem.removeprefix('line ')}"
                yield where, UserError(f"{where}; expected caption#tokens#start#end")
        yield f"{path}:1", {"id": name, "captions": captions}


def _is_humanml(line: str) -> bool:
    """Whether a line has HumanML3D's grammar: a caption, tokens and two numbers between `#`."""
    fields = line.split("#")
    return len(fields) >= 4 and bool(fields[0]) and all(map(_NUMBER.fullmatch, fields[-2:]))


def _of_table(path: Path, text: str, columns: dict[str, str]) -> Records:
    """The rows by the names of the header, in lower case."""
    lines = text.split("\n")
    first = next(number for number, line in enumerate(lines) if line.strip())
    if re.fullmatch(r"sep=.\s*", lines[first]) and first + 1 < len(
        lines
    ):  # Excel's, which says how it goes on
        first += 1
    delimiter, names = _header(path, lines[first], first + 1, columns)
    for place, row in table_rows(lines[first + 1 :], first + 2, names, delimiter, str(path)):
        yield place, row if isinstance(row, UserError) else {**row}


def _header(path: Path, line: str, number: int, columns: dict[str, str]) -> tuple[str, list[str]]:
    usual = "\t" if path.suffix.lower() in (".tsv", ".tab") else ","
    for delimiter in dict.fromkeys((usual, *DELIMITERS)):
        try:
            fields = next(csv.reader([line], delimiter=delimiter))
        except csv.Error:
            continue
        words = list(map(_word, fields))
        names = _renamed(words, columns) if set(columns.values()) <= set(words) else []
        if _text_keys(tuple(names)) and set(names) & {*ID_KEYS, *FILE_KEYS}:
            twice = next((name for name in names if name and names.count(name) > 1), None)
            if twice is not None:
                raise UserError(f"{path}:{number}: a second column '{twice}'")
            return delimiter, names
    raise UserError(
        f"{path}:{number}: the first line must name a column for the clip "
        f"({', '.join((*ID_KEYS, *FILE_KEYS))}) and one for the caption ({', '.join(TEXT_KEYS)}), but is "
        f"'{line.strip()[:60]}'; others are named behind the file: {path.name}:text=COLUMN,file=COLUMN"
    )
