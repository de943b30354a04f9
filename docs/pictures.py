"""The pictures of the documentation: one row of poses per caption or song, as the page draws them.

python docs/pictures.py runs/humantomato-tiny docs/pictures/demo.png
python docs/pictures.py runs/bvh-body walk.png "a person walks and turns left" --seed 3
python docs/pictures.py runs/ude-tiny docs/pictures/dance.png --dances 3
python docs/pictures.py synthetic docs/pictures/motion.webp

The first argument is a run folder or an exported folder. With `--dances` rows are dances to songs of the
run's test split, each pose on a beat of the music. A file that ends in .webp is a film of the captions, side
by side. Chromium draws (`playwright`).
"""

from __future__ import annotations

import argparse
import io
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from motionloom.pipeline.contract.lookup import finished_stages
from motionloom.pipeline.contract.stage import StageCache
from motionloom.pipeline.evaluation.dances import DanceClip, dances_of
from motionloom.pipeline.inference.bundle import Bundle
from motionloom.pipeline.inference.files.outputs import clip_of
from motionloom.pipeline.inference.files.writers import cell_of
from motionloom.pipeline.inference.generation import generate
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.motion import GeneratedMotion
from motionloom.pipeline.inference.request import Request
from motionloom.pipeline.render.viewer import ViewerMotion, write_viewer

if TYPE_CHECKING:
    from playwright.sync_api import Page

CAPTIONS = (
    "a person waves with the left hand",
    "a person walks forward",
    "a person kicks with the right leg",
    "a person does a squat",
)
FILM = (
    "a person waves with the left hand",
    "a person jumps three times",
    "a person walks in a circle counterclockwise",
    "a person sits down",
)
CELL = 180
"""Pixels across one pose."""
FILM_SECONDS, FILM_FPS = 4.0, 12
SEEK = """at => {
  const scrub = document.querySelector(".mlv-bar input[type=range]");
  scrub.value = at;
  scrub.dispatchEvent(new Event("input"));
}"""
"""Moves the page's time line to a frame."""


def poses(motion: GeneratedMotion, caption: str, at: Sequence[int]) -> list[ViewerMotion]:
    """Frames of a generated motion as still cells of one row, each with its time."""
    whole = cell_of(clip_of(motion))
    figure, face = whole.figure, whole.face_controls
    assert figure is not None
    row = []
    for k in at:
        part = slice(k, k + 1)
        still = replace(
            figure, rotations=figure.rotations[part], root=figure.root[part], joints=figure.joints[part]
        )
        row.append(
            ViewerMotion(
                still.joints,
                whole.fps,
                whole.parents,
                f"{k / whole.fps:.1f} s",
                group=caption,
                face_controls=None if face is None else face[part],
                figure=still,
            )
        )
    return row


def generated_rows(run: Path, captions: tuple[str, ...], frames: int, seed: int) -> list[list[ViewerMotion]]:
    """Motions that a trained run makes of the captions, at times that are spread evenly."""
    motions = generate(Bundle.open(run), Request.of(captions, seed=seed))
    spread = [np.linspace(0, len(m.joints) - 1, frames).round().astype(int).tolist() for m in motions]
    return [poses(motion, motion.caption, at) for motion, at in zip(motions, spread, strict=True)]


def dance_rows(run: Path, count: int, frames: int, seed: int) -> list[list[ViewerMotion]]:
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
    motions = generate(
        bundle,
        Request.of(
            sounds=[c.sound for c in clips],
            conditions={"audio": [c.music for c in clips]},
            seconds=[c.seconds for c in clips],
            seed=seed,
        ),
    )
    rows = []
    for clip, motion in zip(clips, motions, strict=True):
        at = [min(round(beat * fps), len(motion.joints) - 1) for beat in clip.beats[:frames].tolist()]
        truth = clip.truth or {}
        words = f"{truth.get('genre', clip.song)}, {truth.get('bpm', '?')} beats a minute"
        rows.append(poses(motion, words, at))
    return rows


def draw(path: Path, rows: Sequence[Sequence[ViewerMotion]]) -> None:
    """Write the rows, equally long, as one PNG: the board of a viewer page, each row in a line of its own."""
    with board(rows, len(rows[0]), 320 * len(rows)) as page:
        page.wait_for_timeout(1000)
        page.locator(".mlv-board").screenshot(path=path)


def film(path: Path, run: str, captions: Sequence[str], seed: int) -> None:
    """Write motions of the captions, side by side, as one film that begins again where it ends."""
    model = MotionModel.from_pretrained(run)
    motions = model.generate(captions, seconds=FILM_SECONDS, seed=seed)
    cells = [cell_of(clip_of(motion), "") for motion in motions]
    last = max(len(cell.joints) for cell in cells) - 1
    frames = []
    with board([cells], len(cells), 400) as page:
        for at in np.linspace(0, last, round(FILM_SECONDS * FILM_FPS), endpoint=False).round().astype(int):
            page.evaluate(SEEK, int(at))
            page.wait_for_timeout(150)
            shot = page.locator(".mlv-board").screenshot()
            whole = Image.open(io.BytesIO(shot)).convert("RGB")
            frames.append(whole.crop((0, 0, (CELL + 12) * len(cells) - 12, whole.height)))
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=1000 // FILM_FPS, loop=0, quality=70, method=6
    )


@contextmanager
def board(rows: Sequence[Sequence[ViewerMotion]], columns: int, height: int) -> Iterator[Page]:
    """A viewer page of these rows in a browser, with nothing on it but the board."""
    from playwright.sync_api import sync_playwright

    style = (
        f".mlv-row {{ grid-template-columns: repeat({columns}, {CELL}px) !important; }} "
        ".mlv-count, .mlv-bar, .mlv-more { display: none !important; } "
        ".mlv-stage { height: 240px !important; }"
    )
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    webgl = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page_file = Path(folder) / "page.html"
        write_viewer(page_file, [cell for row in rows for cell in row], "")
        browser = playwright.chromium.launch(executable_path=chromium, args=webgl)
        size = {"width": (CELL + 12) * columns + 56, "height": height}
        page = browser.new_page(viewport=size, bypass_csp=True, color_scheme="light", reduced_motion="reduce")
        page.goto(page_file.as_uri())
        page.add_style_tag(content=style)
        yield page
        browser.close()


def main() -> None:
    """Read the command line and write the picture."""
    parser = argparse.ArgumentParser(description="A picture of generated motions for the documentation.")
    parser.add_argument("run", help="a run folder, an exported folder, or a model of the package")
    parser.add_argument("out", type=Path, help="the PNG to write, or a film (.webp)")
    parser.add_argument("captions", nargs="*", help="one row each; default: four of the docs' own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--dances", type=int, default=0, help="rows of dances, in place of captions")
    parser.add_argument("--frames", type=int, default=6, help="poses in a row")
    args = parser.parse_args()
    captions = tuple(args.captions) or CAPTIONS
    if args.out.suffix == ".webp":
        film(args.out, args.run, tuple(args.captions) or FILM, args.seed)
        print(args.out)
        return
    if args.dances:
        rows = dance_rows(Path(args.run), args.dances, args.frames, args.seed)
    else:
        rows = generated_rows(Path(args.run), captions, args.frames, args.seed)
    draw(args.out, rows)
    print(args.out)


if __name__ == "__main__":
    main()
