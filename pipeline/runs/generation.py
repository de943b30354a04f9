"""`motionloom generate`: motions from captions, music or a script, written to files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

from rich.console import Console

from motionloom.datasets.schema import UserError
from motionloom.pipeline.contract.sampling import SamplingConfig
from motionloom.pipeline.inference.formats import Format
from motionloom.pipeline.inference.requests import caption_list, require_seed, require_words
from motionloom.pipeline.launch.console import make_console
from motionloom.pipeline.launch.hardware import choose_device
from motionloom.pipeline.runs.shipped import nearest
from motionloom.pipeline.store.files import require_folder

FEW = 8
"""Motions that are made at once by one thread: a step of a small batch is over before a second one is awake,
and where other programs use the machine the threads wait for each other many times as long."""


@contextmanager
def threads_for(motions: int) -> Iterator[None]:
    """As many threads as so many motions at once can use."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1 if motions < FEW else before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def generate_motions(
    folder: Path,
    captions: Sequence[str] = (),
    *,
    face: Sequence[str] | None = None,
    audio: Sequence[Path] = (),
    script: Path | None = None,
    samples: int = 1,
    out: Path,
    formats: str = "npz,bvh,mp4,html",
    seconds: float | None = None,
    seed: int = 0,
    sampling: dict[str, Any] | None = None,
    figure: dict[str, Any] | None = None,
    device: str = "auto",
    console: Console,
) -> list[Path]:
    """Generate and write; returns the paths. `device`: auto, cpu, cuda or cuda:N.

    From captions, sound files, or both side by side (the first caption with the first file, and so on), or
    from one script. `samples` motions of each. `figure` are the keys of `FigureOptions`.
    """
    from motionloom.pipeline.inference.bundle import Bundle
    from motionloom.pipeline.inference.outputs import write_motions
    from motionloom.pipeline.inference.page_words import page_note, page_title
    from motionloom.pipeline.inference.script import Script, read_music
    from motionloom.pipeline.inference.shipped_models import say_model
    from motionloom.pipeline.inference.shown import FigureOptions
    from motionloom.pipeline.inference.unknown import unknown_captions

    if not captions and not audio and script is None:
        raise UserError('give at least one caption, like: motionloom generate RUN "a person waves"')
    if script is not None and (captions or audio or seconds is not None or face):
        raise UserError("--script says everything: leave captions, --face, --audio and --seconds out")
    if samples < 1:
        raise UserError(f"--samples {samples}: take 1 or more")
    wanted = [f.strip() for f in formats.split(",") if f.strip()]
    for name in wanted:
        if name not in get_args(Format):
            raise UserError(f"--format {name}: no such format{nearest(name, get_args(Format))}")
    if not wanted:
        raise UserError(f"--format {formats!r} names no format: npz, bvh, mp4, html, glb, smplx or arkit")
    # All that needs no model is checked before one is opened.
    require_words(caption_list(captions))
    require_seed(seed)
    require_folder(out)
    drawing = SamplingConfig.parse(sampling or {}, "sampling")
    posing = FigureOptions.parse(figure or {}, "figure")
    if posing.body_model is not None and "smplx" not in wanted:
        raise UserError("--body-model is what --format smplx is made for: name that format too")
    if posing.arkit_bases is not None and "arkit" not in wanted:
        raise UserError("--arkit-bases is what --format arkit is made by: name that format too")
    segments = None if script is None else Script.read(script).open(script.parent, str(script))
    sounds = [read_music(path) for path in audio]
    with threads_for(samples * max(len(captions), len(audio), 1)):
        bundle = Bundle.open(folder, choose_device(device))
        aside = make_console(aside=True)  # standard output is the list of files
        if (taken := say_model(folder)) is not None:
            aside.print(taken, markup=False, highlight=False, soft_wrap=True)
        if segments is not None:
            motions = bundle.perform(segments, samples=samples, seed=seed, sampling=drawing)
        else:
            motions = bundle.generate(
                [text for text in captions for _ in range(samples)] or None,
                face=face and [text for text in face for _ in range(samples)],
                sounds=[sound for sound in sounds for _ in range(samples)] or None,
                seconds=seconds,
                seed=seed,
                sampling=drawing,
                strict=True,
            )
        said = captions if segments is None else [segment.prompt.text for segment in segments]
        for unknown in unknown_captions(bundle, said, face or (), drawing.face_model):
            aside.print(f"note: {unknown}", style="yellow", markup=False, soft_wrap=True)
        title = page_title([motion.caption for motion in motions], [path.name for path in audio], script)
        note = page_note(len(motions), folder.resolve().name, seed)
        paths = write_motions(
            out,
            motions,
            wanted,  # type: ignore[arg-type]
            title=title,
            note=note,
            seed=seed,
            figure=posing,
            say=lambda line: aside.print(line, soft_wrap=True, markup=False),
        )
        for path in paths:
            console.print(str(path), markup=False, soft_wrap=True)
        if "html" in wanted:
            place = (out / "index.html").resolve()
            aside.print(f"watch it in a browser: {place}", markup=False, highlight=False, soft_wrap=True)
        return paths
