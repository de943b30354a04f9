"""HumanML3D's `index.csv`: which stretch of which AMASS file, or free original, is which captioned clip.

Facts of the published preparation that the numbers depend on:
- frames count after every `int(fps / 20)`-th frame of the file was kept, so at 100 or 120 frames a second
  they are twentieths of a second, and at 250 (thinned to 20.83) they are not;
- the first seconds of five subsets are cut away before counting (`LEADS`);
- subset folders have the names of the first AMASS release; today's names are translated (`OLD_NAMES`).
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pydantic import Field, model_validator

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.files import is_file
from motionloom.datasets.base.json_doors import whole
from motionloom.datasets.base.licences import CMU
from motionloom.datasets.base.records import Caption, Split
from motionloom.datasets.convert.captions.humanml_text import read_humanml_captions
from motionloom.datasets.convert.captions.options import CaptionConfig
from motionloom.datasets.convert.common.files import check_id
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.planned import C
from motionloom.datasets.convert.common.splits import (
    hash_split,
    keep_mirrors_together,
    original_of,
    read_split_files,
    split_files,
)
from motionloom.datasets.convert.common.tables import BadRows, read_csv, reading_row

INDEX_FPS = 20
"""Frames a second that the index means."""

LEADS = {
    "Eyes_Japan_Dataset": 60,
    "MPI_HDM05": 60,
    "TotalCapture": 20,
    "MPI_Limits": 20,
    "Transitions_mocap": 10,
}
"""Thinned frames cut from the start of a file before the index counts."""

OLD_NAMES = {
    "BMLrub": "BioMotionLab_NTroje",
    "DFaust": "DFaust_67",
    "HDM05": "MPI_HDM05",
    "MoSh": "MPI_mosh",
    "PosePrior": "MPI_Limits",
    "SSM": "SSM_synced",
    "TCDHands": "TCD_handMocap",
    "Transitions": "Transitions_mocap",
}
"""Subset folders of later AMASS releases -> those of the index."""

ORIGINALS = {
    "CMU": CMU,
    "Eyes_Japan_Dataset": "CC-BY-2.1-JP",
    "ACCAD": "CC-BY-3.0",
    "MPI_HDM05": "CC-BY-SA-3.0",
}
"""Subsets whose recordings their makers publish for all uses, and the licence of each. The last is
share-alike, which weights made from it would be too."""

CREDITS = {
    "Eyes_Japan_Dataset": "Motion of mocapdata.com, Eyes, JAPAN Co. Ltd., licensed under the Creative "
    "Commons Attribution 2.1 Japan License.",
    "ACCAD": "Motion of ACCAD, The Ohio State University (accad.osu.edu), CC BY 3.0.",
    "MPI_HDM05": "The data used in this project was obtained from HDM05 (Mueller et al., 2007), "
    "CC BY-SA 3.0.",
}
"""Sentences that these licences ask for; CMU's is known by its licence."""
WORDS_CREDIT = "Words of HumanML3D (Guo et al., CVPR 2022), MIT License, Copyright (c) 2022 Chuan Guo."

TOLERANCE = 0.1
"""Seconds that a clip may reach past its recording: of 129 clips of CMU none did by more than 0.06."""

_AT_60 = re.compile(r"6[01]_\d+|90_(?:08|11)")
"""CMU's trials of 60 frames a second; their files say 120, or nothing."""
_FORMAT = re.compile(r"_(?:c3d|bvh|amc)(?=/)")
"""Ending of a folder that says how the same recordings are stored."""

_COLUMNS = ("source_path", "start_frame", "end_frame", "new_name")


@dataclass(frozen=True)
class IndexRow:
    """One clip: thinned frames [start, end) of a file; a negative end counts from the file's."""

    id: str
    source: str
    """Path of the file as the index has it, below `pose_data/`."""
    start: int
    end: int

    @property
    def subset(self) -> str:
        return self.source.split("/", 1)[0]

    def cut(self, frames: int, fps: float) -> tuple[int, int]:
        """First and last + 1 frame of the file (`frames` at `fps`); both 0 when nothing lies there.

        Every frame between is kept, so the clip can be resampled to any rate.
        """
        step = thinning(fps)
        lead = LEADS.get(self.subset, 0)
        thinned = max(math.ceil(frames / step) - lead, 0)
        start, end, _ = slice(self.start, self.end).indices(thinned)
        if end <= start:
            return 0, 0
        return (lead + start) * step, (lead + end - 1) * step + 1

    def true_fps(self, fps: float) -> float:
        """The frame rate of the original recording, whose file says `fps`."""
        at_60 = self.subset == "CMU" and _AT_60.fullmatch(clip_key(self.source).rsplit("/", 1)[-1])
        return 60.0 if at_60 else fps

    def span(self, frames: int, fps: float) -> tuple[int, int, str]:
        """First and last + 1 frame of an original of `frames` at its true rate, and why they are none.

        By time: originals may have another rate than AMASS's copies, which are whole multiples of 20.
        """
        lead = LEADS.get(self.subset, 0)
        there = int((frames - 1) * INDEX_FPS / fps + 1e-3) + 1 - lead
        start = self.start
        end = self.end + (there if self.end < 0 else 0)
        past = (end - there) / INDEX_FPS
        problem = ""
        if past > TOLERANCE:
            problem = (
                f"the index ends {past:.2f} s after the {frames / fps:.2f} s of the file: not the recording "
                f"that the words are about, or at another rate"
            )
        last = min(round((lead + min(end, there) - 1) * fps / INDEX_FPS) + 1, frames)
        first = round((lead + start) * fps / INDEX_FPS)
        return (first, last, problem) if first < last else (0, 0, problem or "nothing of it is in the index")


