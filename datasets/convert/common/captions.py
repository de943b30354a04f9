"""`captions.jsonl`: one JSON object a line: id, captions and, where known, file, split, frame rate."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pydantic import BaseModel, ConfigDict, ValidationError

from motionloom.datasets.convert.common.splits import check_id
from motionloom.datasets.schema import Caption, Split, UserError, explain


class CaptionRow(BaseModel):
    """One line; keys beyond these are the source's own business and ignored."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    id: str
    captions: list[str | Caption]
    file: str | None = None
    archive: str | None = None
    split: Split | None = None
    fps: float | None = None

    def texts(self, source: str) -> tuple[Caption, ...]:
        """The captions that hold text."""
        made = [c if isinstance(c, Caption) else Caption(text=c, source=source) for c in self.captions]
        stripped = [c.model_copy(update={"text": " ".join(c.text.split())}) for c in made]
        return tuple(c for c in stripped if c.text)


@dataclass(frozen=True)
class CaptionTable:
    """All rows by id, and the ways a file of the source finds its row."""

    rows: dict[str, CaptionRow]
    keys: dict[str, str]
    """Id by: `file`, id, and the bare name of `file` where only one row has it."""

    def find(self, path: str) -> CaptionRow | None:
        """The row of a motion file: by its path in the source, its path without suffix, or its bare name."""
        pure = PurePosixPath(path)
        for key in (path, pure.with_suffix("").as_posix(), pure.stem):
            if key in self.keys:
                return self.rows[self.keys[key]]
        return None


def read_captions(path: Path) -> CaptionTable:
    """Read the file; `UserError` names the line of anything malformed and of an id or file seen before."""
    rows: dict[str, CaptionRow] = {}
    files: dict[str, str] = {}
    try:
        lines = path.read_bytes().removeprefix(b"\xef\xbb\xbf").splitlines()
    except OSError as error:
        raise UserError(f"{path}: cannot read the captions ({error.strerror})") from None
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        where = f"{path}:{number}"
        try:
            row = CaptionRow.model_validate(json.loads(line))
        except ValidationError as error:
            raise UserError(explain(error, CaptionRow, where)) from None
        except ValueError as error:
            raise UserError(f"{where}: not valid JSON ({error})") from None
        check_id(row.id, where)
        if row.id in rows:
            raise UserError(f"{where}: clip id '{row.id}' has a line already; keep one line a clip")
        if row.file and files.setdefault(row.file, row.id) != row.id:
            raise UserError(f"{where}: file '{row.file}' has a line already ('{files[row.file]}')")
        rows[row.id] = row
    stems = Counter(PurePosixPath(file).stem for file in files)
    keys = {stem: row for file, row in files.items() if stems[stem := PurePosixPath(file).stem] == 1}
    return CaptionTable(rows, {**keys, **{clip_id: clip_id for clip_id in rows}, **files})
