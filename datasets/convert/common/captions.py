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

from collections.abc import Iterator
from pathlib import Path

from motionloom.datasets.convert.common.caption_folder import folder_records
from motionloom.datasets.convert.common.caption_json import json_form, json_records
from motionloom.datasets.convert.common.caption_row import NEEDED, CaptionRow, is_record, joined, row_of
from motionloom.datasets.convert.common.caption_table import table_records
from motionloom.datasets.convert.common.caption_text import Record, read_text
from motionloom.datasets.convert.common.splits import SplitNames
from motionloom.datasets.schema import UserError


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
            raise record.wrong(None, f"file '{row.file}' has a record already ('{files[row.file]}')")
        if before is None:
            rows[row.id] = row
        elif is_list or row.id in lists:
            there = before.record.at(None)
            what = f"clip id '{row.id}' has a line already ({there}); keep all its captions in one record"
            raise record.wrong(None, what)
        else:
            rows[row.id] = joined(before, row, record)
        if is_list:
            lists.add(row.id)
    if not rows:
        raise UserError(f"{path}: no captions in it")
    names.require_known()
    return rows


def _records(path: Path) -> Iterator[Record]:
    """The records of a file or folder, whatever its form."""
    if path.is_dir():
        return folder_records(path)
    text = read_text(path)
    start = text.lstrip()[:1]
    if not start:
        return iter(())
    if start in "[{" or path.suffix.lower() in (".jsonl", ".ndjson", ".json"):
        return json_records(path, text, json_form(path, text, is_record))
    return table_records(path, text, lambda header: is_record(dict.fromkeys(header)), NEEDED)
