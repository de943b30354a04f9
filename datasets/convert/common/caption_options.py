"""Captions of your own in a conversion: the options, and clips and captions without each other."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import field_validator

from motionloom.datasets.base.files import sha256_of, sha256_of_json
from motionloom.datasets.convert.common.caption_match import CaptionMatch, match
from motionloom.datasets.convert.common.caption_row import bare
from motionloom.datasets.convert.common.captions import read_captions
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.plan import PlanDraft, PlannedClip
from motionloom.datasets.convert.common.splits import SplitNames, read_split_files
from motionloom.datasets.schema import Split

_SHOWN = 3
"""Names that a sentence lists."""

C = TypeVar("C", bound=PlannedClip)


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

    def options(self, *local: str) -> dict[str, Any]:
        """What the output depends on. `stop` is recorded as `drop`: where it does not stop, every clip has
        captions. A map that is not given is not recorded, so shards from before there was one stay valid."""
        given = super().options(*(local if self.splits_map else (*local, "splits_map")))
        return given | {"uncaptioned": "drop" if self.uncaptioned == "stop" else self.uncaptioned}

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


def settle_captions(
    config: CaptionConfig, draft: PlanDraft[C], found: CaptionMatch, bare_clips: list[str], captioned: int
) -> None:
    """Say in the plan how captions and clips fit, and why the conversion must not start if it must not.

    `bare_clips` are the clips that lack nothing but captions, `captioned` the number of those that have them.
    """
    if config.captions is None:
        return
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
