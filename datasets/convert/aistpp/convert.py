"""AIST++ -> shards: SMPL dances at 60 fps with their music (UDE section 4.1).

Choices:
- Metres are smpl_trans / smpl_scaling. The floor of the source is anywhere: like every other source, a clip
  is moved to the canonical place (floor 0, first root above the origin, first heading +Z).
- `smpl75` keeps the parameters, turned and moved to that place (`common/features.py`).
- Audio features are made once for a whole piece of music and cut to the motion; row 0 belongs to frame 0.
  Beats and loudness are then the piece's, not the cut's.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import VERSION, AudioSettings, audio_features
from motionloom.datasets.audio.sound import read_sound, resample_sound
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.aistpp.plan import (
    FPS,
    MOTION_LICENCE,
    MOTIONS,
    MUSIC_LICENCE,
    AistClip,
    AistppConfig,
    genre_of,
    music_of,
    plan_aistpp,
)
from motionloom.datasets.convert.common.converter import Converter, PlanSettings
from motionloom.datasets.convert.common.features import (
    SMPL_JOINTS,
    body_of,
    canonical_smpl75,
    features_of,
    require_human,
)
from motionloom.datasets.convert.common.files import inside
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.body.smpl import smpl_joints
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.schema import Caption, UserError
from motionloom.datasets.shards.sample import Sample

GENRES = {
    "BR": "break dance",
    "PO": "pop dance",
    "LO": "lock dance",
    "MH": "middle hip-hop",
    "LH": "LA style hip-hop",
    "HO": "house dance",
    "WA": "waack dance",
    "KR": "krump",
    "JS": "street jazz",
    "JB": "ballet jazz",
}
_KEPT_PIECES = 64
"""AIST++ has 60 pieces of music: with their features and sound about 0.3 GB in each worker."""


class Aistpp(Converter[AistppConfig, AistClip]):
    """The AIST++ converter."""

    name = "aistpp"
    title = "AIST++"
    summary = "AIST++: SMPL dances with their music to shards."
    example = "aist_plusplus_final shards"
    config_class = AistppConfig

    def __init__(self, config: AistppConfig) -> None:
        super().__init__(config)
        self.body = body_of(config.body_model, "smpl22")
        self._audio = None
        if config.audio_features and config.music != "none":
            self._audio = AudioSettings.parse({"fps": config.audio_fps or config.fps}, "audio features")

    def plan(self, settings: PlanSettings) -> ConversionPlan[AistClip]:
        return plan_aistpp(self.config, settings)

    def depends_on(self, clip: AistClip) -> list[object]:
        size = (self.config.source / clip.label()).stat().st_size
        sound = (self.config.sound_folder / clip.sound).stat().st_size if clip.sound else 0
        return [clip.id, clip.split, clip.used, size, clip.sound, sound]

    def options(self) -> dict[str, object]:
        version = VERSION if self._audio else None
        return super().options() | {"body_model": self.body.statement, "audio_version": version}

    def licence(self, plan: ConversionPlan[AistClip]) -> str:
        return self.config.licence or (MUSIC_LICENCE if self.config.stores_music else MOTION_LICENCE)

    def audio(self) -> AudioSettings | None:
        return self._audio

    def subset(self, clip: AistClip) -> str:
        return genre_of(clip.id)

    def joints(self, clip: AistClip) -> SourceJoints:
        poses, trans = self._read_dance(clip)
        return SourceJoints(smpl_joints(poses[:, :BODY_JOINTS], trans, self.body), FPS)

    def convert(self, clip: AistClip) -> Sample:
        layout = self.layout
        poses, trans = self._read_dance(clip)
        joints = smpl_joints(poses[:, :BODY_JOINTS], trans, self.body)
        require_human(joints, FPS)
        if layout.family == "raw":
            motion = canonical_smpl75(poses, trans, self.body, FPS, layout.fps)
        else:
            motion = features_of(joints, FPS, layout)
        rows, wav = self._music(clip.sound, len(motion)) if clip.sound is not None else (None, None)
        texts = []
        if self.config.caption_genre:
            genre = genre_of(clip.id)
            text = f"a dancer performs {GENRES.get(genre, f'{genre} dance')}"
            texts.append(Caption(text=text, source="genre"))
        meta = self.meta(clip, motion, licence=clip.licence).model_copy(update={"song": music_of(clip.id)})
        return Sample(meta=meta, motion=motion, texts=texts, audio=rows, wav=wav)

    def _read_dance(self, clip: AistClip) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Axis-angles [T, 24, 3] and translation [T, 3] in metres of the frames that are used."""
        label = clip.label()
        source = read_aist_motion(inside(self.config.source / MOTIONS, f"{clip.id}.pkl", label), label)
        if len(source.poses) != clip.frames:
            raise UserError(f"{label}: {len(source.poses)} frames, {clip.frames} when the plan was made")
        poses = source.poses[: clip.used].reshape(-1, SMPL_JOINTS, 3).astype(np.float64)
        return poses, np.asarray(source.metres()[: clip.used], dtype=np.float64)

    def _music(
        self, sound: str, frames: int
    ) -> tuple[NDArray[np.float32] | None, tuple[NDArray[np.float32], int] | None]:
        """The part of a piece that a clip of `frames` dances to.

        Audio features [T_audio, 438] (`audio_fps` rows a second, as long as the motion) and (samples, rate).
        """
        config, settings = self.config, self._audio
        features, samples = piece_of_music(config.sound_folder, sound, settings, config.sound_rate)
        seconds = frames / config.fps
        rows: NDArray[np.float32] | None = None
        if features is not None and settings is not None:
            first = round(config.music_offset * settings.fps)
            count = max(1, round(seconds * settings.fps))
            # The last frame may lie at the very end of the music, past the last row by a rounding.
            rows = features[np.minimum(np.arange(first, first + count), len(features) - 1)]
        if samples is None:
            return rows, None
        start = round(config.music_offset * config.sound_rate)
        return rows, (samples[start : start + round(seconds * config.sound_rate)], config.sound_rate)


@lru_cache(maxsize=_KEPT_PIECES)
def piece_of_music(
    folder: Path, sound: str, settings: AudioSettings | None, rate: int
) -> tuple[NDArray[np.float32] | None, NDArray[np.float32] | None]:
    """Features of a whole music file (where settings are given), and its samples at `rate` (unless 0)."""
    if settings is None and not rate:
        return None, None
    label = f"{folder.name}/{sound}"
    samples, found = read_sound(inside(folder, sound, label), label)
    features = None if settings is None else audio_features(samples, found, settings)
    kept = resample_sound(samples, found, rate) if rate else None
    for shared in (features, kept):
        if shared is not None:
            shared.setflags(write=False)  # every clip of the piece gets the same array
    return features, kept
