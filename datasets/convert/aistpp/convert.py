"""AIST++ -> shards: SMPL dances at 60 fps with their music (UDE section 4.1).

Choices:
- Metres are smpl_trans / smpl_scaling. The floor of the source is anywhere: like every other source, a clip
  is moved to the canonical place (floor 0, first root above the origin, first heading +Z).
- `body133` and `h3d263` are made from the joints of the SMPL parameters. `smpl75` keeps the parameters: the
  root's orientation and translation are turned and moved so that forward kinematics of the stored columns
  gives just those canonical joints; rotations are resampled on the sphere and stored as the shortest
  axis-angle (at most pi).
- Audio features are made once for a whole piece of music and cut to the motion; row 0 belongs to frame 0.
  Beats and loudness are then the piece's, not the cut's. Many sequences share a piece, so each worker keeps
  the last ones.
- Music is the condition, so clips have no captions unless `caption_genre` asks for one.
"""

from __future__ import annotations

from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import VERSION, AudioSettings, audio_features
from motionloom.datasets.audio.sound import read_sound, resample_sound
from motionloom.datasets.base.files import sha256_of_json
from motionloom.datasets.convert.aistpp.pickle_reader import read_aist_motion
from motionloom.datasets.convert.aistpp.plan import (
    FPS,
    MOTION_LICENCE,
    MOTIONS,
    MUSIC_LICENCE,
    AistClip,
    AistppConfig,
    genre_of,
    plan_aistpp,
)
from motionloom.datasets.convert.common.conversion import Conversion
from motionloom.datasets.convert.common.features import body_of, features_of, require_human
from motionloom.datasets.convert.common.files import inside
from motionloom.datasets.convert.common.look import SourceJoints
from motionloom.datasets.motion.canonical import canonicalize, facing, resample, resample_quaternions
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.motion.smpl import BodyModel, smpl_joints
from motionloom.datasets.schema import Caption, UserError
from motionloom.datasets.shards.sample import Sample

if TYPE_CHECKING:
    import torch

__all__ = ["AistppConfig", "canonical_smpl75", "convert_clip", "plan_aistpp", "prepare_aistpp"]

CONVERTER = "aistpp"
CONVERTER_VERSION = 1

SMPL_JOINTS = 24
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


def prepare_aistpp(config: AistppConfig, *, workers: int = 1, progress: bool = False) -> Conversion[AistClip]:
    """Look at the whole source and decide what becomes of every file; nothing is converted yet."""
    body, settings = body_of(config.body_model, "smpl22"), audio_settings(config)
    plan = plan_aistpp(config, progress=progress)
    content = []
    for _, clip in plan.items:
        size = (config.source / clip.label()).stat().st_size
        sound = (config.sound_folder / clip.sound).stat().st_size if clip.sound else 0
        content.append([clip.id, clip.split, clip.used, size, clip.sound, sound])
    options = config.options("splits", "ignore_list", "music_folder")
    options |= {"body_model": body.statement, "source_sha256": sha256_of_json(content)}
    options["audio_version"] = VERSION if settings else None
    return Conversion(
        config=config,
        plan=plan,
        convert=partial(convert_clip, config, body),
        licence=config.licence or (MUSIC_LICENCE if config.stores_music else MOTION_LICENCE),
        converter=CONVERTER,
        version=CONVERTER_VERSION,
        options=options,
        audio=settings.dump() if settings else None,
        see=partial(see_clip, config, body),
        subset_of=lambda clip: genre_of(clip.id),
    )


def see_clip(config: AistppConfig, body: BodyModel, clip: AistClip) -> SourceJoints:
    """The joints of one dance, as far as it is used."""
    poses, trans = _read_dance(config, clip)
    return SourceJoints(smpl_joints(poses[:, :BODY_JOINTS], trans, body), FPS)


def audio_settings(config: AistppConfig) -> AudioSettings | None:
    """Settings of the audio features to store; None for none."""
    if not config.audio_features or config.music == "none":
        return None
    return AudioSettings.parse({"fps": config.audio_fps or config.fps}, "audio features")


