"""The files of a copy of Motion-X: every release and every set of scripts names its folders differently.

Nothing about the tree is assumed but names: a folder called like one of `_KINDS`, or like the zip file it
came from (`motionx_seq_text_v1.1`), holds that kind of file, at most a few levels below the source. What
follows it in a path is the clip's id: `motion_data/smplx_322/GRAB/s8/mug_toast_1.npy` is
`GRAB/s8/mug_toast_1`, and so is `texts/GRAB_txt/s8/mug_toast_1.txt`. Base names repeat over the folders, so
the whole id is the key.

`humanml/` holds HumanML3D's caption lines, whose segments are in seconds of the 30 fps motion (HumanTOMATO's
loader takes 20). Everywhere else a file is plain sentences, one a line, some of them only the clip's name.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Caption, Dropped
from motionloom.datasets.convert.common.files import check_id, inside, read_text_file, walk_files
from motionloom.datasets.shards.left_out import drop
from motionloom.datasets.text.clean import clean_caption, usable_caption

HUMANML = "humanml"
SOURCE = "motionx"


def read_sentences(path: Path, *, source: str, name: str) -> tuple[list[Caption], list[str]]:
    """Plain sentences, one a line, each once; and the lines that say nothing."""
    found: dict[str, Caption] = {}
    problems: list[str] = []
    for number, line in enumerate(read_text_file(path, name).split("\n"), start=1):
        if not line.strip():
            continue
        text = clean_caption(line)
        if usable_caption(line):
            found.setdefault(text, Caption(text=text, source=source))
        else:
            problems.append(f"line {number}: no usable caption ('{text[:60]}')")
    return list(found.values()), problems


Kind = Literal["motion", "face motion", "captions", "face texts"]

_SUBSETS = (
    "EgoBody", "GRAB", "HAA500", "aist", "animation", "dance", "fitness", "game_motion", "humanml", "humman",
    "idea400", "kungfu", "music", "perform",
)  # fmt: skip
"""Subsets as the release spells them."""

_VERSION = r"(?:[_-]?v?\d+(?:\.\d+)*)?"
_KINDS: dict[Kind, tuple[str, str]] = {
    "motion": (rf"smplx_?322|(?:motion_data|motionx_smplx){_VERSION}", ".npy"),
    "face motion": (rf"(?:motionx_)?face_motion(?:_data)?{_VERSION}", ".npy"),
    "captions": (rf"(?:semantic_(?:label|text)s?|motionx_seq_texts?){_VERSION}", ".txt"),
    "face texts": (rf"(?:motionx_)?face_texts?{_VERSION}", ".txt"),
}
"""Names of the folder (any case) and of the files of each kind."""
_PATTERNS = {kind: re.compile(names, re.IGNORECASE) for kind, (names, _) in _KINDS.items()}
_SMPLX = re.compile(r"smplx_?322", re.IGNORECASE)
"""The inner folder of motion and, although its files have 153 columns, of face motion."""
_SCRIPTS = re.compile(r"(humanml|grab|egobody)_(motion|texts?|txt)", re.IGNORECASE)
"""Names that the authors' scripts give a subset until it is moved in its place."""
_CASE = {name.lower(): name for name in _SUBSETS}
_DEEP = 5
"""Levels below the source at which the folder of a kind may lie."""


@dataclass(frozen=True)
class MotionXFiles:
    """The files of a source by kind and clip id; paths are relative to the source, with `/`."""

    by_kind: dict[Kind, dict[str, str]]
    folders: dict[Kind, Counter[str]]
    """Folders taken for each kind and the files in each."""
    broken: list[Dropped] = field(default_factory=list)
    """Names that cannot be ids, and links that leave their folder."""
    repeated: list[Dropped] = field(default_factory=list)
    """Motion files whose id another file has already."""

    def notes(self) -> list[str]:
        lines = []
        for kind, folders in self.folders.items():
            named = [f"{folder or '.'}/ ({count} files)" for folder, count in sorted(folders.items())]
            lines.append(f"{kind}: {', '.join(named) if named else 'none in this source'}")
        return lines


