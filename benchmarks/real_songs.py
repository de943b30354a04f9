"""Is a real song followed? Dances on their own songs, on the same beats shifted, and on each other's songs.

    python benchmarks/real_songs.py MODEL /usr/share/games/fretsonfire/data/songs --train SHARDS

Stretches of every song are danced to, from several seeds. The beats are charted by hand (`charted.py` says
where such songs are), and the model does not know them. Beat Align is UDE's (each of the music's beats looks
for the nearest of the dance's), at 60 frames a second.

- *own against shifted*: the score over that of the same beats moved by a random part of a beat; 1 is a dance
  that does not hear. *any octave* takes the best of the beats, every second one and twice as many, for both.
- *own song wins*: pairs of stretches of two songs, each dance scored under both; how often the two dances on
  their own songs have more than on each other's.
- *energy*: rank correlation of the music's loudness and the body's speed, over windows of two seconds.
- *variety*: mean distance of kinetic features of four-second windows of a song's dance, in those of
  recorded dances that are chosen at random (1 is as varied as a medley of them).
- *skating*: share of steps in which a foot slides.

Rivals, with `--train`: a recorded training dance stretched to the tempo of our tracker with its beats on the
song's and repeated, a random training dance, and standing still.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
from bench import Column, arguments, command_line, report
from charted import charted
from numpy.typing import NDArray
from scipy.stats import spearmanr

from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.audio.tracker import track
from motionloom.datasets.motion.canonical import resample
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.datasets.shards.clips import ClipDataset
from motionloom.datasets.shards.reader import ShardDataset
from motionloom.models.metrics.dance import foot_skating
from motionloom.models.metrics.dance_beats import alignment, motion_beats
from motionloom.models.metrics.dance_features import kinetic_features, zero_start
from motionloom.pipeline.evaluation.dances import dance_at, with_music
from motionloom.pipeline.inference.model import MotionModel

Array = NDArray[np.float64]
RATE = 60.0
"""Frames a second that the published measures count in; slower, a motion's beats come half a frame early."""
SIGMA = 3 / RATE
"""Seconds, of UDE's formula."""
SHIFTS = 20


@dataclass(frozen=True, eq=False)
class Stretch:
    """A part of a song that is danced to."""

    song: str
    sound: Sound
    beats: Array
    """Seconds, as they are charted."""
    heard: Array
    """Seconds, our tracker's."""

    @property
    def beat(self) -> float:
        return float(np.median(np.diff(self.beats)))


