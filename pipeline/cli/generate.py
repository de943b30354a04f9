"""`motionloom generate`: motions to files, or one motion while it is made."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.options import Device, ModelFolder, Sampling, sampling_of
from motionloom.pipeline.inference.writers import formats_help
from motionloom.pipeline.launch.console import make_console


def generate(
    run_folder: ModelFolder,
    captions: Annotated[
        list[str] | None, typer.Argument(help="What the person does; one motion each.")
    ] = None,
    face: Annotated[
        list[str] | None, typer.Option("--face", help="What the face does, for all captions or each.")
    ] = None,
    audio: Annotated[
        list[Path] | None,
        typer.Option("--audio", help="A wav, flac, mp3 or ogg file to move to; beside a caption, both."),
    ] = None,
    script: Annotated[
        Path | None, typer.Option("--script", help="YAML: segments of text and music, one motion.")
    ] = None,
    samples: Annotated[int, typer.Option(help="Motions of each caption, sound or script.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for the files, default motions; a file with --stream."),
    ] = None,
    stream: Annotated[
        bool,
        typer.Option(
            "--stream", help="One motion as JSON lines, written while it is made; - reads captions."
        ),
    ] = False,
    formats: Annotated[str | None, typer.Option("--format", "-f", help=formats_help())] = None,
    seconds: Annotated[float | None, typer.Option(help="Length; default: the model decides.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, captions and options: same motions.")] = 0,
    sampling: Sampling = None,
    seed_motion: Annotated[
        Path | None,
        typer.Option(
            help="A clip (.npz, .bvh, .glb) to go on from, for models that need one (FACT, Bailando); they "
            "take a start of a training dance without."
        ),
    ] = None,
    plant_feet: Annotated[bool, typer.Option(help="Hold feet still where they stand.")] = True,
    body_model: Annotated[
        Path | None, typer.Option(help="Your SMPL-X model (.npz), for --format smplx.")
    ] = None,
    arkit_bases: Annotated[
        Path | None,
        typer.Option(help="Your expression and ARKit bases (.npz: source, arkit), for --format arkit."),
    ] = None,
    device: Device = "auto",
) -> None:
    """Motions from captions, music or a script of both, as numbers and a page; other files on request.

    Example: `motionloom generate synthetic "a person waves with the left hand"`

    Example: `motionloom generate runs/humantomato-tiny "a person waves" --face "a happy face" -o out`

    Example: `motionloom generate runs/ude-tiny --audio song.ogg --samples 3 -o dances`

    Example: `motionloom generate runs/humantomato-tiny "a person bows" --format glb,html`

    Example: `motionloom generate runs/humantomato-tiny --stream "a person walks" --seconds 60 -o walk.jsonl`
    """
    asked: dict[str, Any] = {
        "face": face,
        "audio": audio or [],
        "script": script,
        "seconds": seconds,
        "seed": seed,
        "sampling": sampling_of(sampling),
        "device": device,
    }
    if stream:
        from motionloom.pipeline.runs.generation import stream_motion

        if samples != 1 or formats is not None or seed_motion is not None:
            raise UserError(
                "--stream writes one motion as JSON lines: leave --samples, --format and --seed-motion out"
            )
        stream_motion(run_folder, captions or [], out=out, console=make_console(aside=True), **asked)
        return
    from motionloom.pipeline.runs.generation import generate_motions

    files: dict[str, Any] = {} if formats is None else {"formats": formats}
    files["figure"] = {"plant_feet": plant_feet, "body_model": body_model, "arkit_bases": arkit_bases}
    folder = out or Path("motions")
    generate_motions(
        run_folder, captions or [], samples=samples, seed_motion=seed_motion, out=folder,
        console=make_console(), **files, **asked,
    )  # fmt: skip