@dataclass(frozen=True)
class _Place:
    kind: Kind
    root: str
    """Folder taken for the kind."""
    rest: tuple[str, ...]
    """Folders of the ids below it."""
    smplx: bool
    """Whether an inner smplx_322 was named."""


def find_files(source: Path) -> MotionXFiles:
    """Walk the whole source once. `UserError` when it holds no motion folder."""
    if not source.is_dir():
        raise UserError(f"{source}: no such folder")
    placed: list[tuple[_Place, str, str]] = []
    broken: list[Dropped] = []
    for name in walk_files(source):
        *parts, file = name.split("/")
        place = _place(tuple(parts))
        if place is None or file.startswith(".") or not file.endswith(_KINDS[place.kind][1]):
            continue
        try:
            clip_id = "/".join((*place.rest, file.removesuffix(_KINDS[place.kind][1])))
            check_id(clip_id, name)
            # A folder may be a link: people keep the parts of a release on different disks.
            inside(source.joinpath(*parts), file, name)
        except UserError as error:
            broken.append(drop(name, error))
            continue
        placed.append((place, clip_id, name))
    # `motion_data/` beside an inner `smplx_322/` may hold other representations of the same clips.
    has_inner = {kind: any(p.kind == kind and p.smplx for p, _, _ in placed) for kind in _KINDS}
    found = MotionXFiles({kind: {} for kind in _KINDS}, {kind: Counter() for kind in _KINDS}, broken)
    for place, clip_id, name in placed:
        kind = place.kind
        if has_inner[kind] and not place.smplx:
            continue
        found.folders[kind][place.root] += 1
        first = found.by_kind[kind].setdefault(clip_id, name)
        if first != name and kind == "motion":
            reason = f"second file for clip id '{clip_id}'; the first is {first}"
            found.repeated.append(Dropped(source=name, reason=reason))
    if not found.by_kind["motion"]:
        raise UserError(
            f"{source}: no Motion-X motion in it; give the folder that holds motion_data/smplx_322/ "
            f"(or motionx_smplx/, smplx_322/)"
        )
    return found


def official_id(clip_id: str) -> str:
    """The id with its subset spelt as in the release: `grab_txt/s1/a` -> `GRAB/s1/a`."""
    return "/".join(_subset_first(tuple(clip_id.split("/"))))


def subset_of(clip_id: str) -> str:
    """First folder of an id; empty for clips that lie in none."""
    return clip_id.split("/", 1)[0] if "/" in clip_id else ""


@lru_cache(maxsize=256)
def _place(parts: tuple[str, ...]) -> _Place | None:
    if "__MACOSX" in parts:
        return None
    for depth, part in enumerate(parts[:_DEEP]):
        kind = next((kind for kind, names in _PATTERNS.items() if names.fullmatch(part)), None)
        if kind is None:
            by_script = _SCRIPTS.fullmatch(part)
            if by_script:
                kind = "motion" if by_script[2].lower() == "motion" else "captions"
                rest = _subset_first(parts[depth:])
                return _Place(kind, "/".join(parts[: depth + 1]), rest, smplx=kind == "motion")
            continue
        end = depth + 1
        smplx = bool(_SMPLX.fullmatch(part))
        while end < len(parts) and (_PATTERNS[kind].fullmatch(parts[end]) or _SMPLX.fullmatch(parts[end])):
            smplx = smplx or bool(_SMPLX.fullmatch(parts[end]))
            end += 1
        return _Place(kind, "/".join(parts[:end]), _subset_first(parts[end:]), smplx)
    return None


def _subset_first(parts: tuple[str, ...]) -> tuple[str, ...]:
    if not parts:
        return parts
    by_script = _SCRIPTS.fullmatch(parts[0])
    subset = by_script[1] if by_script else parts[0]
    rest = parts[1:]
    if subset.lower() == "humanml" and rest[:1] == ("texts",):
        rest = rest[1:]  # HumanML3D's texts.zip holds a folder of this name
    return (_CASE.get(subset.lower(), subset), *rest)
