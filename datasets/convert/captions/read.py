"""Captions that people bring for their clips, in any of six forms that are recognised by themselves.

JSON lines begin with `{`, one object by clips' names does too, a JSON list begins with `[`, a folder of .txt
files is HumanML3D's where a first line has its grammar, and any other file is CSV or TSV with a header
(docs/sources.md). Every error begins with `FILE:LINE`, and what a record says passes through pydantic.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from pydantic import AliasChoices, ConfigDict, Field, FiniteFloat

from motionloom.datasets.convert.captions.humanml_text import parse_caption
from motionloom.datasets.convert.common.files import check_id, read_text_file
from motionloom.datasets.convert.common.splits import split_named
from motionloom.datasets.schema import Caption, Config, Split, UserError, parse_json

SOURCE = "captions"
"""`source` of captions that state none."""
ID_KEYS = ("id", "clip_id", "clip", "name")
FILE_KEYS = ("file", "filename", "file_name", "path")
TEXT_KEYS = ("caption", "text", "description")
"""Keys of captions, in the order of preference; also with an `s` or a number at the end."""

_TEXT = {word: re.compile(rf"{word}s?(?:_?\d+)?") for word in TEXT_KEYS}
_SUFFIX = re.compile(r"\.(?:bvh|amc|npz|npy|pkl|fbx|c3d|glb|txt|json|csv|mp4|wav)$", re.IGNORECASE)
_NUMBER = r"\s*(?:nan|[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[-+]?\.\d+)\s*"
_HUMANML = re.compile(rf"[^#].*#.*#{_NUMBER}#{_NUMBER}")
_AMASS = re.compile(r"_(?:poses|stageii)$")
_DELIMITERS = {",": "a ','", "\t": "a tab", ";": "a ';'"}
_CATALOGUE = "<catalogue>"
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


def read_captions(path: Path) -> dict[str, CaptionRow]:
    """The rows of a file or folder by clip id; `UserError` names file and line of anything malformed."""
    rows, files = dict[str, CaptionRow](), dict[str, str]()
    # Two records of one clip are joined if each holds one caption, and a mistake if they hold whole lists.
    for where, values in _records(path):
        catalogue = bool(values.pop(_CATALOGUE, False))
        row, is_list = _row(where, values)
        row = replace(row, catalogue=catalogue)
        before = rows.get(row.id)
        if row.file and files.setdefault(row.file, row.id) != row.id:
            raise UserError(f"{where}: file '{row.file}' has a record already ('{files[row.file]}')")
        if before is not None and is_list and not catalogue:
            raise UserError(f"{where}: clip id '{row.id}' has a record already ({before.where})")
        rows[row.id] = row if before is None else joined(before, row)
    if not rows:
        raise UserError(f"{path}: no captions in it")
    return rows


def _row(where: str, values: dict[str, object]) -> tuple[CaptionRow, bool]:
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
        if any("\ud800" <= letter <= "\udfff" for letter in words):
            raise UserError(f"{where} holds half a character (\\ud800 to \\udfff)")
        if words:
            yield caption.model_copy(update={"text": words})


@lru_cache(maxsize=64)
def _text_keys(keys: tuple[str, ...]) -> tuple[str, ...]:
    """The keys that hold captions: of the first word that any key has."""
    found = (tuple(key for key in keys if pattern.fullmatch(key)) for pattern in _TEXT.values())
    return next((keys for keys in found if keys), ())


def joined(before: CaptionRow, row: CaptionRow) -> CaptionRow:
    """One row of two records of the same clip."""
    for what in ("file", "split"):
        old, new = getattr(before, what), getattr(row, what)
        if old is not None and new is not None and old != new:
            raise UserError(
                f"{row.where}: {what} of clip '{row.id}' is '{new}' here and '{old}' at {before.where}"
            )
    return replace(
        before,
        texts=before.texts + tuple(text for text in row.texts if text not in before.texts),
        file=before.file or row.file,
        split=before.split or row.split,
    )


def _records(path: Path) -> Iterator[tuple[str, dict[str, object]]]:
    """(place, values) of every record of a file or folder."""
    if path.is_dir():
        return _of_folder(path)
    text = read_text_file(path)
    start = text.lstrip()[:1]
    if start == "{" and (named := _by_name(path, text)) is not None:
        return iter(named)
    if start == "[" or (start and path.suffix.lower() == ".json" and start != "{"):
        values = _decode(str(path), text)
        listed = enumerate(values if isinstance(values, list) else [values], start=1)
        return (_record(f"{path}: record {number}", value) for number, value in listed)
    if start not in ("{", ""):
        return _of_table(path, text)
    places = ((f"{path}:{n}", line) for n, line in enumerate(text.split("\n"), start=1) if line.strip())
    return (_record(place, _decode(place, line)) for place, line in places)


def _by_name(path: Path, text: str) -> list[tuple[str, dict[str, object]]] | None:
    """The records of one JSON object by the clips' names; None for any other text.

    A name has a caption, a list of them (as text, or as `{text, start, end}`), or, as in KIT-ML's annotations
    of AMASS, `{path, annotations}`. Sentences about mirror images (`M/…`) are of clips that nobody recorded.
    """
    try:
        named = json.loads(text, object_pairs_hook=_without_repeats)
    except (ValueError, RecursionError):
        return None  # JSON lines; or they will say what is wrong
    if not isinstance(named, dict) or _text_keys(tuple(named)) or {*ID_KEYS, *FILE_KEYS} & named.keys():
        return None
    records: list[tuple[str, dict[str, object]]] = []
    for name, value in named.items():
        where, record = f"{path}: '{name}'", {"id": name, _CATALOGUE: True}
        if isinstance(value, dict) and {"path", "annotations"} <= value.keys():
            place, value = str(value["path"]), value["annotations"]
            if place.startswith("M/"):
                continue
            record |= {"id": _AMASS.sub("", place), "file": place}
        if not isinstance(value, str | list):
            raise UserError(f"{where}: expected a caption, a list of captions, or path and annotations")
        listed = [value] if isinstance(value, str) else value
        kept = [{k: one[k] for k in ("text", "start", "end") if k in one} if isinstance(one, dict) else one
                for one in listed]  # fmt: skip
        records.append((where, {**record, "captions": kept}))
    return records


def _record(where: str, value: object) -> tuple[str, dict[str, object]]:
    if not isinstance(value, dict):
        raise UserError(f"{where}: no record; expected the likes of {_RECORD}")
    return where, value


def _decode(where: str, text: str) -> object:
    return parse_json(text, where, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key appears twice")
    return found


def _of_folder(folder: Path) -> Iterator[tuple[str, dict[str, object]]]:
    """A record for each file, named by its path without `.txt`.

    The folder is in HumanML3D's grammar when the first line of any file is: then all lines must be.
    """
    catalogues = [
        found
        for path in sorted(folder.glob("*.json"))
        for found in _by_name(path, read_text_file(path)) or ()
    ]
    if catalogues:
        yield from catalogues
        return
    paths = sorted(p for p in folder.rglob("*.txt") if p.is_file() and not p.name.startswith("."))
    if not paths:
        raise UserError(f"{folder}: no .txt file in it; expected one caption a line in FOLDER/CLIP.txt")
    texts = {path: read_text_file(path).split("\n") for path in paths}
    firsts = (next((line for line in lines if line.strip()), "") for lines in texts.values())
    humanml = any(_HUMANML.fullmatch(line) for line in firsts)
    for path, lines in texts.items():
        name = path.relative_to(folder).as_posix().removesuffix(".txt")
        captions = _humanml(path, lines) if humanml else [line for line in lines if line.strip()]
        yield f"{path}:1", {"id": name, "captions": captions}


def _humanml(path: Path, lines: Iterable[str]) -> list[Caption]:
    captions = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                captions.append(parse_caption(line, seconds=None, source=SOURCE))
            except UserError as error:
                raise UserError(f"{path}:{number}: {error}; expected caption#tokens#start#end") from None
    return captions


def _of_table(path: Path, text: str) -> Iterator[tuple[str, dict[str, object]]]:
    """The rows by the names of the header, in lower case."""
    lines = text.split("\n")
    first = next(number for number, line in enumerate(lines) if line.strip())
    delimiter, names = _header(path, lines[first], first + 1)
    # The reader wants the newlines back: those inside quotes belong to the caption.
    reader = csv.reader((f"{line}\n" for line in lines[first + 1 :]), delimiter=delimiter, strict=True)
    while True:
        place = f"{path}:{first + 2 + reader.line_num}"  # the line on which the next row starts
        try:
            row = next(reader)
        except StopIteration:
            return
        except csv.Error:
            raise UserError(f"{place}: a quote is not closed before the next column") from None
        if not any(field.strip() for field in row):
            continue
        if len(row) != len(names):
            raise UserError(
                f"{place}: {len(row)} columns, but the first line names {len(names)} ({', '.join(names)}); "
                f"put a caption that holds {_DELIMITERS[delimiter]} in quotes"
            )
        yield place, dict(zip(names, row, strict=True))


def _header(path: Path, line: str, number: int) -> tuple[str, list[str]]:
    usual = "\t" if path.suffix.lower() in (".tsv", ".tab") else ","
    for delimiter in dict.fromkeys((usual, *_DELIMITERS)):
        try:
            fields = next(csv.reader([line], delimiter=delimiter))
        except csv.Error:
            continue
        names = [re.sub(r"[\s-]+", "_", field.strip().lower()) for field in fields]
        if _text_keys(tuple(names)) and set(names) & {*ID_KEYS, *FILE_KEYS}:
            twice = next((name for name in names if name and names.count(name) > 1), None)
            if twice is not None:
                raise UserError(f"{path}:{number}: a second column '{twice}'")
            return delimiter, names
    raise UserError(
        f"{path}:{number}: the first line must name a column for the clip "
        f"({', '.join((*ID_KEYS, *FILE_KEYS))}) and one for the caption ({', '.join(TEXT_KEYS)}), but is "
        f"'{line.strip()[:60]}'"
    )
