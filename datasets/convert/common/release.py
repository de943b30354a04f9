"""`Release`: the converter of a set with published lists and one motion file for one clip or several.

A set says what its lists state (`entries`), how long a motion file is (`length`) and what is in it
(`figure`). Whether a file is there, can be read and is wanted, its split and its words, and everything from
joints to samples is decided here, alike for all sets. A plan reads lists and headers, no motion.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.memory import content_of
from motionloom.datasets.base.records import Caption, ClipMeta, Split
from motionloom.datasets.convert.common.config import ConvertConfig
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.facts import Fact
from motionloom.datasets.convert.common.features import features_of, frames_after
from motionloom.datasets.convert.common.files import inside, read_in_threads
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.splits import (
    hash_split,
    keep_mirrors_together,
    read_split_files,
    split_files,
)
from motionloom.datasets.convert.common.tables import captions_within
from motionloom.datasets.shards.sample import Sample


class ReleaseConfig(ConvertConfig):
    """Options of every published set."""

    layouts: ClassVar[tuple[str, ...]] = ("body133", "h3d263")

    layout: str = "body133"
    fps: float = 20.0
    splits: Path | None = None
    """Folder of train.txt, val.txt, test.txt with clip ids; else the set's own lists."""
    uncaptioned: Literal["stop", "drop", "keep"] = "keep"
    """Leave out or keep clips that have no usable caption."""
    retarget: bool = False
    """Give every clip the bone lengths of the layout's skeleton (the h3d layouts always do)."""

    @property
    def has_captions(self) -> bool:
        """Whether the source has captions that a clip may lack."""
        return True


@dataclass(frozen=True)
class Entry:
    """One clip, as the set's own lists state it. Paths are relative to the source."""

    id: str
    file: str
    texts: tuple[Caption, ...] = ()
    split: Split | None = None
    """None: by a hash of `group`, or of the id."""
    group: str = ""
    """Clips that must not be torn apart by the hash."""
    facts: dict[str, Fact] = field(default_factory=dict)
    sound: str | None = None
    first: int = 0
    last: int | None = None
    """Frames [first, last) of the file; None: to its end."""
    mirror_of: str | None = None
    licence: str | None = None
    """Its licence, if not the set's."""
    problem: str = ""
    """Reason to leave it out."""


@dataclass(frozen=True)
class ReleaseClip:
    """A clip of the plan: an entry, its split, and the frames of its file that are used."""

    entry: Entry
    split: Split
    first: int
    last: int
    fps: float
    licence: str

    @property
    def id(self) -> str:
        return self.entry.id

    @property
    def file(self) -> str:
        return self.entry.file

    @property
    def texts(self) -> tuple[Caption, ...]:
        return self.entry.texts

    @property
    def seconds(self) -> float:
        return (self.last - self.first) / self.fps

    @property
    def facts(self) -> dict[str, Fact]:
        captions = float(len(self.entry.texts))
        return {**self.entry.facts, "seconds": self.seconds, "captions": captions, "licence": self.licence}

    def label(self) -> str:
        whole = self.entry.last is None and not self.entry.first
        return self.entry.file if whole else f"{self.entry.file} ({self.id})"


@dataclass(frozen=True)
class Figure:
    """One person in metres, Y up: joints, or the rotations (axis-angle, radians) that pose a body."""

    joints: NDArray[np.float64] | None = None
    """[T, 22, 3]."""
    rotations: NDArray[np.float64] | None = None
    """[T, 52, 3]: 22 of the body, 30 of the fingers."""
    trans: NDArray[np.float64] | None = None
    """[T, 3], what a body model adds to every vertex."""
    betas: NDArray[np.float64] | None = None
    face: NDArray[np.float64] | None = None
    """[T, 50] FLAME expression."""

    def cut(self, first: int, last: int) -> Figure:
        """Frames [first, last) of it."""
        moving = {name: getattr(self, name) for name in ("joints", "rotations", "trans", "face")}
        return replace(self, **{name: v[first:last] for name, v in moving.items() if v is not None})

    def __len__(self) -> int:
        return len(next(values for values in (self.joints, self.rotations) if values is not None))


Cfg = TypeVar("Cfg", bound=ReleaseConfig)


