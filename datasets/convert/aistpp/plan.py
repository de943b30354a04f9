"""AIST++ conversion, planning: options, and a plan of what becomes of every file of the source.

Every annotation that is not left out anyway is read (a file is small, and only its content says how long it
is and whether it can be used); of the music only the headers are.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import Field
from rich.progress import track

from motionloom.datasets.audio.sound import sound_seconds
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import frames_after
from motionloom.datasets.convert.common.files import inside
from motionloom.datasets.convert.common.music import SOUND_SUFFIXES, SoundConfig
from motionloom.datasets.convert.common.plan import ConversionPlan, drop
from motionloom.datasets.convert.common.splits import hash_split, join_splits, read_ids
from motionloom.datasets.schema import SPLITS, Dropped, Split, UserError

_SUFFIXES = (".json", ".pkl")


@dataclass(frozen=True)
class SequenceLists:
    """What the lists say."""

    splits: dict[str, Split] = field(default_factory=dict)
    ignored: frozenset[str] = frozenset()
    notes: tuple[str, ...] = ()


def read_lists(config: AistppConfig) -> SequenceLists:
    """Read `crossmodal_{train,val,test}.txt` (else `{train,val,test}.txt`) of a folder, and an ignore list.

    A sequence in two splits is a `UserError` that names both files. Absent lists are noted, or an error where
    the options name them.
    """
    splits = config.splits or config.source / "splits"
    ignore_list = config.ignore_list or config.source / "ignore_list.txt"
    lists: list[tuple[Split, Path]] = []
    absent: list[str] = []
    for split in SPLITS:
        paths = [splits / f"crossmodal_{split}.txt", splits / f"{split}.txt"]
        here = [(split, path) for path in paths if path.is_file()][:1]
        lists += here
        absent += [] if here else [paths[0].name]
    found, notes = join_splits(lists, _SUFFIXES)
    if config.splits and not lists:
        raise UserError(f"{splits}: no crossmodal_train.txt, crossmodal_val.txt or crossmodal_test.txt")
    if not lists:
        notes.append("no split files: split 80/5/15 by a hash of the music")
    elif absent:
        notes.append(f"no {', '.join(absent)} beside the other split files")
    ignored: dict[str, int] = {}
    if ignore_list.is_file():
        ignored, found_notes = read_ids(ignore_list, _SUFFIXES)
        notes += found_notes
    elif config.ignore_list:
        raise UserError(f"{ignore_list}: no such file")
    else:
        notes.append("no ignore_list.txt: bad sequences of the release are not left out")
    both = sorted(found.keys() & ignored.keys())
    if both:
        notes.append(
            f"{len(both)} sequences of the split files are on the ignore list: {', '.join(both[:3])}"
        )
    return SequenceLists(found, frozenset(ignored), tuple(notes))


FPS = 60.0
MOTION_LICENCE = "CC-BY-4.0"
MUSIC_LICENCE = "CC-BY-4.0 AND LicenseRef-AIST-Dance-DB"
"""Annotations: CC BY 4.0. Music: the terms of use of the AIST Dance Video Database, which no converter can
grant; shards that hold sound, or features made from it, stand under both.
"""
MOTIONS = "motions"

SEQUENCE = re.compile(r"g([A-Z]{2})_s([A-Z]{2})_c(?:All|\d\d)_d(\d+)_m([A-Z]{2}\d+)_ch(\d+)")
"""Genre, situation (BM basic, FM advanced), dancer, music, choreography."""


class AistppConfig(SoundConfig):
    """Options of the AIST++ converter; `source` is the folder of the annotations, with motions/ in it."""

    layouts = ("body133", "h3d263", "smpl75")

    name: str = "aistpp"
    """Name of the data set; part of the shards' file names."""
    layout: str = "body133"
    """`body133` or `h3d263` from the joints, or `smpl75`: UDE's translation and axis-angles."""
    fps: float = Field(default=20.0, gt=0, le=240)
    """Frame rate of the shards; the source has 60."""
    splits: Path | None = None
    """Folder of crossmodal_train.txt, _val.txt and _test.txt; default: splits/ in the source."""
    unlisted: Literal["drop", "hash"] = "drop"
    """Sequences in no split file: left out, or split 80/5/15 by a hash of their music."""
    ignore_list: Path | None = None
    """List of bad sequences; default: ignore_list.txt in the source."""
    music: Literal["require", "optional", "none"] = "require"
    """Whether a sequence needs its music; `none` converts the motion alone."""
    music_folder: Path | None = None
    """Folder of `<sequence>.wav` or `<music>.wav` (also flac, mp3, ogg); default: wavs/ in the source."""
    music_offset: float = Field(default=0.0, ge=0)
    """Second of the music at which the motion begins."""
    caption_genre: bool = False
    """Give every clip the caption "a dancer performs ...", by the genre in its name."""
    body_model: Path | None = None
    """SMPL model (.npz) for the bone lengths; default: the package's neutral skeleton."""

    @property
    def sound_folder(self) -> Path:
        return self.music_folder or self.source / "wavs"

    @property
    def stores_music(self) -> bool:
        return self.music != "none" and (self.audio_features or self.sound_rate > 0)


@dataclass(frozen=True)
class AistClip:
    """A clip of the plan."""

    id: str
    split: Split
    frames: int
    """Frames in the file, at 60 a second."""
    used: int
    """Frames before the music ends."""
    sound: str | None
    """Name of the music file in its folder."""
    licence: str

    @property
    def facts(self) -> dict[str, str | float]:
        genre, situation, dancer, music, choreography = _fields(self.id)
        named = {"genre": genre, "situation": situation, "dancer": dancer, "music": f"m{music}"}
        return {**named, "choreography": choreography, "seconds": self.used / FPS}

    def label(self) -> str:
        return f"{MOTIONS}/{self.id}.pkl"


