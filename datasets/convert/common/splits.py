"""Splits of a source: its own split files, else 80/5/15 by a hash of the id."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal

from motionloom.datasets.convert.common.files import check_id, read_text_file
from motionloom.datasets.schema import SPLITS, Split, UserError

TRAIN_SHARE, VAL_SHARE = 0.80, 0.05
"""80/5/15, the split of HumanML3D and Motion-X, where a source brings none."""

_SYNONYMS: dict[str, Split] = {
    "train": "train",
    "training": "train",
    "val": "val",
    "valid": "val",
    "validation": "val",
    "dev": "val",
    "development": "val",
    "test": "test",
    "testing": "test",
}

_MIRRORED = re.compile(r"((?:.*/)?)M(\d+)")


class SplitNames:
    """Names of splits: ours and their usual synonyms, and others by a mapping.

    The mapping is `NAME=SPLIT,...` with `train`, `val`, `test`, `drop` (leave such clips out) or `ignore` (as
    if no split were stated) for SPLIT; `ignore` or `drop` alone is for all other names.
    """

    def __init__(self, mapping: str = "") -> None:
        """`ValueError` when the mapping cannot be read."""
        self._known: dict[str, Split | Literal["drop"] | None] = dict(_SYNONYMS)
        self._others: Literal["drop", "ignore"] | None = None
        self._unknown: dict[str, int] = {}
        self._first = ""
        for word in filter(None, (word.strip() for word in mapping.split(","))):
            name, equals, meaning = (piece.strip() for piece in word.partition("="))
            if not equals and name in ("drop", "ignore"):
                self._others = "drop" if name == "drop" else "ignore"
            elif name and meaning in (*SPLITS, "drop", "ignore"):
                self._known[name.lower()] = None if meaning == "ignore" else meaning  # type: ignore[assignment]
            else:
                raise ValueError(
                    f"'{word}' is not NAME=SPLIT with {', '.join(SPLITS)}, drop or ignore for SPLIT "
                    f"(such as fold1=train,extra=drop), and not drop or ignore alone"
                )

    def of(self, name: str, place: Callable[[], str]) -> Split | Literal["drop"] | None:
        """Return the split of a name stated at a place, None for no split; unknown names are counted for
        `require_known`."""
        key = name.strip().lower()
        if key in self._known:
            return self._known[key]
        if self._others is None:
            self._first = self._first or place()
            self._unknown[name.strip()] = self._unknown.get(name.strip(), 0) + 1
        return "drop" if self._others == "drop" else None

    def require_known(self) -> None:
        if not self._unknown:
            return
        name = next(iter(self._unknown))
        counts = ", ".join(f"'{other}' ({count})" for other, count in list(self._unknown.items())[:5])
        more = f"; unknown names and how often: {counts}" if len(self._unknown) > 1 else ""
        raise UserError(
            f"{self._first}: split '{name}' is none of {', '.join(_SYNONYMS)}{more}; say what it means: "
            f"--set splits_map='{name}=train', or val, test, drop (leave its clips "
            f"out) or ignore (as if it were not stated)"
        )

    def files(self, folder: Path) -> list[tuple[Split, Path]]:
        """The split files of a folder, `train.txt` first: files whose name means one of our splits."""
        found = []
        for path in sorted(folder.glob("*.txt")) if folder.is_dir() else ():
            split = self._known.get(path.stem.lower())
            if split is not None and split != "drop" and path.is_file():
                found.append((split, path))
        return sorted(found, key=lambda pair: SPLITS.index(pair[0]))


def hash_split(clip_id: str) -> Split:
    """80/5/15 by the id alone, so a clip keeps its split when others come or go."""
    share = hash_share(clip_id)
    if share < TRAIN_SHARE:
        return "train"
    return "val" if share < TRAIN_SHARE + VAL_SHARE else "test"


def hash_share(clip_id: str) -> float:
    """A number in [0, 1) by the id alone."""
    return int.from_bytes(hashlib.sha256(clip_id.encode()).digest()[:8], "big") / 2**64


def hash_splits(ids: Iterable[str]) -> tuple[dict[str, Split], list[str]]:
    """Splits in a source without split files: mirrored clips go with their originals. Returns a note too."""
    note = "no train.txt, val.txt or test.txt: split 80/5/15 by hash of the id"
    return {clip_id: hash_split(original_of(clip_id) or clip_id) for clip_id in ids}, [note]


def read_split_files(folder: Path, names: SplitNames | None = None) -> tuple[dict[str, Split], list[str]]:
    """`train.txt`, `val.txt`, `test.txt` (one id a line) -> split of every id, and notes on repeated lines.

    Files may also have the usual other names (`valid.txt`, `dev.txt`) and those that `names` knows. An id in
    two splits is a leak and an error; blank lines and CRLF are fine.
    """
    files = (names or SplitNames()).files(folder)
    if not files:
        raise UserError(f"{folder}: no train.txt, val.txt or test.txt")
    return join_splits(files)


def join_splits(
    files: Iterable[tuple[Split, Path]], suffixes: tuple[str, ...] = ()
) -> tuple[dict[str, Split], list[str]]:
    """Split of every id of some lists, and notes on repeated lines; `UserError` for an id in two splits.

    `suffixes` may stand after the ids.
    """
    splits: dict[str, Split] = {}
    origin: dict[str, str] = {}
    notes: list[str] = []
    for split, path in files:
        ids, repeated = read_ids(path, suffixes)
        notes += repeated
        if not ids:
            raise UserError(f"{path}: no ids in it; delete the file if there is to be no split '{split}'")
        for clip_id, number in ids.items():
            if splits.setdefault(clip_id, split) != split:
                where = f"{path}:{number}"
                raise UserError(
                    f"{where}: '{clip_id}' is also in {origin[clip_id]}; a clip in two splits leaks"
                )
            origin.setdefault(clip_id, path.name)
    return splits, notes


def read_ids(path: Path, suffixes: tuple[str, ...] = ()) -> tuple[dict[str, int], list[str]]:
    """The ids of a list, one a line, and the line of each; and notes on repeated lines."""
    lines: dict[str, int] = {}
    notes: list[str] = []
    for number, line in enumerate(read_text_file(path).split("\n"), start=1):
        clip_id = line.strip()
        for suffix in suffixes:
            clip_id = clip_id.removesuffix(suffix)
        if not clip_id:
            continue
        check_id(clip_id, f"{path}:{number}")
        if clip_id in lines:
            notes.append(f"{path.name}:{number}: '{clip_id}' is listed twice; line {lines[clip_id]} counts")
        lines.setdefault(clip_id, number)
    return lines, notes


def original_of(clip_id: str) -> str | None:
    """Id of the clip that this one mirrors, None for every other name.

    HumanML3D and Motion-X name them so: `humanml/M007482` mirrors `humanml/007482`.
    """
    found = _MIRRORED.fullmatch(clip_id)
    return found[1] + found[2] if found else None


def keep_mirrors_together(splits: Mapping[str, Split], folder: Path) -> None:
    """`UserError` when a mirrored clip is in another split than its original: the test set would leak.

    Originals without a split are fine. The error names both lines of the split files in `folder`.
    """
    for clip_id, split in splits.items():
        original = original_of(clip_id)
        other = splits.get(original) if original is not None else None
        if original is not None and other is not None and other != split:
            raise UserError(
                f"{_line_of(clip_id, split, folder)}: '{clip_id}' mirrors '{original}', which is in "
                f"{_line_of(original, other, folder)}; a clip and its mirror image in two splits leak"
            )


def _line_of(clip_id: str, split: Split, folder: Path) -> str:
    for path in (path for found, path in SplitNames().files(folder) if found == split):
        lines = [line.strip() for line in path.read_text(encoding="utf-8-sig").splitlines()]
        if clip_id in lines:
            return f"{path}:{lines.index(clip_id) + 1}"
    return f"{folder}: {split}"