def stretches(place: Path, most: int, seconds: float) -> list[Stretch]:
    """Parts of each song of a place, spread evenly; those without four beats are left out."""
    out = []
    for name, song, times in charted(place):
        heard = track(song).times
        room = max(0.0, song.seconds - seconds)
        count = min(most, 1 + int(room // seconds))
        for k in range(count):
            begin = room * k / max(1, count - 1)
            inside = [of[(of >= begin) & (of < begin + seconds)] - begin for of in (times, heard)]
            if len(inside[0]) > 3:
                out.append(Stretch(name, song.slice(begin, begin + seconds), *inside))
    return out


def octaves(beats: Array) -> list[Array]:
    """Beats, every second one from the first and from the second on, and twice as many."""
    return [beats, beats[::2], beats[1::2], np.sort(np.concatenate([beats, (beats[1:] + beats[:-1]) / 2]))]


def score(beats: Array, danced: Array, any_octave: bool) -> float:
    found = [alignment(some, danced, "music", SIGMA) for some in (octaves(beats) if any_octave else [beats])]
    return max(found)


def shifted(stretch: Stretch, danced: Array, any_octave: bool, rng: np.random.Generator) -> float:
    """The score of the same beats a random part of a beat later, going round at the end."""
    seconds = stretch.sound.seconds
    moves = rng.uniform(0, stretch.beat, SHIFTS)
    return float(
        np.mean([score(np.sort((stretch.beats + move) % seconds), danced, any_octave) for move in moves])
    )


def energy(joints: Array, fps: float, sound: Sound) -> float:
    """Rank correlation of loudness and speed over windows of two seconds."""
    width = round(2 * fps)
    speed = np.linalg.norm(np.diff(joints, axis=0), axis=-1).mean(1) * fps
    windows = range(0, len(speed) - width + 1, width // 2)
    moving = [speed[k : k + width].mean() for k in windows]
    loud = [
        np.sqrt(np.square(sound.slice(k / fps, (k + width) / fps).samples, dtype=np.float64).mean())
        for k in windows
    ]
    return float(spearmanr(moving, loud).statistic) if np.ptp(moving) else float("nan")


def kinetics(joints: Array, fps: float) -> list[Array]:
    """Kinetic features of windows of four seconds."""
    width = round(4 * fps)
    cut = [joints[k : k + width] for k in range(0, len(joints) - width + 1, width // 2)]
    return [kinetic_features(zero_start(resample(part[:, :BODY_JOINTS], fps, RATE))) for part in cut]


def spread(rows: Sequence[Array], scale: Array) -> float:
    """Mean distance of all pairs, columns in units of `scale`."""
    table = np.stack(rows) / scale
    far = np.linalg.norm(table[:, None] - table[None], axis=-1)
    return float(far[np.triu_indices(len(table), 1)].mean())


class Training:
    """Recorded training dances, and what rivals make of them."""

    def __init__(self, dataset: ClipDataset, count: int = 60) -> None:
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(with_music(dataset)))[:count]
        self.clips = [clip for i in chosen.tolist() if (clip := dance_at(dataset, i)) is not None]
        self.fps = dataset.layout.fps
        rows = [kinetics(clip.joints, self.fps)[0] for clip in self.clips if clip.seconds >= 4]
        self.scale = np.maximum(np.stack(rows).std(0), 1e-6)
        self.variety = spread(rows, self.scale)

    def random(self, stretch: Stretch, rng: np.random.Generator) -> Array:
        """A training dance, and another behind it, until the stretch is full."""
        frames = round(stretch.sound.seconds * self.fps)
        out = []
        while sum(map(len, out)) < frames:
            out.append(self.clips[int(rng.integers(len(self.clips)))].joints[:, :BODY_JOINTS])
        return np.concatenate(out)[:frames]

    def stretched(self, stretch: Stretch, rng: np.random.Generator) -> Array:
        """A training dance whose beats are moved onto those of our tracker, over and over."""
        able = [clip for clip in self.clips if len(clip.beats) > 4]
        clip = able[int(rng.integers(len(able)))]
        frames = round(stretch.sound.seconds * self.fps)
        loop = (len(clip.beats) - 1) // 2 * 2
        numbers = np.interp(
            np.arange(frames) / self.fps, stretch.heard, np.arange(len(stretch.heard)), left=0.0
        )
        at = np.interp(numbers % loop, np.arange(len(clip.beats)), clip.beats) * self.fps
        low = np.clip(np.floor(at).astype(int), 0, len(clip.joints) - 2)
        weight = (at - low)[:, None, None]
        body = clip.joints[:, :BODY_JOINTS]
        return np.asarray((1 - weight) * body[low] + weight * body[low + 1])

    def standing(self, stretch: Stretch, rng: np.random.Generator) -> Array:
        """A first frame that is held."""
        frame = self.clips[int(rng.integers(len(self.clips)))].joints[:1, :BODY_JOINTS]
        return np.repeat(frame, round(stretch.sound.seconds * self.fps), axis=0)


def figures(
    parts: Sequence[Stretch], dances: Sequence[Array], fps: float, training: Training | None, seed: int
) -> dict[str, float]:
    """All figures of one dance for each stretch."""
    rng = np.random.default_rng(seed)
    beats = [motion_beats(resample(dance[:, :BODY_JOINTS], fps, RATE), RATE) for dance in dances]
    out: dict[str, float] = {}
    for name, octave in (("", False), (", any octave", True)):
        own = np.mean([score(part.beats, found, octave) for part, found in zip(parts, beats, strict=True)])
        moved = np.mean([shifted(part, found, octave, rng) for part, found in zip(parts, beats, strict=True)])
        out |= {f"own{name}": float(own), f"shifted{name}": float(moved)}
        out[f"ratio{name}"] = float(own / moved) if moved else 1.0
    under = np.array([[score(part.beats, found, False) for part in parts] for found in beats])
    ahead = [
        (1.0 + np.sign(under[a, a] + under[b, b] - under[a, b] - under[b, a])) / 2
        for a, b in combinations(range(len(parts)), 2)
        if parts[a].song != parts[b].song
    ]
    out["own song wins"] = float(np.mean(ahead)) if ahead else float("nan")
    with_sound = [energy(dance, fps, part.sound) for part, dance in zip(parts, dances, strict=True)]
    out["energy"] = float(np.nanmean(with_sound)) if np.isfinite(with_sound).any() else 0.0
    if training is not None:
        varied = [spread(rows, training.scale) for dance in dances if len(rows := kinetics(dance, fps)) > 1]
        out["variety"] = float(np.mean(varied)) / training.variety
    out["skating"] = float(np.mean([foot_skating(dance, fps) for dance in dances]))
    return out


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("model", help="a run, an export, or a model of the package")
    parser.add_argument("places", type=Path, nargs="+", help="of charted songs")
    parser.add_argument("--train", type=Path, help="shards of dances that it was trained on")
    parser.add_argument("--stretches", type=int, default=2, help="of each song, at most")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--seeds", type=int, default=3)
    args = arguments(parser)
    model = MotionModel.from_pretrained(args.model)
    parts = [part for place in args.places for part in stretches(place, args.stretches, args.seconds)]
    sounds = [part.sound for part in parts]

    def generated(seed: int) -> list[Array]:
        made = model.generate(sounds=sounds, seconds=[sound.seconds for sound in sounds], seed=seed)
        return [np.asarray(motion.joints, np.float64) for motion in made]

    training = Training(ShardDataset.open(args.train, "train")) if args.train else None

    def rival(make: Callable[[Stretch, np.random.Generator], Array]) -> Callable[[int], list[Array]]:
        return lambda seed: [make(part, np.random.default_rng([seed, k])) for k, part in enumerate(parts)]

    rows = {"generated": generated}
    if training is not None:
        rows["training dance, stretched"] = rival(training.stretched)
        rows["random training dance"] = rival(training.random)
        rows["standing"] = rival(training.standing)
    protocol = {"songs": len({part.song for part in parts}), "stretches": len(parts)}
    protocol["seconds each"] = args.seconds
    found = []
    for name, make in rows.items():
        each = [figures(parts, make(seed), model.fps, training, seed) for seed in range(args.seeds)]
        cells = {figure: [one[figure] for one in each] for figure in each[0]}
        found.append({"title": name, "cells": cells, "seeds": list(range(args.seeds)), "protocol": protocol})
    hidden = ("own, any octave", "shifted, any octave")  # their ratio is shown
    columns = [Column(figure, figure, 2) for figure in found[0]["cells"] if figure not in hidden]
    report("Dances to charted songs", columns, found, args.record)


if __name__ == "__main__":
    main()
