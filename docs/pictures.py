"""The pictures of the documentation: one row of poses per caption or song.

python docs/pictures.py runs/humantomato-tiny docs/pictures/demo.png
python docs/pictures.py runs/bvh-body walk.png "a person walks and turns left" --seed 3
python docs/pictures.py synthetic docs/pictures/demo.png
python docs/pictures.py runs/ude-tiny docs/pictures/dance.png --dances 3

The first argument is a run folder, an exported folder, or the word `synthetic` (clips of the synthetic
source). With `--dances` rows are dances to songs of the run's test split, each pose on a beat of the music.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from contact_sheet import contact_sheet
from numpy.typing import NDArray

from motionloom.datasets.motion.body.rigid import RigidMotion
from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.shown import shown
from motionloom.pipeline.render.body.face import synthetic_face_controls

CAPTIONS = (
    "a person waves with the left hand",
    "a person walks forward",
    "a person kicks with the right leg",
    "a person does a squat",
)
SYNTHETIC = SynthConfig(seed=7)
SYNTHETIC_CLIPS = (44, 11, 10, 12)
"""A wave, a circle, two kicks and a seat, each with a hand shape that can be seen."""


@dataclass(frozen=True)
class Row:
    """One row of a picture: joints [T, N, 3] in metres, what to call them, and their caption."""

    joints: NDArray[np.floating]
    label: str
    caption: str
    fps: float
    at: list[int] | None = None
    """Frames to show; None = spread evenly."""
    figure: RigidMotion | None = None
    """The rigid figure whose joints these are."""
    face: NDArray[np.floating] | None = None
    """The face's controls [T, 5]."""

    @staticmethod
    def of(motion: GeneratedMotion, label: str, caption: str, at: list[int] | None = None) -> Row:
        """A generated motion, as page and film show it."""
        seen = shown(motion)
        face = None if motion.face is None else synthetic_face_controls(motion.face)
        return Row(seen.joints, label, caption, seen.fps, at, seen.figure, face)


def generated_rows(run: Path, captions: tuple[str, ...], seed: int) -> list[Row]:
    """Motions that a trained run makes of the captions."""
    motions = Bundle.open(run).generate(captions, seed=seed)
    return [Row.of(motion, "generated", motion.caption) for motion in motions]


def dance_rows(run: Path, count: int, frames: int, seed: int) -> list[Row]:
    """Dances that a trained run makes to songs of its test split, of different kinds first, on the beats."""
    stages, bundle = finished_stages(run), Bundle.open(run)
    dataset = StageCache().get(stages["data"]).split("test")
    unit = bundle.generator.unit_frames
    fps, found = dataset.layout.fps, dances_of(dataset, 1000, unit=unit)
    kinds: dict[object, DanceClip] = {}
    for clip in found:
        if len(clip.beats) >= frames:
            kinds.setdefault((clip.truth or {}).get("genre"), clip)
    clips = list(kinds.values())[:count]
    motions = bundle.generate(
        sounds=[c.sound for c in clips],
        conditions={"audio": [c.music for c in clips]},
        seconds=[c.seconds for c in clips],
        seed=seed,
    )
    rows = []
    for clip, motion in zip(clips, motions, strict=True):
        at = [min(round(beat * fps), len(motion.joints) - 1) for beat in clip.beats[:frames].tolist()]
        truth = clip.truth or {}
        words = f"{truth.get('genre', clip.song)}, {truth.get('bpm', '?')} beats a minute"
        rows.append(Row.of(motion, "to music", words, at))
    return rows


def synthetic_rows() -> list[Row]:
    """Clips of the synthetic source, in the captions' own words."""
    clips = [make_clip(index, SYNTHETIC) for index in SYNTHETIC_CLIPS]
    fps = SYNTHETIC.motion_layout.fps
    faces = [None if c.face is None else synthetic_face_controls(c.face) for c in clips]
    return [Row(c.joints, "synthetic", c.texts[0], fps, face=f) for c, f in zip(clips, faces, strict=True)]


def draw(path: Path, rows: list[Row], frames: int) -> None:
    """Write the rows as one PNG; they must share a frame rate, as the clips of one run do."""
    contact_sheet(
        path,
        [row.joints for row in rows],
        [row.label for row in rows],
        [row.caption for row in rows],
        frames,
        at=None if rows[0].at is None else [row.at or [] for row in rows],
        figures=[row.figure for row in rows],
        face_controls=[row.face for row in rows],
        fps=rows[0].fps,
    )


def main() -> None:
    """Read the command line and write the picture."""
    parser = argparse.ArgumentParser(description="A picture of generated motions for the documentation.")
    parser.add_argument("run", help="a run folder, an exported folder, or the word 'synthetic'")
    parser.add_argument("out", type=Path, help="the PNG to write")
    parser.add_argument("captions", nargs="*", help="one row each; default: four of the docs' own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--dances", type=int, default=0, help="rows of dances, in place of captions")
    parser.add_argument("--frames", type=int, default=6, help="poses in a row")
    args = parser.parse_args()
    if args.run == "synthetic":
        rows = synthetic_rows()
    elif args.dances:
        rows = dance_rows(Path(args.run), args.dances, args.frames, args.seed)
    else:
        rows = generated_rows(Path(args.run), tuple(args.captions) or CAPTIONS, args.seed)
    draw(args.out, rows, args.frames)
    print(args.out)


if __name__ == "__main__":
    main()
