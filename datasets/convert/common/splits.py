"""Splits of a source: its own split files, else 80/5/15 by a hash of each id or subject alone."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, cast

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.records import SPLITS, Split
from motionloom.datasets.convert.common.files import check_id, read_text_file

TRAIN_SHARE, VAL_SHARE = 0.80, 0.05
"""80/5/15, the split of HumanML3D and Motion-X, where a source brings none."""

_SYNONYMS: dict[str, Split] = {
    **dict.fromkeys(("train", "training"), "train"),
    **dict.fromkeys(("val", "valid", "validation", "dev", "development"), "val"),
    **dict.fromkeys(("test", "testing"), "test"),
}
_LIST = re.compile(r"(?:crossmodal_)?([a-z]+)(?:_ids)?", re.IGNORECASE)
"""Names of split files: AIST++'s are `crossmodal_train.txt`, SnapMoGen's `train_ids.txt`."""
_FILE = re.compile(r"\.(?:npy|pkl|json)$")
_MIRRORED = re.compile(r"((?:.*/)?)M(\d+)")
_HDM05 = re.compile(r"(HDM_[a-z]+)_.+")
"""HDM05's `HDM_bd_kickLFront1Reps_003_120`: actor, label, number, frame rate."""
_TRIAL = re.compile(r"(\d+)_\d+(?:_\w+)?")
"""CMU's `01_02`: subject and trial. AMASS puts subjects in folders."""
_AMASS = re.compile(r"_(?:poses|stageii)$")


def split_named(name: str, place: str) -> Split:
    """Return the split that a name or a usual synonym of it means; `UserError` beginning with `place`."""
    split = _SYNONYMS.get(name.strip().lower())
    if split is None:
        raise UserError(f"{place}: split '{name[:60]}' is none of {', '.join(_SYNONYMS)}; write one of these")
    return split


def split_files(folder: Path) -> list[tuple[Split, Path]]:
    """The split files of a folder, `train.txt` first: files whose name means one of our splits."""
    found = []
    for path in sorted(folder.glob("*.txt")) if folder.is_dir() else ():
        name = _LIST.fullmatch(path.stem)
        split = _SYNONYMS.get(name[1].lower()) if name else None
        if split is not None and path.is_file():
            found.append((split, path))
    return sorted(found, key=lambda pair: SPLITS.index(pair[0]))


def hash_split(name: str, seed: int = 0) -> Split:
    """80/5/15 by a name alone, so that what has it keeps its split when others come or go."""
    share = hash_share(f"{seed}:{name}" if seed else name)
    if share < TRAIN_SHARE:
        return "train"
    return "val" if share < TRAIN_SHARE + VAL_SHARE else "test"


def hash_share(clip_id: str) -> float:
    """A number in [0, 1) by the id alone, which may be a file's name in any bytes."""
    name = clip_id.encode("utf-8", "surrogateescape")
    return int.from_bytes(hashlib.sha256(name).digest()[:8], "big") / 2**64


_TOLD = 10
"""Repeated lines of a list that a manifest names."""


class ListLine(NamedTuple):
    """One line of a list or of a table of captions."""

    place: str
    """`FILE:LINE`."""
    key: str
    """Id or file of the clip that it names."""
    reason: str = ""
    """Why it says nothing of a clip; empty where it does."""
    words: frozenset[str] = frozenset()
    """Its captions."""
    is_catalogue: bool = False
    """Whether it is from a list of a whole collection, of which a source need not have every clip."""


class SplitLists(NamedTuple):
    """The split files of a folder."""

    splits: dict[str, Split]
    """Split of every id."""
    notes: list[str]
    """On repeated lines."""
    lines: list[ListLine]


