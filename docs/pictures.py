"""The pictures of the documentation: one row of poses per caption.

python docs/pictures.py runs/humantomato-tiny docs/pictures/demo.png
python docs/pictures.py runs/bvh-body walk.png "a person walks and turns left" --seed 3
python docs/pictures.py synthetic docs/pictures/demo.png

The first argument is a run folder, an exported folder, or the word `synthetic` (clips of the synthetic
source).
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from motionloom.datasets.synth.generate import SynthConfig, make_clip
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.render.picture import contact_sheet

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

    joints: NDArray[Any]
    label: str
    caption: str
    fps: float


def generated_rows(run: Path, captions: tuple[str, ...], seed: int) -> list[Row]:
    """Motions that a trained run makes of the captions."""
    motions = Bundle.open(run).generate(captions, seed=seed)
    return [Row(m.joints, "generated", m.caption, m.layout.fps) for m in motions]


def synthetic_rows() -> list[Row]:
    """Clips of the synthetic source, in the captions' own words."""
    clips = [make_clip(index, SYNTHETIC) for index in SYNTHETIC_CLIPS]
    return [Row(c.joints, "synthetic", c.texts[0], SYNTHETIC.motion_layout.fps) for c in clips]


def draw(path: Path, rows: list[Row], frames: int) -> None:
    """Write the rows as one PNG; they must share a frame rate, as the clips of one run do."""
    contact_sheet(
        path,
        [row.joints for row in rows],
        [row.label for row in rows],
        [row.caption for row in rows],
        frames,
        fps=rows[0].fps,
    )


def main() -> None:
    """Read the command line and write the picture."""
    parser = argparse.ArgumentParser(description="A picture of generated motions for the documentation.")
    parser.add_argument("run", help="a run folder, an exported folder, or the word 'synthetic'")
    parser.add_argument("out", type=Path, help="the PNG to write")
    parser.add_argument("captions", nargs="*", help="one row each; default: four of the docs' own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=6, help="poses in a row")
    args = parser.parse_args()
    if args.run == "synthetic":
        rows = synthetic_rows()
    else:
        rows = generated_rows(Path(args.run), tuple(args.captions) or CAPTIONS, args.seed)
    draw(args.out, rows, args.frames)
    print(args.out)


if __name__ == "__main__":
    main()
