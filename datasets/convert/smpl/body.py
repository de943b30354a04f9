"""`BodyRelease`: sets of SMPL, SMPL-H or SMPL-X parameters, with the sound that people dance or speak to.

Audio features are made once for a whole piece and cut to the motion; row 0 belongs to frame 0. Beats and
loudness are then the piece's, not the cut's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import ClassVar, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from motionloom.datasets.audio.features import VERSION, AudioSettings, audio_features, rows_at
from motionloom.datasets.audio.same_sound import NO_LANDMARKS, Landmarks, landmarks, same_pieces
from motionloom.datasets.audio.sound import Sound, read_sound, resample_sound, sound_seconds
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.memory import content_of
from motionloom.datasets.base.records import Fault, Split
from motionloom.datasets.convert.common.config import END_TOLERANCE
from motionloom.datasets.convert.common.converter import PlanSettings
from motionloom.datasets.convert.common.features import canonical_smpl75, features_of, require_human, upright
from motionloom.datasets.convert.common.files import inside, read_in_threads
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.convert.common.release import Entry, Figure, Release, ReleaseClip, ReleaseConfig
from motionloom.datasets.convert.smpl.smpl_npz import read_motion, read_motion_header
from motionloom.datasets.motion.body.smpl import BodyModel, SkeletonName, smpl_joints
from motionloom.datasets.motion.features.smpl75 import SMPL_JOINTS
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.shards.sample import Sample

SOUND_SUFFIXES = (".wav", ".flac", ".mp3", ".ogg")
_LISTENERS = 4
"""Threads that look for one piece of music in two files; each takes at most some 200 MB."""
FINGERS_MOVE = 1e-3
"""Radians. Fingers that turn less than this over a clip were not captured, but set to one pose."""
_KEPT_PIECES = 64
"""AIST++ has 60 pieces of music: with their features and sound about 0.3 GB in each worker."""

Wav = tuple[NDArray[np.float32], int]
"""Samples and their rate."""


SILENT = 1e-3
"""Largest sample of a sound that nobody hears: 60 dB below the loudest that a file holds."""
SOURCE_FPS = 30.0
"""Frame rate of all these sets, where a file states none."""


class BodyConfig(ReleaseConfig):
    """Options of sets of body model parameters, with sound."""

    layouts: ClassVar[tuple[str, ...]] = ("body133", "wholebody313", "h3d263", "tomato623", "smpl75")

    body_model: Path | None = None
    """Your body model (.npz), for bones by each clip's shape; else those of one neutral adult."""
    up: Literal["y", "z"] = "y"
    """The axis that points up in the files."""
    sound: Literal["optional", "require", "none"] = "optional"
    """Whether a clip needs its music or speech; `none` converts the motion alone."""
    max_music_gap: float = Field(default=1.0, ge=0)
    """Seconds of motion that may be cut where the sound ends first; beyond that the clip is left out."""
    audio_features: bool = True
    """Store the 438 audio features."""
    audio_fps: float | None = Field(default=None, gt=0)
    """Rows of audio features a second that the music is analysed at, each stored for all motion frames
    nearest to it; default: one for every motion frame. Bailando's release hears 7.5."""
    sound_rate: int = Field(default=16_000, ge=0, le=192_000)
    """Sample rate at which the sound itself is stored; 0 leaves it out."""

    def audio_settings(self) -> AudioSettings | None:
        """Settings of the features; None where none are wanted."""
        if not self.audio_features:
            return None
        return AudioSettings.parse({"fps": self.audio_fps or self.fps}, "audio features")


Cfg = TypeVar("Cfg", bound=BodyConfig)