def thinning(fps: float) -> int:
    """Return how many frames of the file make one frame of the index."""
    return max(int(fps / INDEX_FPS), 1)


def clip_key(path: str) -> str:
    """Return the key that a file and its row of the index share over the AMASS releases.

    The last three parts of the path (subset, subject, clip) without the endings `_poses` and `_stageii`;
    later releases write `_` for spaces.
    """
    parts = list(PurePosixPath(path).with_suffix("").parts[-3:])
    parts[0] = OLD_NAMES.get(parts[0], parts[0])
    parts[-1] = parts[-1].removesuffix("_poses").removesuffix("_stageii")
    return "/".join(parts).replace(" ", "_")


class HumanmlConfig(CaptionConfig):
    """Options of converters that can cut HumanML3D's clips."""

    humanml_index: Path | None = Field(None, exclude_if=lambda path: path is None)
    """HumanML3D's `index.csv`: convert its clips (cut, and named by its numbers) instead of whole files."""
    humanml_texts: Path | None = Field(None, exclude_if=lambda path: path is None)
    """HumanML3D's folder of texts, for the clips of its index. Its split files are looked for beside both."""
    mirror: bool = Field(False, exclude_if=lambda wanted: not wanted)
    """With `humanml_index`: also the mirrored clips (`M...`), which have texts of their own there."""

    @model_validator(mode="after")
    def _consistent(self) -> HumanmlConfig:
        if self.humanml_index is None and (self.mirror or self.humanml_texts is not None):
            raise ValueError("mirror and humanml_texts need humanml_index")
        if self.humanml_index is not None and self.captions:
            raise ValueError("captions and humanml_index exclude each other; the index has humanml_texts")
        return self

    @property
    def has_captions(self) -> bool:
        return super().has_captions or self.humanml_texts is not None

    def index_splits(self) -> tuple[dict[str, Split] | None, list[str]]:
        """Split of every clip of HumanML3D's lists, or of others in `splits`, and notes; None without any."""
        near = [path.parent for path in (self.humanml_texts, self.humanml_index) if path is not None]
        folder = self.splits or next(filter(split_files, near), None)
        if folder is None:
            return None, ["no split files beside HumanML3D's texts or index: split 80/5/15 by recording"]
        listed, notes, _ = read_split_files(folder)
        keep_mirrors_together(listed, folder)
        return {key: split for key, split in listed.items() if self.mirror or not original_of(key)}, notes

    def index_texts(
        self, clip_id: str, seconds: float | None, notes: list[str]
    ) -> tuple[tuple[Caption, ...], str]:
        """Captions of a clip of the index, and why it must be left out."""
        if self.humanml_texts is None or not is_file(path := self.humanml_texts / f"{clip_id}.txt"):
            return (), ""
        try:
            captions, wrong = read_humanml_captions(path, seconds=seconds, name=path.name)
        except UserError as error:
            return (), str(error)
        notes += [f"{path.name}: {problem}" for problem in wrong]
        return tuple(captions), ""


@dataclass(frozen=True)
class IndexClip:
    """A clip of the index."""

    id: str
    row: IndexRow
    file: str | None
    """Its recording in the source; None where it is not there."""
    split: Split
    mirror_of: str | None


def index_clips(
    config: HumanmlConfig, found: Iterable[tuple[IndexRow, str | None]], listed: dict[str, Split] | None
) -> Iterator[IndexClip]:
    """The clip of every row and its file, and the mirrored ones where they are wanted."""
    for row, file in found:
        # Stretches of one recording may overlap: without split files they stay together.
        split = (listed or {}).get(row.id) or (listed or {}).get(f"M{row.id}")
        split = split or hash_split(clip_key(row.source))
        yield IndexClip(row.id, row, file, split, None)
        if config.mirror and file is not None:
            yield IndexClip(f"M{row.id}", row, file, split, row.id)


