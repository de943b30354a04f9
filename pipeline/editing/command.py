"""`motionloom edit`: keep a part of a clip and make the rest anew."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.register import register
from motionloom.pipeline.cli.motions import formats_of, print_note, write_files
from motionloom.pipeline.cli.options import Device, ModelFolder, Rig, Settings, settings_of
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.inference.files.writers import figure_keys, figure_options, formats_help
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_folder


def edit(
    run_folder: ModelFolder,
    clip: Annotated[
        Path,
        typer.Argument(help="A .bvh of any human skeleton, a character's .glb or .vrma, or an .npz of ours."),
    ],
    task: Annotated[
        Path | None,
        typer.Option("--task", help="YAML: keep, caption, path, pins, seconds and more; see the docs."),
    ] = None,
    caption: Annotated[str | None, typer.Option(help="What the person does in what is made.")] = None,
    samples: Annotated[int, typer.Option(min=1, help="Results.")] = 1,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path("edited"),
    formats: Annotated[str | None, typer.Option("--format", "-f", help=formats_help())] = None,
    rig: Rig = None,
    seed: Annotated[int, typer.Option(help="Same seed, clip and options: same motions.")] = 0,
    settings: Settings = None,
    device: Device = "auto",
) -> None:
    """A clip of which a part is kept and the rest made anew, on a page beside the clip.

    Says how far each thing that was asked for is from what came, and how smooth the seams are. `--set` also
    takes the task's keys: keep, seconds (length of the result), lead, mirror, speed, repeat.

    Example: `motionloom edit inbetween walk.bvh --set 'keep=[{end: 1.5}, {start: 2.5}]'`  (fill a gap)

    Example: `motionloom edit inbetween walk.bvh --set seconds=8`  (go on; `--set lead=2` begins before)

    Example: `motionloom edit inbetween walk.bvh --set 'keep=[{parts: [lower]}]' --caption "a person waves"`

    Example: `motionloom edit inbetween walk.bvh --task task.yaml`  (paths, pinned joints)
    """
    from motionloom.pipeline.contract.sampling import SamplingConfig
    from motionloom.pipeline.editing.task import EditTask
    from motionloom.pipeline.inference.files.outputs import page_note
    from motionloom.pipeline.inference.model import MotionModel
    from motionloom.pipeline.store.yaml import read_yaml

    sampling, figure, fields = settings_of(
        settings, SamplingConfig.model_fields, figure_keys(), EditTask.model_fields
    )
    written = {} if task is None else read_yaml(task) or {}
    if not isinstance(written, dict):
        raise UserError(f"{task}: a task is a mapping, such as `keep: [{{end: 1.5}}]`")
    fields = {**written, **fields}
    if caption is not None:
        fields["caption"] = caption
    edits = EditTask.parse(fields, "task" if task is None else str(task))
    if rig is not None:
        figure["rig"] = rig
    wanted = formats_of(formats, figure)
    posing = figure_options(figure, wanted)
    require_folder(out)
    aside = make_console(aside=True)  # standard output is the list of files
    model = MotionModel(run_folder, device)
    drawn = SamplingConfig.parse(sampling, "--set")
    motions = model.edit(clip, edits, samples=samples, seed=seed, sampling=drawn)
    remarks = motions[0].remarks
    for remark in remarks:
        print_note(aside, remark)
    for number, motion in enumerate(motions, start=1):
        for line in motion.report.lines():
            say(aside, f"{number}: {line}" if samples > 1 else line)
    write_files(
        out,
        [motions[0].original, *motions],
        wanted,
        title=f"{clip.name}, edited",
        note=page_note(len(motions), Path(run_folder).resolve().name, seed, remarks, model.bundle.terms),
        names=[clip.stem, *[f"{clip.stem} edited" for _ in motions]],
        labels=["the clip", *["edited" for _ in motions]],
        figure=posing,
        made_from=clip,
    )


register(Command("edit", edit))
