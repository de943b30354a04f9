"""Does a UDE run dance to songs of its user? Beat Align under the own song and under the others.

    python benchmarks/real_songs.py runs/ude-learning song.ogg another.mp3 third.wav

Ten-second stretches of each song, one dance to each; the beats of every song are librosa's. A dance that
does not hear its song aligns as well with another one: that is the trivial answer. Synthetic test songs of
the run's data stand beside, their beats tracked likewise.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from motionloom.datasets.audio.features import beats
from motionloom.datasets.audio.sound import Sound
from motionloom.datasets.motion.layout import BODY_JOINTS
from motionloom.models.metrics.dance_beats import beat_align
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.dances import dances_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.script import read_music

SECONDS = 10.0


def stretches(song: Sound, most: int) -> list[Sound]:
    """Slices of ten seconds from the third second on, `most` of them, spread evenly."""
    room = max(0.0, song.seconds - SECONDS - 3.0)
    count = min(most, 1 + int(room // SECONDS))
    return [song.slice(3.0 + room * k / count, 3.0 + room * k / count + SECONDS) for k in range(count)]


def scores(
    joints: Sequence[NDArray[np.float64]], heard: Sequence[tuple[str, NDArray[np.float64]]], fps: float
) -> dict[str, Mapping[str, float]]:
    """Mean Beat Align by each definition of dances under their own stretch, and under other songs'."""
    out: dict[str, Mapping[str, float]] = {}
    for definition in ("ude", "mint"):
        own, other = [], []
        for k, (name, _) in enumerate(heard):
            for m, (another, times) in enumerate(heard):
                inside = times[times < (len(joints[k]) - 1) / fps]
                if (k == m or name != another) and len(inside):
                    score = beat_align(joints[k][:, :BODY_JOINTS], inside, fps, definition)
                    (own if k == m else other).append(score)
        out[definition] = {"own": float(np.mean(own)), "other": float(np.mean(other))}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("songs", type=Path, nargs="+")
    parser.add_argument("--stretches", type=int, default=5, help="of each song, at most")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    bundle = Bundle.from_run(args.run)
    dataset = StageCache().get(finished_stages(args.run)["data"]).held_out(prefer="test")
    fps = bundle.generator.layout.fps
    real = [
        (path.name, piece) for path in args.songs for piece in stretches(read_music(path), args.stretches)
    ]
    made = [(clip.song, clip.sound) for clip in dances_of(dataset, len(real))]
    table = Table(
        "", "dances", "UDE, Bailando, EDGE: own song", "other songs", "MINT: own song", "other songs"
    )
    for title, sounds in (("real songs", real), ("synthetic test songs", made)):
        motions = bundle.generate(
            sounds=[sound for _, sound in sounds],
            seconds=[sound.seconds for _, sound in sounds],
            seed=args.seed,
            sampling=SamplingConfig(temperature=0.8, top_p=0.9),
        )
        heard = [(name, np.asarray(beats(sound.samples, sound.rate))) for name, sound in sounds]
        found = scores([motion.joints for motion in motions], heard, fps)
        cells = [f"{found[name][key]:.3f}" for name in ("ude", "mint") for key in ("own", "other")]
        table.add_row(title, str(len(sounds)), *cells)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
