"""`motionloom data …`: make, convert, check and describe shards."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.pipeline.console import make_console

data_app = typer.Typer(
    help="Shards: synthesise, convert, check, statistics.", no_args_is_help=True, rich_markup_mode="markdown"
)
convert_app = typer.Typer(
    help="Real motion capture to shards.", no_args_is_help=True, rich_markup_mode="markdown"
)
data_app.add_typer(convert_app, name="convert")

Out = Annotated[Path, typer.Argument(help="Folder for the shards.")]
Workers = Annotated[int, typer.Option(help="Processes; the shards are the same bytes for any number.")]


@data_app.command()
def synth(
    out: Out,
    clips: Annotated[int, typer.Option(help="Number of clips over all splits.")] = 512,
    seed: Annotated[int, typer.Option(help="Same seed, same clips.")] = 0,
    layout: Annotated[
        str, typer.Option(help="wholebody363 (body, hands, face) or body133.")
    ] = "wholebody363",
    music: Annotated[bool, typer.Option("--music", help="Add dances with their audio.")] = False,
    workers: Workers = 2,
) -> None:
    """Procedural whole-body motion whose captions are true.

    Example: `motionloom data synth shards --clips 200`
    """
    from motionloom.datasets.synth.generate import SynthConfig, synthesize
    from motionloom.pipeline.data_commands import say_manifest

    config = SynthConfig.parse({"clips": clips, "seed": seed, "layout": layout, "music": music}, "data synth")
    console = make_console()
    say_manifest(synthesize(config, out, workers=workers), out, console)


@convert_app.command()
def bvh(
    source: Annotated[
        Path, typer.Argument(help="Folder of .bvh files, or of .tar/.tar.xz archives of them.")
    ],
    out: Out,
    joint_map: Annotated[Path, typer.Option("--joint-map", help="JSON that maps our joints to the file's.")],
    captions: Annotated[Path | None, typer.Option(help="JSON lines: id, file, captions, split.")] = None,
    splits: Annotated[
        Path | None, typer.Option(help="Folder with train.txt, val.txt, test.txt; else the captions' split.")
    ] = None,
    layout: Annotated[str, typer.Option(help="Feature layout of the shards: body133 or h3d263.")] = "body133",
    fps: Annotated[float, typer.Option(help="Frame rate of the shards; clips are resampled by time.")] = 20.0,
    source_fps: Annotated[
        float | None, typer.Option(help="True frame rate of the files, if they state a wrong one.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Length unit of the files: m, cm, mm or inch.")] = "cm",
    up: Annotated[str, typer.Option(help="Upward axis of the files: y or z.")] = "y",
    licence: Annotated[str, typer.Option(help="Licence of the clips, kept in every sample.")] = "unknown",
    limit: Annotated[int | None, typer.Option(help="Only the first N clips.")] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help="Stop at the first bad file instead of listing it.")
    ] = False,
    plan: Annotated[bool, typer.Option("--plan", help="Only list what would be converted.")] = False,
    workers: Workers = 2,
) -> None:
    """BVH files with captions to shards.

    Example: `motionloom data convert bvh mocap shards --joint-map map.json --captions captions.jsonl --plan`
    """
    from motionloom.pipeline.data_commands import convert_bvh_command

    fields = {
        "source": source,
        "joint_map": joint_map,
        "captions": captions,
        "splits": splits,
        "layout": layout,
        "fps": fps,
        "source_fps": source_fps,
        "unit": unit,
        "up": up,
        "licence": licence,
        "limit": limit,
    }
    convert_bvh_command(fields, out, plan=plan, strict=strict, workers=workers, console=make_console())


@data_app.command()
def check(root: Annotated[Path, typer.Argument(help="Folder with manifest.json.")]) -> None:
    """Checksums, schema, finite values, duplicates, splits that leak. Exit code 1 and a list of problems.

    Example: `motionloom data check shards`
    """
    from motionloom.pipeline.data_commands import check_command

    raise typer.Exit(1 if check_command(root, make_console()) else 0)


@data_app.command()
def stats(
    root: Annotated[Path, typer.Argument(help="Folder with manifest.json.")],
    group: Annotated[
        bool, typer.Option("--group", help="Average the deviation per kind of feature (HumanML3D).")
    ] = False,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Also write a .safetensors file.")] = None,
) -> None:
    """Counts, lengths, and mean and deviation per kind of feature (training split).

    Example: `motionloom data stats shards -o stats.safetensors`
    """
    from motionloom.pipeline.data_commands import stats_command

    stats_command(root, group=group, out=out, console=make_console())
