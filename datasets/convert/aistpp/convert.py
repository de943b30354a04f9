"""AIST++ -> shards: SMPL dances at 60 fps with their music (UDE section 4.1).

Choices:
- Metres are smpl_trans / smpl_scaling. The floor of the source is anywhere: like every other source, a clip
  is moved to the canonical place (floor 0, first root above the origin, first heading +Z).
- `smpl75` keeps the parameters, turned and moved to that place (`common/features.py`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import VERSION, AudioSettings
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
from motionloom.datasets.convert.common.features import body_of, canonical_smpl75, features_of, require_human
from motionloom.datasets.convert.common.files import inside
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.convert.common.music import cut_of
from motionloom.datasets.convert.common.plan import ConversionPlan
from motionloom.datasets.motion.body.smpl import smpl_joints
from motionloom.datasets.motion.features.smpl75 import SMPL_JOINTS
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
        self._audio = config.audio_settings() if config.music != "none" else None

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
        rows, wav = None, None
        if clip.sound is not None:
            start, seconds = self.config.music_offset, len(motion) / layout.fps
            rows, wav = cut_of(self.config, self.config.sound_folder, clip.sound, start, seconds)
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