def music_of(sequence: str) -> str:
    """`mBR0` of `gBR_sBM_cAll_d04_mBR0_ch01`."""
    return "m" + _fields(sequence)[3]


def genre_of(sequence: str) -> str:
    """`BR` of `gBR_sBM_cAll_d04_mBR0_ch01`."""
    return _fields(sequence)[0]


def _fields(sequence: str) -> tuple[str, ...]:
    found = SEQUENCE.fullmatch(sequence)
    if found is None:
        raise UserError(f"'{sequence}' is not an AIST++ name like gBR_sBM_cAll_d04_mBR0_ch01")
    return found.groups()


@dataclass(frozen=True)
class _Music:
    """Music files by name without suffix, their lengths in seconds, and those that cannot be read."""

    files: dict[str, str]
    seconds: dict[str, float]
    broken: list[Dropped]

    def of(self, sequence: str) -> str | None:
        """The file of a sequence: one of its own before the whole piece."""
        return self.files.get(sequence) or self.files.get(music_of(sequence))


def plan_aistpp(config: AistppConfig, settings: PlanSettings) -> ConversionPlan[AistClip]:
    """Find every sequence and decide what becomes of it, without converting anything."""
    layout = config.motion_layout()
    folder = config.source / MOTIONS
    if not folder.is_dir():
        raise UserError(f"{config.source}: no {MOTIONS}/ in it; give the folder of the AIST++ annotations")
    lists = read_lists(config)
    music = _find_music(config)
    names = sorted(path.name for path in folder.iterdir() if path.suffix == ".pkl" and path.name[0] != ".")
    draft = ConversionPlan[AistClip](config, broken=list(music.broken))
    cut = 0
    for name in track(names, "reading the source", disable=not settings.progress):
        label = f"{MOTIONS}/{name}"
        try:
            found = _decide(config, lists, music, name.removesuffix(".pkl"), label)
        except UserError as error:
            draft.fail(label, error)
            continue
        if isinstance(found, str):
            draft.leave_out(label, found)
            continue
        cut += found.used < found.frames
        draft.take(found)
    draft.notes += [*lists.notes, *_notes(config, music, draft.items, cut)]
    draft.limit(AistClip.label)

    present = {name.removesuffix(".pkl") for name in names}
    for sequence, split in lists.splits.items():
        if sequence not in present and sequence not in lists.ignored:
            draft.miss(f"{MOTIONS}/{sequence}.pkl", f"listed in split '{split}', but not here")
    return draft.finish(
        found=len(names),
        frames=lambda clip: frames_after(clip.used, FPS, layout),
        licence=lambda clip: clip.licence,
    )


def _decide(
    config: AistppConfig, lists: SequenceLists, music: _Music, sequence: str, label: str
) -> AistClip | str:
    """The clip to convert, or why it is left out; `UserError` when its file cannot be used at all."""
    _fields(sequence)
    if sequence in lists.ignored:
        return "on the ignore list"
    split = lists.splits.get(sequence)
    if split is None and (config.unlisted == "hash" or not lists.splits):
        # By music: pieces are shared by many dances, and one in two splits would leak.
        split = hash_split(music_of(sequence))
    if split is None:
        return "in no split file"
    sound = None if config.music == "none" else music.of(sequence)
    if sound is not None and sound not in music.seconds:
        sound = None
    if sound is None and config.music == "require":
        return f"no readable music: {sequence} or {music_of(sequence)} in {config.sound_folder.name}/"
    licence = config.licence or (MUSIC_LICENCE if sound and config.stores_music else MOTION_LICENCE)
    problem = config.licence_problem(licence)
    if problem:
        return problem
    frames = len(read_aist_motion(inside(config.source / MOTIONS, f"{sequence}.pkl", label), label).poses)
    used = frames
    if sound is not None:
        seconds = music.seconds[sound] - config.music_offset
        used = min(frames, max(0, int(seconds * FPS + 1e-6)))
        if not used or frames - used > config.max_music_gap * FPS:
            return f"{frames / FPS:.2f} s of motion, but {max(seconds, 0):.2f} s of music in {sound}"
    return config.length_problem(used / FPS) or AistClip(sequence, split, frames, used, sound, licence)


def _find_music(config: AistppConfig) -> _Music:
    music = _Music({}, {}, [])
    folder = config.sound_folder
    if config.music == "none":
        return music
    if not folder.is_dir():
        if config.music == "require" or config.music_folder is not None:
            raise UserError(
                f"{folder}: no such folder of music; name it, --set music_folder=FOLDER, or --set music=none"
            )
        return music
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in SOUND_SUFFIXES or path.name.startswith("."):
            continue
        label = f"{folder.name}/{path.name}"
        music.files.setdefault(path.stem, path.name)
        try:
            music.seconds[path.name] = sound_seconds(inside(folder, path.name, label), label)
        except UserError as error:
            music.broken.append(drop(label, error))
    return music


def _notes(config: AistppConfig, music: _Music, items: list[tuple[Split, AistClip]], cut: int) -> list[str]:
    notes = []
    if cut:
        notes.append(f"{cut} sequences end with their music, at most {config.max_music_gap:g} s early")
    silent = sum(clip.sound is None for _, clip in items)
    if silent and config.music == "optional":
        notes.append(f"{silent} sequences have no music")
    pieces = {split: {music_of(clip.id) for s, clip in items if s == split} for split in SPLITS}
    for split in ("val", "test"):
        shared = sorted(pieces["train"] & pieces[split])
        if shared:
            some = ", ".join(shared[:5]) + (", ..." if len(shared) > 5 else "")
            notes.append(f"{len(shared)} pieces of music are in train and in {split}: {some}")
    return notes