class Release(Converter[Cfg, ReleaseClip]):
    """A published set; its own file adds its name, numbers, lists and reader."""

    terms: ClassVar[str]
    """The licence of clips that state none of their own."""
    lists: ClassVar[tuple[str, ...]] = ()
    """Folders of the source that may hold its split files; the first that does counts."""
    listed: dict[str, Split] | None = None
    """Split of every clip of the split files; None without any."""
    settings = PlanSettings()
    """Workers and files that a plan uses; no effect on its result."""

    @abstractmethod
    def entries(self, draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        """Every clip that the set's lists state, in an order that depends on them alone; what is odd about
        the lists goes into `draft.notes`. `UserError` when they are not there or cannot be read.
        """

    @abstractmethod
    def length(self, path: Path, label: str) -> tuple[int, float]:
        """Frames and frame rate of a motion file, by its header."""

    @abstractmethod
    def figure(self, clip: ReleaseClip) -> Figure:
        """The whole motion file of a clip."""

    def plan(self, settings: PlanSettings) -> ConversionPlan[ReleaseClip]:
        config = self.config
        self.settings = settings
        if not config.source.is_dir():
            raise UserError(f"{config.source}: no such folder")
        draft = ConversionPlan[ReleaseClip](config, stated=self.stated())
        self.listed = self.split_lists(draft)
        entries = list(self.entries(draft))
        if self.lists and self.listed is None and any(entry.split is None for entry in entries):
            draft.notes.append("no split files: split 80/5/15 by hash")
        repeated = len(draft.dropped)
        if not entries:
            raise UserError(f"{config.source}: the lists of {self.title} name no clip in it")
        # Several clips may lie in one file: its header is read once.
        ids: dict[str, list[str]] = {}
        for entry in entries:
            ids.setdefault(entry.file, []).append(entry.id)
        files = list(ids)
        found = read_in_threads(self._scan, files, workers=settings.workers, progress=settings.progress)
        scanned = dict(zip(files, found, strict=True))
        for file, state in scanned.items():
            if isinstance(state, Exception):
                draft.mark_unreadable(file, state, *ids[file])
        named = {entry.id for entry in entries}
        for clip_id, split in (self.listed or {}).items():
            if clip_id not in named:
                draft.mark_missing(clip_id, f"listed in {split}.txt, but not in the source")
        for entry in self.with_sound(entries, draft):
            state = scanned[entry.file]
            if state is None:
                reason = f"clip '{entry.id}' is listed, but its file is not in the source"
                draft.mark_missing(entry.file, reason, entry.id)
            elif not isinstance(state, Exception):
                clip, problem = self._clip(entry, state, draft)
                reason = clip.entry.problem or problem
                captioned = bool(clip.entry.texts)
                keep = config.uncaptioned == "keep"
                draft.add(clip, reason, captioned=captioned, wanted=config.has_captions, keep=keep)
        draft.limit()
        return draft.finish(
            found=draft.totals.found or repeated + sum(state is not None for state in scanned.values()),
            frames=self.frames,
            licence=lambda clip: clip.licence,
        )

    def stated(self) -> str:
        """The numbers that the source at hand is compared with."""
        return self.published

    def path_of(self, file: str) -> Path:
        """Return the path of a motion file; `UserError` for one outside of the source."""
        return inside(self.config.source, file)

    def frames(self, clip: ReleaseClip) -> int:
        """Frames of a clip's features."""
        return frames_after(clip.last - clip.first, clip.fps, self.layout)

    def split_lists(self, draft: ConversionPlan[ReleaseClip]) -> dict[str, Split] | None:
        """Split of every clip that the user's lists or else the set's own name; None without lists."""
        source = self.config.source
        here = [source / name for name in self.lists if split_files(source / name)]
        folder = self.config.splits or next(iter(here), None)
        if folder is None:
            return None
        lists = read_split_files(folder)
        keep_mirrors_together(lists.splits, folder)
        draft.notes += lists.notes
        draft.known.lines += lists.lines
        draft.known.beside.update(_below(source, [path for _, path in split_files(folder)]))
        return lists.splits

    def with_sound(self, entries: Sequence[Entry], draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        """The entries as their sound allows; sets without sound have none."""
        return entries

    def fitted(self, entry: Entry, frames: int, fps: float, draft: ConversionPlan[ReleaseClip]) -> Entry:
        """Return an entry as the length and frame rate of its file, which lists do not know, make it."""
        return entry

    def cut_to_sound(self, entry: Entry, last: int, fps: float) -> tuple[int, str]:
        """The last frame before the sound ends, and why the clip is left out if it ends too early."""
        return last, ""

    def _scan(self, file: str) -> tuple[int, float] | Exception | None:
        """Frames and rate of a motion file; None when it is not there, an error when it is damaged."""
        try:
            path = self.path_of(file)
            if not path.is_file():
                return None
            return self.length(path, file)
        except Exception as error:  # whatever a bad file or name makes of the libraries below
            return error

    def _clip(
        self, entry: Entry, state: tuple[int, float], draft: ConversionPlan[ReleaseClip]
    ) -> tuple[ReleaseClip, str]:
        """The clip of an entry whose file is there, and why it is left out."""
        config = self.config
        (frames, fps) = state
        entry = self.fitted(entry, frames, fps, draft)
        last, mute = self.cut_to_sound(entry, min(frames if entry.last is None else entry.last, frames), fps)
        seconds = max(last - entry.first, 0) / fps
        entry = replace(entry, texts=captions_within(entry.texts, seconds, entry.id, draft.notes))
        listed = self.listed if self.listed is not None else {entry.id: entry.split}
        split = listed.get(entry.id) or entry.split or hash_split(entry.group or entry.id)
        licence = config.licence or entry.licence or self.terms
        clip = ReleaseClip(entry, split, min(entry.first, last), last, fps, licence)
        reason = (
            mute or ("" if entry.id in listed else "in no split file") or config.length_problem(clip.seconds)
        )
        return clip, reason

    def depends_on(self, clip: ReleaseClip) -> list[object]:
        entry = clip.entry
        texts = [caption.dump() for caption in entry.texts]
        content = content_of(self.path_of(entry.file))
        return [clip.id, entry.file, content, clip.first, clip.last, texts, clip.licence]

    def copies(self, plan: ConversionPlan[ReleaseClip]) -> list[str]:
        sizes = {clip.file: self.path_of(clip.file).stat().st_size for _, clip in plan.items}
        counts = Counter(sizes.values())
        first: dict[tuple[str, int, int], str] = {}
        notes = []
        for _, clip in plan.items:
            if counts[sizes[clip.file]] < 2:  # nothing has its bytes: a plan need not read them
                continue
            key = (content_of(self.path_of(clip.file)), clip.first, clip.last)
            same = first.setdefault(key, clip.file)
            if same != clip.file:
                notes.append(f"{clip.file} has the same bytes as {same}: one motion under two names")
        return notes

    def licence(self, plan: ConversionPlan[ReleaseClip]) -> str:
        alone = next(iter(plan.totals.licences), self.terms) if len(plan.totals.licences) <= 1 else self.terms
        return self.config.licence or alone

    def read(self, clip: ReleaseClip) -> Figure:
        """The frames of a clip."""
        figure = self.figure(clip)
        if len(figure) < clip.last:
            raise UserError(
                f"{clip.entry.file}: {len(figure)} frames, {clip.last} when the plan was made; convert again"
            )
        return figure.cut(clip.first, clip.last)

    def posed(self, figure: Figure) -> NDArray[np.float64]:
        """World joints [T, N, 3] of as many joints as the layout has."""
        assert figure.joints is not None
        return figure.joints

    def joints(self, clip: ReleaseClip) -> SourceJoints:
        return SourceJoints(self.posed(self.read(clip)), clip.fps)

    def convert(self, clip: ReleaseClip) -> Sample:
        joints = self.posed(self.read(clip))
        motion = features_of(joints, clip.fps, self.layout, same_bones=self.config.retarget)
        return Sample(self.clip_meta(clip, motion, joints), motion, texts=list(clip.entry.texts))

    def clip_meta(
        self, clip: ReleaseClip, motion: NDArray[np.float32], joints: NDArray[np.float64], **facts: bool
    ) -> ClipMeta:
        seen = SourceJoints(joints, clip.fps)
        return self.meta(
            clip,
            motion,
            seen=seen,
            source=clip.label(),
            licence=clip.licence,
            mirror_of=clip.entry.mirror_of,
            **facts,
        )


def _below(source: Path, paths: Iterable[Path]) -> list[str]:
    """The names of files in the source."""
    return [path.relative_to(source).as_posix() for path in paths if path.is_relative_to(source)]