def _original_of(row: IndexRow, by_end: Mapping[str, Sequence[str]]) -> tuple[str | None, str]:
    """The file that a row means by as much of its name as fits, and why it is none although one fits."""
    fits = next((by_end[end] for end in _ends(row.source) if end in by_end), ())
    # Two people of one trial: AMASS says who by a first name, the originals by a number.
    *_, folder, trial = clip_key(row.source).split("/")
    if len(fits) > 1:
        return None, f"the index means {fits[0]} or {fits[1]}; convert one of them"
    if fits and row.subset == "CMU" and trial.partition("_")[0] != folder:
        return None, f"a trial of two people: which of them '{folder}' is, the files do not say"
    return (fits[0] if fits else None), ""


def find_originals(
    config: HumanmlConfig, index: Path, paths: Iterable[str], draft: ConversionPlan[C]
) -> list[tuple[IndexRow, str | None]]:
    """The rows of the free originals in the source, and the file of each.

    What is not there, is in no row, or waits for a `licence` that names it, is said in the plan.
    """
    used = set[str]()
    by_end = defaultdict[str, list[str]](list)
    for path in paths:
        for end in _ends(path):
            by_end[end].append(path)
    rows: dict[str, list[tuple[IndexRow, str | None, str]]] = {subset: [] for subset in ORIGINALS}
    bad: BadRows = {}
    for row in read_index(index, bad):
        if row.subset in ORIGINALS:
            rows[row.subset].append((row, *_original_of(row, by_end)))
    draft.mark_rows_unreadable(bad)
    known = sorted(set(ORIGINALS.values()))
    if config.licence not in (None, *known):
        raise UserError(
            f"licence {config.licence}: HumanML3D's originals are under {', '.join(known)}; leave it out, or "
            f"name the one whose clips are wanted"
        )
    found: list[tuple[IndexRow, str | None]] = []
    for subset, mine in rows.items():
        licence = ORIGINALS[subset]
        here = [file for _, file, _ in mine if file]
        used.update(here)
        alike = licence.startswith("CC-BY-SA")
        if not any(file or why for _, file, why in mine):
            draft.notes.append(f"{subset}: none of its {len(mine)} clips is in the source")
        elif config.licence != licence and (alike or config.licence is not None):
            own = "share-alike, a set of its own" if alike else "not the licence that is wanted"
            draft.notes.append(f"{subset}: {len(here)} clips under {licence}, {own}: --licence {licence}")
        else:
            for row, file, why in mine:
                if file is None:
                    draft.mark_missing(
                        row.source, f"clip '{row.id}': {why or 'its file is not in the source'}"
                    )
                else:
                    found.append((row, file))
    for path in paths:
        if path not in used:
            draft.skip(path, "in no row of the index")
    return found


def settle_index(config: HumanmlConfig, draft: ConversionPlan[C], apart: Sequence[str]) -> None:
    """Stop before files that are not as long as the index says (`apart`), or clips that have no words, are
    left out without a decision.
    """
    if config.uncaptioned != "stop":
        return
    bare = draft.words.bare
    decide = "get the originals and HumanML3D's texts, or leave them out: --set "
    if apart or (bare and config.has_captions):
        reason = f"{len(apart)} clips do not agree with their recordings ({apart[0]})" if apart else ""
        reason = (
            reason or f"no words for {len(bare)} of {draft.words.captioned + len(bare)} clips ({bare[0]})"
        )
        draft.stop = f"{config.humanml_index}: {reason}; {decide}uncaptioned=drop"


def _ends(path: str) -> list[str]:
    """`a/b/c`, `b/c`, `c` of a path in the form that files and index share."""
    pieces = _FORMAT.sub("", clip_key(path)).split("/")
    return ["/".join(pieces[first:]) for first in range(len(pieces))]


def read_index(path: Path, bad: BadRows) -> list[IndexRow]:
    """All rows; malformed ones, and those of an id seen before, go into `bad`."""
    rows: dict[str, IndexRow] = {}
    for where, line in read_csv(path, _COLUMNS, bad):
        with reading_row(where, bad):
            row = _row(line, where)
            if row.id in rows:
                raise UserError(f"{where}: clip '{row.id}' has a row already")
            rows[row.id] = row
    return list(rows.values())


def _row(line: dict[str, str], where: str) -> IndexRow:
    source = line["source_path"].removeprefix("./").removeprefix("pose_data/")
    start = whole(line["start_frame"], f"{where}: start_frame")
    end = whole(line["end_frame"], f"{where}: end_frame", least=-1e9)  # counted from the end, as slices are
    name = check_id(line["new_name"].removesuffix(".npy"), where)
    return IndexRow(name, check_id(source, where), start, end)
