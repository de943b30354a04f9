"""Captions of your own in a conversion: the options, which clip a row means, and what has no counterpart."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import field_validator

from motionloom.datasets.base.files import sha256_of, sha256_of_json
from motionloom.datasets.convert.captions.read import CaptionRow, bare, read_captions
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.plan import C, ConversionPlan
from motionloom.datasets.convert.common.splits import SplitNames, read_split_files
from motionloom.datasets.schema import Caption, Split


@dataclass(frozen=True)
class CaptionMatch:
    """Rows by the paths of motion files."""

    rows: dict[str, CaptionRow] = field(default_factory=dict)
    unused: list[CaptionRow] = field(default_factory=list)
    """Rows that name no motion file of the source."""
    free: tuple[str, ...] = ()
    """Files without a row."""

    def nearest(self, row: CaptionRow, number: int = 2) -> list[str]:
        return nearest(row.names()[0], self.free, number)


def match(rows: Mapping[str, CaptionRow], paths: Iterable[str]) -> CaptionMatch:
    """Find the row of every motion file.

    Suffixes do not matter. A file's row is the one that names its path; else one that names the end of it
    (`walk` means `walks/walk.bvh`), or whose own end it is (`mocap/walks/walk`); else the only one with the
    same last name, where no other file has it.
    """
    files = {path: bare(path) for path in paths}
    by_name: dict[str, CaptionRow] = {}
    for row in rows.values():
        for name in reversed(row.names()):
            by_name.setdefault(name, row)
    by_end = _by_end(by_name)
    found: dict[str, CaptionRow] = {}
    for path, name in files.items():
        made = next((by_name[end] for end in _ends(name) if end in by_name), by_end.get(name))
        if made is not None:
            found[path] = made
    used = {row.id for row in found.values()}
    last = {path: name.rsplit("/", 1)[-1] for path, name in files.items() if path not in found}
    left = [row for row in rows.values() if row.id not in used]
    stems = Counter(stem for row in left for stem in _stems(row))
    by_stem = {stem: row for row in left for stem in _stems(row) if stems[stem] == 1}
    counts = Counter(last.values())
    for path, stem in last.items():
        if counts[stem] == 1 and stem in by_stem:
            found[path] = by_stem[stem]
    used = {row.id for row in found.values()}
    return CaptionMatch(
        found,
        [row for row in rows.values() if row.id not in used],
        tuple(path for path in files if path not in found),
    )


def _ends(name: str) -> list[str]:
    """`a/b/c`, `b/c`, `c`."""
    pieces = name.split("/")
    return ["/".join(pieces[first:]) for first in range(len(pieces))]


def _stems(row: CaptionRow) -> set[str]:
    return {name.rsplit("/", 1)[-1] for name in row.names()}


def _by_end(by_name: Mapping[str, CaptionRow]) -> dict[str, CaptionRow]:
    ends: dict[str, CaptionRow | None] = {}
    for name, row in by_name.items():
        for end in _ends(name)[1:]:
            ends[end] = row if ends.get(end, row) is row else None
    return {end: row for end, row in ends.items() if row is not None}


def nearest(name: str, candidates: Sequence[str], number: int = 2) -> list[str]:
    """The candidates most like a name by their last names, best first; none that is like it in nothing."""
    stems: dict[str, str] = {}
    for candidate in sorted(candidates):
        stems.setdefault(_stem(candidate), candidate)
    return [stems[stem] for stem in difflib.get_close_matches(_stem(name), list(stems), n=number)]


def _stem(name: str) -> str:
    return bare(name).rsplit("/", 1)[-1].lower()


_SHOWN = 3
"""Names that a sentence lists."""


class CaptionConfig(ConvertConfig):
    """Options of converters that take captions in any form."""

    captions: Path | None = None
    """Captions by the clips' names: JSON lines, JSON, CSV, TSV, or a folder of .txt files (docs/sources.md).
    Without it clips have no captions.
    """
    splits: Path | None = None
    """Folder of train.txt, val.txt, test.txt; else the captions' `split`, else 80/5/15 by hash of the id."""
    splits_map: str = ""
    """What other names of splits mean: `fold1=train,extra=drop`; `NAME=ignore` as if none were stated;
    `ignore` or `drop` alone for all others. `valid`, `dev`, `training` and the like need none.
    """
    uncaptioned: Literal["stop", "drop", "keep"] = "stop"
    """What to do with clips that the given captions do not name: stop and say which, leave them out, or keep
    them.
    """

    @field_validator("splits_map")
    @classmethod
    def _readable(cls, mapping: str) -> str:
        SplitNames(mapping)
        return mapping

    def options(self) -> dict[str, object]:
        """What the output depends on; `stop` is `drop`: where it does not stop, every clip has captions."""
        return super().options() | {"uncaptioned": "drop" if self.uncaptioned == "stop" else self.uncaptioned}

    def listed_splits(self) -> tuple[dict[str, Split], list[str]]:
        """Splits of the split files by id, and notes; neither without such files."""
        if self.splits is None:
            return {}, []
        listed, notes = read_split_files(self.splits, SplitNames(self.splits_map))
        return {bare(clip_id): split for clip_id, split in listed.items()}, notes

    def matched(self, paths: Iterable[str]) -> CaptionMatch:
        """The captions of motion files by their paths in the source."""
        rows = read_captions(self.captions, SplitNames(self.splits_map)) if self.captions else {}
        return match(rows, paths)


