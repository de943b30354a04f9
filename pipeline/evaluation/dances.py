"""Clips with music: what they dance, what they dance to, and when its beats are."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.actions.dances import beats_of
from motionloom.datasets.audio.features import beats as track_beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.base.errors import UserError
from motionloom.datasets.motion.features.joints import joints_of
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.pipeline.evaluation.truth import different_first
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.render.sound import Score, Segment

SOUND = "audio.flac"
"""The member of a clip that holds its sound."""


@dataclass(frozen=True, eq=False)
class DanceClip:
    """A clip with music, both cut to one length."""

    index: int
    """Its number in the data set."""
    id: str
    song: str
    """Clips to one song have one name here; the clip's own id where the data do not say."""
    motion: NDArray[np.float32]
    """Features [T, D] as the data store them."""
    joints: NDArray[np.float64]
    """[T, N, 3] in metres."""
    fps: float
    sound: Sound
    beats: NDArray[np.float64]
    """Seconds of the music's beats: from the truth where it is known, else tracked in the sound."""
    truth: Mapping[str, Any] | None
    music: NDArray[np.float32] | None = None
    """Features of the music [T, 438] as the data store them: of the whole piece, as training hears it."""

    @property
    def seconds(self) -> float:
        return len(self.joints) / self.fps

    @property
    def title(self) -> str:
        """Genre and song, for people."""
        genre = (self.truth or {}).get("genre")
        return f"{genre}, song {self.song}" if genre else self.song

    def score(self) -> Score:
        """The music for a page."""
        return Score(self.sound, self.beats.tolist(), (Segment(0.0, self.seconds, self.title, "music"),))

    def cut(self, frames: int) -> DanceClip:
        """The first `frames` of the clip, with their sound and beats."""
        seconds = frames / self.fps
        inside = self.beats[self.beats < seconds]
        sound = self.sound.slice(0.0, seconds)
        music = None if self.music is None else self.music[:frames]
        motion = self.motion[:frames]
        joints = self.joints[:frames]
        return replace(self, motion=motion, joints=joints, sound=sound, beats=inside, music=music)

    def after(self, frames: int) -> DanceClip:
        """The clip without its first `frames`, with the sound and beats that remain."""
        if not frames:
            return self
        seconds = frames / self.fps
        return replace(
            self,
            motion=self.motion[frames:],
            joints=self.joints[frames:],
            sound=self.sound.slice(seconds),
            beats=self.beats[self.beats >= seconds] - seconds,
            music=None if self.music is None else self.music[frames:],
        )


def with_music(dataset: ClipDataset) -> NDArray[np.bool_]:
    """Clips that hold their sound, [n]."""
    return dataset.has(SOUND)


def dance_at(
    dataset: ClipDataset, index: int, *, unit: int = 1, seconds: float | None = None
) -> DanceClip | None:
    """The clip with music at `index`, cut to whole units and `seconds`; None if no unit has sound."""
    stored = dataset.wav(index)
    if stored is None:
        return None
    sound = Sound(np.clip(stored[0], -1.0, 1.0), stored[1])
    fps = dataset.layout.fps
    motion = np.asarray(dataset.motion(index))
    most = sound.seconds if seconds is None else min(seconds, sound.seconds)
    # Sound may end within its last frame.
    frames = min(len(motion), int(np.ceil(most * fps - 1e-6))) // unit * unit
    if frames < 1:
        return None
    truth = dataset.meta(index).truth
    if truth is not None and {"bpm", "first_beat"} <= truth.keys():
        beats = np.asarray(beats_of(dict(truth), sound.seconds), dtype=np.float64)
    else:
        beats = track_beats(sound.samples, sound.rate)
    rows = dataset.array(index, "audio.npy")
    clip = DanceClip(
        index,
        dataset.ids[index],
        song_of(dataset, index),
        motion[:frames],
        joints_of(motion[:frames], dataset.layout),
        fps,
        sound,
        beats,
        truth,
        None if rows is None or len(rows) != len(motion) else rows,
    )
    return clip.cut(frames)