def read_split_files(folder: Path) -> SplitLists:
    """`train.txt`, `val.txt`, `test.txt` (one id a line).

    Files may also have the usual other names (`valid.txt`, `dev.txt`). An id in two splits is a leak and an
    error; blank lines, CRLF and suffixes of files behind the ids are fine.
    """
    files = split_files(folder)
    if not files:
        raise UserError(f"{folder}: no train.txt, val.txt or test.txt")
    splits: dict[str, Split] = {}
    origin: dict[str, str] = {}
    notes: list[str] = []
    lines: list[ListLine] = []
    for split, path in files:
        ids, repeated = read_ids(path)
        notes += [f"{line.place}: {line.reason}" for line in repeated[:_TOLD]]
        lines += [*(ListLine(f"{path.name}:{number}", clip_id) for clip_id, number in ids.items()), *repeated]
        if not ids:
            raise UserError(f"{path}: no ids in it; delete the file if there is to be no split '{split}'")
        for clip_id, number in ids.items():
            if splits.setdefault(clip_id, split) != split:
                where = f"{path}:{number}"
                raise UserError(
                    f"{where}: '{clip_id}' is also in {origin[clip_id]}; a clip in two splits leaks"
                )
            origin.setdefault(clip_id, path.name)
    return SplitLists(splits, notes, lines)


def read_ids(path: Path) -> tuple[dict[str, int], list[ListLine]]:
    """The ids of a list, one a line, and the line of each; and the lines that are repeated or
    no id.
    """
    lines: dict[str, int] = {}
    repeated: list[ListLine] = []
    for number, line in enumerate(read_text_file(path).split("\n"), start=1):
        clip_id = _FILE.sub("", line.strip())
        if not clip_id:
            continue
        place = f"{path.name}:{number}"
        try:
            check_id(clip_id, place)
        except UserError as error:
            repeated.append(ListLine(place, clip_id, str(error).removeprefix(f"{place}: ")))
            continue
        if clip_id in lines:
            reason = f"'{clip_id}' is listed twice; line {lines[clip_id]} counts"
            repeated.append(ListLine(place, clip_id, reason))
        lines.setdefault(clip_id, number)
    return lines, repeated


def original_of(clip_id: str) -> str | None:
    """Id of the original that a mirrored clip is made from (`humanml/M007482`: `humanml/007482`), or None."""
    found = _MIRRORED.fullmatch(clip_id)
    return found[1] + found[2] if found else None


def keep_mirrors_together(splits: Mapping[str, Split], folder: Path) -> None:
    """`UserError` if a mirrored clip and its original are in two splits: the test set would leak."""
    for clip_id, split in splits.items():
        original = original_of(clip_id)
        if original is not None and splits.get(original, split) != split:
            raise UserError(
                f"{folder}: '{clip_id}' of {split}.txt mirrors '{original}', which is in "
                f"{splits[original]}.txt; a clip and its mirror image in two splits leak"
            )


def subject_of(path: str) -> str:
    """The subject of a file: by the naming of HDM05 or CMU, else the folder, else the name's first word."""
    stem = _stem(path)
    for pattern in (_HDM05, _TRIAL):
        if found := pattern.fullmatch(stem):
            return found[1]
    folder = path.rpartition("/")[0]
    return folder or re.split(r"[_\-. ]", stem)[0]


_RULE = re.compile(r"(subjects|clips)(?::(\d{1,9}))?")


@dataclass(frozen=True)
class SplitRule:
    """Splits by a hash of subjects or of clip ids: `subjects`, `clips`, or with another seed `subjects:3`."""

    by: Literal["subjects", "clips"] = "clips"
    seed: int = 0

    @classmethod
    def parse(cls, words: str) -> SplitRule | None:
        """Return the rule that some words name, or None."""
        found = _RULE.fullmatch(words)
        return found and cls(
            cast(Literal["subjects", "clips"], found[1]), whole(found[2] or 0, f"split {words}")
        )

    def name(self, clip_id: str, path: str) -> str:
        """Return what of a clip is hashed."""
        return subject_of(path) if self.by == "subjects" else clip_id


def _stem(path: str) -> str:
    name = path.rsplit("/", 1)[-1]
    return _AMASS.sub("", name.rpartition(".")[0] or name)
