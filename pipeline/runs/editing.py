"""`motionloom edit`: a clip of which a part is made anew, written to files beside the clip."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rich.console import Console

from motionloom.pipeline.contract.editing import EditTask
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.model import MotionModel
from motionloom.pipeline.inference.outputs import page_note, write_motions
from motionloom.pipeline.inference.shipped_models import say_model
from motionloom.pipeline.inference.shown import FigureOptions
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.runs.generation import film_progress, formats_of
from motionloom.pipeline.store.files import require_folder


def edit_clip_file(
    folder: Path,
    clip: Path,
    task: EditTask,
    *,
    samples: int,
    out: Path,
    formats: str | None,
    seed: int,
    sampling: SamplingConfig,
    figure: Mapping[str, object],
    device: str,
    console: Console,
) -> list[Path]:
    """Edit and write, the clip first; returns the paths. As `MotionModel.edit`; `formats` as `--format`."""
    wanted = formats_of(formats)
    require_folder(out)
    posing = FigureOptions.parse(figure, "figure")
    aside = make_console(aside=True)  # standard output is the list of files
    model = MotionModel(folder, device)
    if (taken := say_model(folder)) is not None:
        aside.print(taken, markup=False, highlight=False, soft_wrap=True)
    motions = model.edit(clip, task, samples=samples, seed=seed, sampling=sampling)
    for remark in motions[0].remarks:
        aside.print(f"note: {remark}", style="yellow", markup=False, highlight=False, soft_wrap=True)
    for number, motion in enumerate(motions, start=1):
        for line in motion.report.lines():
            said = f"{number}: {line}" if samples > 1 else line
            aside.print(said, markup=False, highlight=False, soft_wrap=True)
    with film_progress(aside) as progress:
        paths = write_motions(
            out,
            [motions[0].original, *motions],
            wanted,
            title=f"{clip.name}, edited",
            note=page_note(len(motions), folder.resolve().name, seed, motions[0].remarks),
            seed=seed,
            names=[clip.stem, *[f"{clip.stem} edited" for _ in motions]],
            labels=["the clip", *["edited" for _ in motions]],
            figure=posing,
            progress=progress,
        )
    for path in paths:
        console.print(str(path), markup=False, soft_wrap=True)
    if "html" in wanted:
        place = (out / "index.html").resolve()
        aside.print(f"watch it in a browser: {place}", markup=False, highlight=False, soft_wrap=True)
    return paths
