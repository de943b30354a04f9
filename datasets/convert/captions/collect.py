"""Captions of several files and folders at once, and the files of a folder that hold any."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.convert.captions.read import (
    CATALOGUE,
    CaptionRow,
    Records,
    joined,
    place_of,
    records_of,
    row_of,
    text_records,
)
from motionloom.datasets.convert.common.files import walk_files
from motionloom.datasets.convert.common.splits import ListLine

TABLES = (".csv", ".tsv", ".tab", ".jsonl", ".json")


@dataclass(frozen=True)
class Captions:
    """Captions of several files and folders; a clip that several name has the captions of all."""

    rows: dict[str, CaptionRow] = field(default_factory=dict)
    """By clip id."""
    used: set[str] = field(default_factory=set)
    """Absolute paths of the files that hold them."""
    others: list[Path] = field(default_factory=list)
    """Tables in the folders that hold none."""
    bad: list[str] = field(default_factory=list)
    """A sentence for each record that cannot be read, with file and line."""

    @classmethod
    def read(cls, places: Iterable[Path]) -> Captions:
        """Read files and folders; a bad record is none, a file without any good one a `UserError`."""
        captions = cls()
        for place in places:
            path, columns = place_of(place)
            if path.is_dir():
                captions._add_folder(path, columns)
            else:
                captions._add(path, records_of(path, columns), [path])
        return captions

    def _add_folder(self, folder: Path, columns: dict[str, str]) -> None:
        before = len(self.used)
        texts, tables = caption_files(folder)
        if texts:
            self._add(folder, text_records(folder, texts), texts)
        for table in tables:
            if holds_captions(table, columns):
                self._add(table, records_of(table, columns), [table])
            else:
                self.others.append(table)
        if len(self.used) == before:
            raise UserError(
                f"{folder}: no .txt file and no table of captions in it; expected one caption a line in "
                f"FOLDER/CLIP.txt, or CSV or JSON"
            )

    def _add(self, origin: Path, records: Records, files: Iterable[Path]) -> None:
        named: dict[str, str] = {}
        bad: list[str] = []
        for where, values in records:
            try:
                if isinstance(values, UserError):
                    raise values
                self._add_record(where, values, str(origin), named)
            except UserError as error:
                bad.append(str(error))
        if not named:
            raise UserError(bad[0] if bad else f"{origin}: no captions in it")
        self.bad.extend(bad)
        self.used.update(str(path.absolute()) for path in files)

    def _add_record(self, where: str, values: dict[str, object], origin: str, named: dict[str, str]) -> None:
        catalogue = bool(values.pop(CATALOGUE, False))
        row, is_list = row_of(where, values)
        words = frozenset(text.text for text in row.texts)
        line = ListLine(where.rsplit("/", 1)[-1], row.id, "", words, catalogue)
        row = replace(row, catalogue=catalogue, origin=origin, lines=(line,))
        if row.file and named.get(row.file, row.id) != row.id:
            raise UserError(f"{where}: file '{row.file}' has a record already ('{named[row.file]}')")
        before = self.rows.get(row.id)
        # Records of one clip are joined, but two lists of all its captions in one file are a mistake.
        if before is not None and before.origin == row.origin and is_list and not catalogue:
            raise UserError(f"{where}: clip id '{row.id}' has a record already ({before.where})")
        self.rows[row.id] = row if before is None else joined(before, row)
        named |= dict.fromkeys(filter(None, (row.file, row.id)), row.id)


def caption_files(folder: Path) -> tuple[list[Path], list[Path]]:
    """The .txt files in a folder, and the files that may hold tables."""
    paths = [folder / name for name in walk_files(folder) if not PurePosixPath(name).name.startswith(".")]
    texts = [path for path in paths if path.suffix.lower() == ".txt"]
    return texts, [path for path in paths if path.suffix.lower() in TABLES]


def holds_captions(table: Path, columns: dict[str, str]) -> bool:
    """Whether the first record of a file is one of captions."""
    try:
        where, values = next(records_of(table, columns))
        return not isinstance(values, UserError) and bool(row_of(where, values))
    except (UserError, StopIteration):
        return False
