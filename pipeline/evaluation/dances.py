"""Clips with music: what they dance, what they dance to, and when its beats are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from motionloom.datasets.audio.features import beats as track_beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.motion.joints import joints_of
from motionloom.datasets.schema import UserError
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.synth.dance_plan import beats_of
from motionloom.pipeline.render.score import Score, Segment

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
        """Its length."""
        return len(self.joints) / self.fps

    @property
    def title(self) -> str:
        """What is danced, for people."""
        genre = (self.truth or {}).get("genre")
        return f"{genre}, song {self.song}" if genre else self.song

    def score(self) -> Score:
        """The music for a page or a film."""
        return Score(self.sound, self.beats.tolist(), (Segment(0.0, self.seconds, self.title, "music"),))

    def cut(self, frames: int) -> DanceClip:
        """Its first `frames`."""
        seconds = frames / self.fps
        inside = self.beats[self.beats < seconds]
        sound = self.sound.slice(0.0, seconds)
        music = None if self.music is None else self.music[:frames]
        return replace(self, joints=self.joints[:frames], sound=sound, beats=inside, music=music)


def with_music(dataset: ClipDataset) -> NDArray[np.bool_]:
    """Clips that hold their sound, [n]."""
    return dataset.has(SOUND)


def dance_at(
    dataset: ClipDataset, index: int, *, unit: int = 1, seconds: float | None = None
) -> DanceClip | None:
    """The clip with music at `index`, cut to whole units of frames and to at most `seconds`.

    None where it holds no sound, or where not one unit of it has some.
    """
    stored = dataset.wav(index)
    if stored is None:
        return None
    sound = Sound(np.clip(stored[0], -1.0, 1.0), stored[1])
    fps, motion = dataset.layout.fps, np.asarray(dataset.motion(index))
    most = sound.seconds if seconds is None else min(seconds, sound.seconds)
    # Sound may end within its last frame.
    frames = min(len(motion), int(np.ceil(most * fps - 1e-6))) // unit * unit
    if frames < 1:
        return None
    truth = dataset.meta(index).truth
    song, rows = (truth or {}).get("song"), dataset.audio(index)
    clip = DanceClip(
        index,
        dataset.ids[index],
        dataset.ids[index] if song is None else str(song),
        joints_of(motion[:frames], dataset.layout),
        fps,
        sound,
        _beats(truth, sound),
        truth,
        None if rows is None or len(rows) != len(motion) else rows,
    )
    return clip.cut(frames)


def dances_of(
    dataset: ClipDataset, count: int, *, unit: int = 1, seconds: float | None = None
) -> list[DanceClip]:
    """At most `count` clips with music, different songs first, in the order of the data set.

    The same data give the same clips.
    """
    order = np.random.default_rng(0).permutation(np.flatnonzero(with_music(dataset)))
    seen: set[str] = set()
    first: list[int] = []
    rest: list[int] = []
    for index in order.tolist():
        song = str((dataset.meta(index).truth or {}).get("song", dataset.ids[index]))
        (rest if song in seen else first).append(index)
        seen.add(song)
    found = (dance_at(dataset, i, unit=unit, seconds=seconds) for i in sorted((first + rest)[:count]))
    return [clip for clip in found if clip is not None]


def require_dances(dataset: ClipDataset) -> None:
    """Refuse a split without music."""
    if not with_music(dataset).any():
        raise UserError(
            f"{dataset.where}: no clip of split '{dataset.split}' holds its sound; dances are evaluated on "
            f"clips with music (synthetic ones: data.dances with sound: true)"
        )


def _beats(truth: Mapping[str, Any] | None, sound: Sound) -> NDArray[np.float64]:
    if truth is not None and {"bpm", "first_beat"} <= truth.keys():
        return np.asarray(beats_of(dict(truth), sound.seconds), dtype=np.float64)
    return track_beats(sound.samples, sound.rate)
