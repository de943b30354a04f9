"""`motionloom caption`: what clips show, in words."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Dropped
from motionloom.datasets.base.register import register
from motionloom.pipeline.cli.options import At, Device, ModelFolder
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_file_place

_OURS = "synthetic"
"""The model of the package that captions."""
_FILES = (".npz", ".bvh", ".amc", ".glb", ".zip")
"""Endings of what is no model."""


def caption(
    run_folder: ModelFolder,
    clips: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Files (.npz of generate, .bvh, .amc, .glb), or folders of them; unpack archives first."
        ),
    ] = None,
    count: Annotated[int, typer.Option("--k", min=1, help="Sentences for each clip, likeliest first.")] = 3,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Also write JSON lines, for `data convert … --captions`."),
    ] = None,
    at: At = None,
    device: Device = "auto",
) -> None:
    """The likeliest sentences about clips, by a model with a captioner; without one, by the package's.

    Example: `motionloom caption walk.bvh --k 5`

    Example: `motionloom caption runs/mine takes -o captions.jsonl --k 1`
    """
    from motionloom.datasets.base.files import write_text
    from motionloom.pipeline.contract.stage import CAPTIONER
    from motionloom.pipeline.curation.captioning import captions
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.runs.snapshot import run_at

    console = make_console()
    files = list(clips or [])
    if not files or Path(run_folder).suffix.lower() in _FILES:
        run_folder, files = _OURS, [Path(run_folder), *files]
    if out is not None:
        require_file_place(out, ".jsonl")
    found = []
    left_out = []
    with run_at(run_folder, at, CAPTIONER) as folder:
        for one in captions(MotionModel(folder, device), files, count):
            if isinstance(one, Dropped):
                left_out.append(one)
                say(console, f"left out: {one.source}: {one.reason}")
                continue
            found.append(one)
            say(console, f"{one.file} ({one.seconds:.1f} s)")
            for part in one.parts:
                if len(one.parts) > 1:
                    say(console, f"  {part.start:.1f} to {part.end:.1f} s")
                for sentence in part.sentences:
                    say(console, f"  {sentence.probability:6.1%}  {sentence.text}")
    if not found:
        raise UserError(
            f"{left_out[0].source}: {left_out[0].reason}" if left_out else f"{files[0]}: no clip in it"
        )
    if out is not None:
        write_text(out, "".join(f"{json.dumps(one.record(), ensure_ascii=False)}\n" for one in found))
        say(console, f"{out}: {len(found)} clips")


register(Command("caption", caption))
