"""`motionloom generate`: motions to files, or one motion while it is made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.options import Device, ModelFolder, Settings, settings_of
from motionloom.pipeline.inference.writers import formats_help
from motionloom.pipeline.launch.console import make_console

STREAM = "jsonl"
"""The format that is written while its one motion is made."""
_SCRIPTS = (".yaml", ".yml")


def generate(
    run_folder: ModelFolder,
    captions: Annotated[
        list[str] | None,
        typer.Argument(
            help="What the person does; one motion each. Or a script (.yaml) of text and music, one motion."
        ),
    ] = None,
    audio: Annotated[
        list[Path] | None,
        typer.Option("--audio", help="A wav, flac, mp3 or ogg file to move to; beside a caption, both."),
    ] = None,
    samples: Annotated[int, typer.Option(help="Motions of each caption, sound or script.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help=f"Folder for the files, default motions; of {STREAM} a file."),
    ] = None,
    formats: Annotated[
        str | None,
        typer.Option(
            "--format",
            "-f",
            help=f"{formats_help()} Or {STREAM} alone: one motion as JSON lines, written while it is made; "
            "the caption - reads captions from standard input.",
        ),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Length; default: the model decides.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, captions and options: same motions.")] = 0,
    settings: Settings = None,
    device: Device = "auto",
) -> None:
    """Motions from captions, music or a script of both, as numbers and a page; other files on request.

    `--set` also takes face (what the face does, one text for all captions or a list), seed_motion (a clip to
    go on from, for FACT and Bailando), plant_feet (false: feet may slide), body_model (your SMPL-X model, for
    format smplx) and arkit_bases (your expression and ARKit bases, for arkit).

    Example: `motionloom generate synthetic "a person waves with the left hand"`

    Example: `motionloom generate runs/humantomato-tiny "a person waves" --set face="a happy face" -o out`

    Example: `motionloom generate runs/ude-tiny --audio song.ogg --samples 3 -o dances`

    Example: `motionloom generate runs/humantomato-tiny "a person bows" --format glb,html`

    Example: `motionloom generate runs/humantomato-tiny "a person walks" --seconds 60 -f jsonl -o walk.jsonl`
    """
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.inference.shown import FigureOptions
    from motionloom.pipeline.runs.generation import generate_motions, stream_motion

    sampling, figure, more = settings_of(
        settings, SamplingConfig.model_fields, FigureOptions.model_fields, ("face", "seed_motion")
    )
    face, seed_motion = more.get("face"), more.get("seed_motion")
    texts = list(captions or [])
    script = Path(texts.pop(0)) if texts and texts[0].lower().endswith(_SCRIPTS) else None
    request: dict[str, Any] = {
        "face": [face] if isinstance(face, str) else face,
        "audio": audio or [],
        "script": script,
        "seconds": seconds,
        "seed": seed,
        "sampling": SamplingConfig.parse(sampling, "--set"),
        "device": device,
    }
    if formats is not None and STREAM in formats.split(","):
        if samples != 1 or formats != STREAM or seed_motion is not None:
            raise UserError(
                f"--format {STREAM} writes one motion while it is made: leave other formats, --samples and "
                f"seed_motion out"
            )
        stream_motion(run_folder, texts, out=out, console=make_console(aside=True), **request)
        return
    generate_motions(
        run_folder, texts, samples=samples, out=out or Path("motions"), formats=formats, figure=figure,
        seed_motion=None if seed_motion is None else Path(str(seed_motion)), console=make_console(),
        **request,
    )  # fmt: skip