def dances_of(
    dataset: ClipDataset, count: int | None, *, unit: int = 1, seconds: float | None = None
) -> list[DanceClip]:
    """Up to `count` clips with music (None: all) in a fixed order, different songs first."""
    # A permutation of a fixed seed spreads the choice over the data set, whatever its order.
    order = np.random.default_rng(0).permutation(np.flatnonzero(with_music(dataset)))
    chosen = different_first(order.tolist(), [song_of(dataset, index) for index in order.tolist()])
    clips = (dance_at(dataset, i, unit=unit, seconds=seconds) for i in sorted(chosen[:count]))
    return [clip for clip in clips if clip is not None]


def song_of(dataset: ClipDataset, index: int) -> str:
    """The song of a clip: the piece that its source names, the synthetic song, else the clip's own id."""
    meta = dataset.meta(index)
    song = meta.song if meta.song is not None else (meta.truth or {}).get("song")
    return dataset.ids[index] if song is None else str(song)


def dances_for(
    bundle: Bundle,
    dataset: ClipDataset,
    count: int | None,
    *,
    seconds: float | None,
    least: int = 1,
    unit: int | None = None,
) -> list[DanceClip]:
    """`dances_of` in lengths that a model can make, at most `seconds` and with `least` frames of its own;
    in whole units of the model, unless another `unit` is given.
    """
    longest = min(seconds or np.inf, bundle.max_seconds)
    frames = least + seed_frames(bundle)
    cut = None if np.isinf(longest) else float(longest)
    clips = dances_of(dataset, count, unit=unit or bundle.generator.unit_frames, seconds=cut)
    return [clip for clip in clips if len(clip.joints) >= frames]


def seed_frames(bundle: Bundle) -> int:
    """Frames of a recording that a model's dance begins with."""
    return bundle.generator.capabilities.seed_frames


def dance_to(bundle: Bundle, clips: Sequence[DanceClip], **drawn: Any) -> list[GeneratedMotion]:
    """Dances to the music of clips, each as long as its clip; `drawn` is for `Request.of`.

    A model that goes on from a motion begins with the clip's own first frames.
    """
    begun = seed_frames(bundle)
    request = Request.of(
        seed_motions=[clip.motion[:begun] for clip in clips] if begun else None,
        sounds=[clip.sound for clip in clips],
        conditions={"audio": [clip.music for clip in clips]},
        seconds=[clip.seconds for clip in clips],
        **drawn,
    )
    return generate(bundle, request)


def require_dances(dataset: ClipDataset) -> None:
    """Refuse a split without music."""
    if not with_music(dataset).any():
        raise UserError(
            f"{dataset.where}: no clip of split '{dataset.split}' holds its sound; dances are evaluated on "
            f"clips with music (synthetic ones: data.dances with sound: true)"
        )


def digest_of_dances(clips: Sequence[DanceClip]) -> str:
    """Tells these dances from others, whatever their data set is called: sha256 of motions and beats."""
    digest = hashlib.sha256()
    for clip in clips:
        digest.update(f"{clip.joints.shape} {clip.fps}".encode())
        digest.update(np.ascontiguousarray(clip.joints, "<f4").tobytes())
        digest.update(np.ascontiguousarray(clip.beats, "<f8").tobytes())
    return digest.hexdigest()


def commonest(clips: Sequence[DanceClip]) -> dict[str, float]:
    """Share of the commonest genre and style: what a guess gets that always says so."""
    out: dict[str, float] = {}
    for name in ("genre", "style"):
        values = [clip.truth[name] for clip in clips if clip.truth and clip.truth.get(name)]
        if values:
            out[name] = max(map(values.count, values)) / len(values)
    return out


def other_songs(clips: Sequence[DanceClip], count: int, seed: int) -> list[list[int]]:
    """For each clip at most `count` clips of other songs, drawn at random; none where there is one song."""
    rng = np.random.default_rng(seed)
    out = []
    for clip in clips:
        apart = [k for k, other in enumerate(clips) if other.song != clip.song]
        out.append(rng.permutation(apart)[:count].tolist())
    return out
