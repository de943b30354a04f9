"""`motionloom edit`: keep a part of a clip and make the rest anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from motionloom.datasets.schema import UserError
from motionloom.pipeline.cli.options import Device, ModelFolder, Sampling, sampling_of
from motionloom.pipeline.inference.writers import formats_help
from motionloom.pipeline.launch.console import make_console

if TYPE_CHECKING:
    from motionloom.pipeline.contract.editing import EditTask


def edit(
    run_folder: ModelFolder,
    clip: Annotated[Path, typer.Argument(help="A .bvh of any human skeleton, or a .npz or .glb of ours.")],
    task: Annotated[
        Path | None, typer.Option("--task", help="YAML with all of the following; options add to it.")
    ] = None,
    keep: Annotated[
        list[str] | None,
        typer.Option(
            "--keep",
            help="START:END=PARTS in seconds, each may be left out: 0:1.5, 2.5:, :=lower, :=all-right_hand. "
            "Parts: all, upper, lower, left_arm, right_arm, left_hand, right_hand, hands, face; + adds, "
            "- takes away. May be repeated.",
        ),
    ] = None,
    path: Annotated[
        list[str] | None,
        typer.Option("--path", help="SECONDS=X,Z: where the root is then, in metres. Repeat for a way."),
    ] = None,
    pin: Annotated[
        list[str] | None,
        typer.Option("--pin", help="JOINT@SECONDS=X,Y,Z: where a joint is then, in metres. May be repeated."),
    ] = None,
    words: Annotated[
        list[str] | None,
        typer.Option("--words", help="START:END=TEXT: what the person does then. May be repeated."),
    ] = None,
    caption: Annotated[str | None, typer.Option(help="What the person does elsewhere.")] = None,
    face: Annotated[str | None, typer.Option(help="What the face does.")] = None,
    lead: Annotated[float | None, typer.Option(help="Seconds to make before the clip.")] = None,
    seconds: Annotated[
        float | None, typer.Option(help="Length from the clip's first frame on; default: the clip's.")
    ] = None,
    strength: Annotated[
        float | None, typer.Option(help="Pull towards path and pins while denoising; default 1.")
    ] = None,
    likeness: Annotated[
        float | None, typer.Option(help="How much of the clip is left in what is free, 0 to 1; default 0.")
    ] = None,
    exact: Annotated[
        bool | None,
        typer.Option("--exact/--loose", help="Meet path and pins by moving the figure at the end."),
    ] = None,
    samples: Annotated[int, typer.Option(min=1, help="Results.")] = 1,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path("edited"),
    formats: Annotated[str | None, typer.Option("--format", "-f", help=formats_help())] = None,
    seed: Annotated[int, typer.Option(help="Same seed, clip and options: same motions.")] = 0,
    sampling: Sampling = None,
    plant_feet: Annotated[bool, typer.Option(help="Hold feet still where they stand.")] = True,
    device: Device = "auto",
) -> None:
    """A clip of which a part is kept and the rest made anew, on a page beside the clip.

    Says how far each thing that was asked for is from what came, and how smooth the seams are.

    Example: `motionloom edit inbetween walk.bvh --keep 0:1.5 --keep 2.5:`  (fill a gap)

    Example: `motionloom edit inbetween walk.bvh --seconds 8`  (go on; `--lead 2` begins before)

    Example: `motionloom edit inbetween walk.bvh --keep :=lower --caption "a person waves"`

    Example: `motionloom edit inbetween walk.bvh --path 0=0,0 --path 2=0,2 --path 4=2,3`

    Example: `motionloom edit inbetween walk.bvh --keep :1 --keep 3: --pin left_wrist@2=0.4,1.6,1`

    Example: `motionloom edit inbetween walk.bvh --words "1.5:3=a person kicks with the left leg"`
    """
    from motionloom.pipeline.runs.editing import edit_clip_file

    plain = {
        "caption": caption, "face": face, "lead": lead, "seconds": seconds, "strength": strength,
        "likeness": likeness, "exact": exact,
    }  # fmt: skip
    fields: dict[str, object] = {name: value for name, value in plain.items() if value is not None}
    fields |= {
        "keep": [_kept(text) for text in keep or ()],
        "path": [_point(text) for text in path or ()],
        "pins": [_pin(text) for text in pin or ()],
        "words": [_words(text) for text in words or ()],
    }
    edit_clip_file(
        run_folder, clip, task_of(task, fields), samples=samples, out=out, formats=formats, seed=seed,
        sampling=sampling_of(sampling), figure={"plant_feet": plant_feet}, device=device,
        console=make_console(),
    )  # fmt: skip


def task_of(file: Path | None, fields: dict[str, object]) -> EditTask:
    """The task of a YAML file and the fields of options: lists are added to the file's, others replace."""
    from motionloom.pipeline.contract.editing import EditTask
    from motionloom.pipeline.store.yaml import read_yaml

    given: dict[str, object] = {}
    if file is not None:
        read = read_yaml(file) or {}
        if not isinstance(read, dict):
            raise UserError(f"{file}: a task is a mapping, such as `keep: [{{end: 1.5}}]`")
        given = read
    for name, value in fields.items():
        before = given.get(name)
        given[name] = [*before, *value] if isinstance(value, list) and isinstance(before, list) else value
    return EditTask.parse(given, "task" if file is None else str(file))


def _kept(text: str) -> dict[str, object]:
    """Of `1:2=all-face`."""
    span, equals, parts = text.partition("=")
    start, end = _span(span, f"--keep {text}", "START:END=PARTS, such as 0:1.5 or :=lower")
    out: dict[str, object] = {"start": start or 0.0, "end": end}
    if equals:
        kept, *without = parts.replace(" ", "").split("-")
        out |= {"parts": kept.split("+"), "but": without}
    return out


def _words(text: str) -> dict[str, object]:
    """Of `1:2=a person jumps`."""
    span, _, said = text.partition("=")
    start, end = _span(span, f"--words {text}", "START:END=TEXT, such as 1:2.5=a person jumps")
    if end is None:
        raise UserError(f"--words {text}: it needs an end, such as {start or 0:g}:{(start or 0) + 2:g}=TEXT")
    return {"start": start or 0.0, "end": end, "text": said}


def _point(text: str) -> dict[str, float]:
    """Of `1.5=0,2`."""
    at, x, z = _numbers(text.replace("=", ",", 1), 3, f"--path {text}", "SECONDS=X,Z, such as 2=0,1.5")
    return {"at": at, "x": x, "z": z}


def _pin(text: str) -> dict[str, object]:
    """Of `left_wrist@1.5=0,1.2,0.4`."""
    example = "JOINT@SECONDS=X,Y,Z, such as left_wrist@2=0.4,1.6,1"
    joint, _, rest = text.partition("@")
    at, *position = _numbers(rest.replace("=", ",", 1), 4, f"--pin {text}", example)
    return {"at": at, "joint": joint, "position": position}


def _span(text: str, option: str, example: str) -> tuple[float | None, float | None]:
    ends = text.split(":")
    try:
        start, end = (float(one) if one.strip() else None for one in ends)
    except ValueError:
        raise UserError(f"{option}: write it as {example}") from None
    return start, end


def _numbers(text: str, count: int, option: str, example: str) -> Sequence[float]:
    try:
        found = [float(one) for one in text.split(",")]
    except ValueError:
        found = []
    if len(found) != count:
        raise UserError(f"{option}: write it as {example}")
    return found