def digest_of(path: Path) -> dict[str, str]:
    """A file by its name and checksum; a folder by its name and those of its .txt files."""
    if path.is_dir():
        inside = {
            p.relative_to(path).as_posix(): sha256_of(p) for p in sorted(path.rglob("*.txt")) if p.is_file()
        }
        return {"file": path.name, "sha256": sha256_of_json(inside)}
    return {"file": path.name, "sha256": sha256_of(path)}


@dataclass
class CaptionedPlan(ConversionPlan[C]):
    """The plan of a converter whose clips may have captions of the user's."""

    bare_clips: list[str] = field(default_factory=list)
    """Clips that lack nothing but captions."""
    captioned: int = 0
    """Clips that have them, and nothing against them."""

    def decide(self, clip: C, texts: Sequence[Caption], reason: str, *, needed: bool, keep: bool) -> None:
        """Take a clip or leave it out: for `reason`, or for want of captions that are `needed`."""
        if needed and not texts:
            self.uncaptioned.append(clip.label())
            if not reason:
                self.bare_clips.append(clip.label())
                reason = "" if keep else "no captions"
        elif texts and not reason:
            self.captioned += 1
        if reason:
            self.leave_out(clip.label(), reason)
        else:
            self.take(clip)


def settle_captions(config: CaptionConfig, draft: CaptionedPlan[C], found: CaptionMatch) -> None:
    """Say in the plan how captions and clips fit, and why the conversion must not start if it must not."""
    if config.captions is None:
        return
    bare_clips, captioned = draft.bare_clips, draft.captioned
    file, total = config.captions.name, captioned + len(bare_clips)
    become = {"stop": "", "drop": " and are left out", "keep": " and are kept"}[config.uncaptioned]
    said = [f"{captioned} of {total} clips have captions in {file}"]
    if bare_clips:
        said.append(f"{len(bare_clips)} have none{become} ({_some(bare_clips)})")
    if found.unused:
        said.append(f"captions for {_unused(found)}")
    draft.captions = "; ".join(said)
    draft.notes.append(draft.captions)
    if bare_clips and config.uncaptioned == "stop":
        draft.stop = (
            f"{config.captions}: no captions for {len(bare_clips)} of {total} clips ({_some(bare_clips)})"
            + (f"; captions for {_unused(found)}" if found.unused else "")
            + "; add them, or choose with --uncaptioned (in a recipe uncaptioned): drop leaves these clips "
            "out, keep converts them without words"
        )


def _some(names: list[str]) -> str:
    more = f", and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _unused(found: CaptionMatch) -> str:
    """How many clips have captions and no file, and the first of them with the nearest names."""
    shown = []
    for row in found.unused[:_SHOWN]:
        near = found.nearest(row)
        shown.append(f"'{row.file or row.id}'" + (f", nearest: {' and '.join(near)}" if near else ""))
    more = f"; and {len(found.unused) - _SHOWN} more" if len(found.unused) > _SHOWN else ""
    which = "clip that is" if len(found.unused) == 1 else "clips that are"
    return f"{len(found.unused)} {which} not in the source ({'; '.join(shown)}{more})"