class BodyRelease(Release[Cfg]):
    """A set of SMPL, SMPL-H or SMPL-X parameters."""

    model: ClassVar[Literal["SMPL", "SMPL-H", "SMPL-X"]]
    """Body model whose shapes and rest pose the parameters mean."""

    def __init__(self, config: Cfg) -> None:
        super().__init__(config)
        model = config.body_model
        skeleton = cast("SkeletonName", self.layout.skeleton_name)
        self.body = BodyModel.load(model, skeleton) if model else BodyModel.neutral(skeleton)
        found = self.body.statement["kind"]
        if config.body_model is not None and found != self.model:
            raise UserError(
                f"{config.body_model}: a body model of {found}; {self.title} has parameters of {self.model}"
            )
        self._audio = config.audio_settings() if config.sound != "none" else None
        self._sounds: dict[str, float] = {}
        """Seconds of every sound file that can be read."""
        self.sound_folder = config.source
        """Folder that `entry.sound` is relative to."""
        self._cut = 0
        """Clips that end with their sound."""
        self._longer: list[float] = []
        """Seconds by which sounds go on after the motion."""

    def length(self, path: Path, label: str) -> tuple[int, float]:
        header = read_motion_header(path, label)
        if header.kind != self.model:
            raise UserError(f"{label}: parameters of {header.kind}; {self.title} has those of {self.model}")
        return header.frames, header.fps or SOURCE_FPS

    def figure(self, clip: ReleaseClip) -> Figure:
        return read_motion(self.path_of(clip.entry.file), clip.entry.file, hands=True)

    def options(self) -> dict[str, object]:
        version = VERSION if self._audio else None
        return super().options() | {"body_model": self.body.statement, "audio_version": version}

    def audio(self) -> dict[str, object] | None:
        return self._audio.dump() if self._audio else None

    def plan(self, settings: PlanSettings) -> ConversionPlan[ReleaseClip]:
        plan = super().plan(settings)
        if self._cut:
            gap = self.config.max_music_gap
            plan.notes.append(f"{self._cut} clips end with their sound, at most {gap:g} s early")
        if self._longer:
            count = len(self._longer)
            most = max(self._longer)
            plan.notes.append(
                f"the sound of {count} clips goes on after the motion, {most:.1f} s at most; cut"
            )
        return plan

    def with_sound(self, entries: Sequence[Entry], draft: ConversionPlan[ReleaseClip]) -> Iterable[Entry]:
        silent = 0
        lengths = self._sounds
        folder = "" if self.sound_folder == self.config.source else f"{self.sound_folder.name}/"
        for sound in dict.fromkeys(entry.sound for entry in entries if self.config.sound != "none"):
            if sound is not None:
                label = f"{folder}{sound}"
                with draft.reading(label):
                    lengths[sound] = sound_seconds(inside(self.sound_folder, sound, label), label)
        for entry in entries:
            sound = entry.sound if entry.sound in lengths else None
            silent += sound is None and self.config.sound != "none"
            problem = entry.problem
            if sound is None and self.config.sound == "require":
                problem = problem or f"no readable sound ({entry.sound or 'none is listed'})"
            facts = {**entry.facts, "sound": float(sound is not None)}
            yield replace(entry, sound=sound, facts=facts, problem=problem)
        if silent:
            draft.notes.append(f"{silent} of {len(entries)} clips have no sound")

    def cut_to_sound(self, entry: Entry, last: int, fps: float) -> tuple[int, str]:
        if entry.sound is None:
            return last, ""
        seconds = self._sounds[entry.sound]
        end = min(last, int(seconds * fps + 1e-6))
        if entry.last is None and seconds > last / fps + END_TOLERANCE:  # the whole file, no part of it
            self._longer.append(seconds - last / fps)
        if last - end <= self.config.max_music_gap * fps:
            self._cut += end < last
            return end, ""
        return end, f"{last / fps:.2f} s of motion, but {seconds:.2f} s of sound in {entry.sound}"

    def depends_on(self, clip: ReleaseClip) -> list[object]:
        sound = clip.entry.sound
        content = content_of(self.sound_folder / sound) if sound else ""
        return [*super().depends_on(clip), sound, content]

    def copies(self, plan: ConversionPlan[ReleaseClip]) -> list[str]:
        heard: dict[str, dict[str, Split]] = {}
        for split, clip in plan.items:
            if clip.entry.sound is not None:
                content = content_of(self.sound_folder / clip.entry.sound)
                heard.setdefault(content, {}).setdefault(clip.entry.sound, split)
        of_one = [list(names) for names in heard.values() if len(names) > 1]
        splits = {name: split for names in heard.values() for name, split in names.items()}
        if self.config.look and len(set(splits.values())) > 1:  # by their sound too, once for the same bytes
            names = [next(iter(same)) for same in heard.values()]
            made = read_in_threads(self._landmarks, names, workers=_LISTENERS, progress=False)
            of_one += map(list, same_pieces(dict(zip(names, made, strict=True))))
        notes = []
        for names in of_one:
            places = ", ".join(sorted({splits[name] for name in names}))
            notes.append(f"{' and '.join(names)} are one piece of music, in {places}")
        return notes + super().copies(plan)

    def _landmarks(self, sound: str) -> Landmarks:
        """Return the landmarks of a sound; none where it cannot be read, as its clips' reason says."""
        try:
            return landmarks(Sound.read(self.sound_folder / sound))
        except UserError:
            return NO_LANDMARKS

    def song(self, clip: ReleaseClip) -> str | None:
        """Name of what is heard; clips with the same one dance to the same piece."""
        return clip.entry.sound

    def posed(self, figure: Figure) -> NDArray[np.float64]:
        rotations, trans = self._parameters(figure)
        count = len(self.body.skeleton)
        return smpl_joints(rotations[:, :count], trans, self.body, figure.betas)

    def _parameters(self, figure: Figure) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        assert figure.rotations is not None and figure.trans is not None
        if self.config.up == "z":
            return upright(figure.rotations, figure.trans, self.body)
        return figure.rotations, figure.trans

    def convert(self, clip: ReleaseClip) -> Sample:
        layout = self.layout
        figure = self.read(clip)
        joints = self.posed(figure)
        if layout.family == "raw":
            require_human(joints, clip.fps)
            rotations, trans = self._parameters(figure)
            poses = rotations
            if self.model != "SMPL":  # whose two hand joints the other models do not have
                palms = np.zeros((len(trans), SMPL_JOINTS - BODY_JOINTS, 3))
                poses = np.concatenate([rotations[:, :BODY_JOINTS], palms], axis=1)
            motion = canonical_smpl75(poses, trans, self.body, clip.fps, layout.fps)
        else:
            face = figure.face if layout.has("face") else None
            motion = features_of(joints, clip.fps, layout, face=face, same_bones=self.config.retarget)
        assert figure.rotations is not None
        fingers = np.ptp(figure.rotations[:, BODY_JOINTS:], axis=0)
        meta = self.clip_meta(
            clip,
            motion,
            joints,
            hands=layout.num_joints > BODY_JOINTS and float(fingers.max(initial=0.0)) > FINGERS_MOVE,
            face=layout.has("face") and figure.face is not None and bool(figure.face.any()),
        )
        rows = None
        wav = None
        if clip.entry.sound is not None:
            seconds = len(motion) / layout.fps
            start = clip.first / clip.fps
            config = self.config
            piece = piece_of_music(
                self.sound_folder, clip.entry.sound, config.audio_settings(), config.fps, config.sound_rate
            )
            rows, wav = cut_of(config, piece, start, seconds)
        faults = meta.faults or ()
        if wav is not None and np.abs(wav[0]).max(initial=0.0) < SILENT:
            faults += (Fault(kind="silent", text="its sound is silent", weight=1.0),)
        meta = meta.model_copy(update={"song": self.song(clip), "faults": faults})
        return Sample(meta, motion, texts=list(clip.entry.texts), audio=rows, wav=wav)