def convert_clip(config: AistppConfig, body: BodyModel, clip: AistClip) -> Sample:
    """Read one sequence and its music. `UserError` for what cannot be a person's motion, or is not sound."""
    layout = config.motion_layout()
    poses, trans = _read_dance(config, clip)
    joints = smpl_joints(poses[:, :BODY_JOINTS], trans, body)
    require_human(joints, FPS)
    if layout.family == "raw":
        motion = canonical_smpl75(poses, trans, body, FPS, layout.fps)
    else:
        motion = features_of(joints, FPS, layout)
    features, wav = None, None
    if clip.sound is not None:
        features, wav = music_of_clip(config, clip.sound, len(motion))
    meta = layout.clip_meta(
        clip.id,
        source=clip.label(),
        split=clip.split,
        frames=len(motion),
        licence=clip.licence,
        has_hands=False,
        has_face=False,
    )
    texts = [_genre_caption(clip.id)] if config.caption_genre else []
    return Sample(meta=meta, motion=motion, texts=texts, audio=features, wav=wav)


def _read_dance(config: AistppConfig, clip: AistClip) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Axis-angles [T, 24, 3] and translation [T, 3] in metres of the frames that are used."""
    label = clip.label()
    source = read_aist_motion(inside(config.source / MOTIONS, f"{clip.id}.pkl", label), label)
    if len(source.poses) != clip.frames:
        raise UserError(f"{label}: {len(source.poses)} frames, {clip.frames} when the plan was made")
    poses = source.poses[: clip.used].reshape(-1, SMPL_JOINTS, 3).astype(np.float64)
    return poses, np.asarray(source.metres()[: clip.used], dtype=np.float64)


def canonical_smpl75(
    poses: NDArray[Any], trans: NDArray[Any], body: BodyModel, fps_in: float, fps_out: float
) -> NDArray[np.float32]:
    """SMPL parameters -> canonical columns [T', 75]: translation 3, then 24 x 3 axis-angle.

    `poses` [T, 24, 3] radians and `trans` [T, 3] metres at `fps_in`. `smpl_joints` of the result with the
    same body gives joints with the floor at 0, the first root above the origin and the first heading +Z.
    """
    import roma
    import torch

    turns = roma.rotvec_to_unitquat(torch.from_numpy(np.asarray(poses, dtype=np.float64))).numpy()
    turns = torch.from_numpy(resample_quaternions(turns, fps_in, fps_out))
    trans = resample(np.asarray(trans, dtype=np.float64), fps_in, fps_out)
    joints = smpl_joints(_rotvecs(turns[:, :BODY_JOINTS]), trans, body)
    back = roma.rotvec_to_unitquat(torch.tensor([0.0, -float(facing(joints[:1])[0]), 0.0], dtype=turns.dtype))
    turns[:, 0] = roma.quat_product(back.expand(len(turns), 4), turns[:, 0])
    out = np.empty((len(turns), 3 + 3 * SMPL_JOINTS))
    out[:, :3] = canonicalize(joints)[:, 0] - body.rest_joints()[0]  # the root stands at rest pelvis + trans
    out[:, 3:] = _rotvecs(turns).reshape(len(turns), -1)
    return out.astype(np.float32)


def _rotvecs(turns: torch.Tensor) -> NDArray[np.float64]:
    """Unit quaternions [..., 4] -> axis-angle [..., 3] of at most pi."""
    import roma

    return np.asarray(roma.unitquat_to_rotvec(turns, shortest_arc=True).numpy(), dtype=np.float64)


def music_of_clip(
    config: AistppConfig, sound: str, frames: int
) -> tuple[NDArray[np.float32] | None, tuple[NDArray[np.float32], int] | None]:
    """The part of a piece that a clip of `frames` dances to.

    Audio features [T_audio, 438] (`audio_fps` rows a second, as long as the motion) and (samples, rate).
    """
    settings = audio_settings(config)
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


def _genre_caption(sequence: str) -> Caption:
    genre = genre_of(sequence)
    return Caption(text=f"a dancer performs {GENRES.get(genre, f'{genre} dance')}", source="genre")