Piece = tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]
"""Audio features of a whole piece, a row for each frame of the shards, and its samples; None: not kept."""


def cut_of(
    config: BodyConfig, piece: Piece, start: float, seconds: float
) -> tuple[NDArray[np.float32] | None, Wav | None]:
    """Part of a piece, `seconds` from `start` on: audio features [T, 438] and the sound."""
    features, samples = piece
    rows: NDArray[np.float32] | None = None
    if features is not None:
        first = round(start * config.fps)
        count = max(1, round(seconds * config.fps))
        # The last frame may lie at the very end of the music, past the last row by a rounding.
        rows = features[np.minimum(np.arange(first, first + count), len(features) - 1)]
    if samples is None:
        return rows, None
    begin = round(start * config.sound_rate)
    return rows, (samples[begin : begin + round(seconds * config.sound_rate)], config.sound_rate)


@lru_cache(maxsize=_KEPT_PIECES)
def piece_of_music(folder: Path, sound: str, settings: AudioSettings | None, fps: float, rate: int) -> Piece:
    """Features of a whole music file at `fps` (where settings are given), samples at `rate` (unless 0)."""
    if settings is None and not rate:
        return None, None
    label = f"{folder.name}/{sound}"
    return analyse(*read_sound(inside(folder, sound, label), label), settings, fps, rate)


def analyse(
    samples: NDArray[np.float32], found: int, settings: AudioSettings | None, fps: float, rate: int
) -> Piece:
    """The same of samples [S], `found` a second."""
    features = None
    if settings is not None:
        analysed = audio_features(samples, found, settings)
        features = rows_at(analysed, settings.fps, fps, round(len(analysed) * fps / settings.fps))
    kept = resample_sound(samples, found, rate) if rate else None
    for shared in (features, kept):
        if shared is not None:
            shared.setflags(write=False)  # every clip of the piece gets the same array
    return features, kept
