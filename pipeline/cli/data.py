"""`motionloom data …`: make, convert, check and describe shards."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.pipeline.cli.convert import convert_app
from motionloom.pipeline.cli.json_output import AsJson
from motionloom.pipeline.launch.console import make_console

data_app = typer.Typer(
    help="Shards: synthesise, convert, check, statistics.", no_args_is_help=True, rich_markup_mode="markdown"
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
    from motionloom.pipeline.cli.data_commands import synth_command

    fields = {"clips": clips, "seed": seed, "layout": layout, "music": music}
    synth_command(fields, out, workers=workers, console=make_console())


@data_app.command()
def check(
    path: Annotated[
        Path, typer.Argument(help="Folder with manifest.json; or one source file, or a folder of such files.")
    ],
    layout: Annotated[
        str | None,
        typer.Option(
            help="Files: layout of .npy arrays, or joints22, joints52; default smplx322 (Motion-X)."
        ),
    ] = None,
    fps: Annotated[
        float | None, typer.Option(help="Files: frame rate, if not the layout's usual one.")
    ] = None,
    texts: Annotated[
        str, typer.Option(help="Files: how .txt is read: auto, humanml, plain (a caption a line) or ids.")
    ] = "auto",
    seconds: Annotated[float | None, typer.Option(help="Files: length of the clips of captions.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Warnings count as problems.")] = False,
    every: Annotated[
        bool, typer.Option("--all", help="List every finding, also where many say the same.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Checksums, schema, finite values, ranges, people on a floor, duplicates, leaks. Exit code 1 and a list.

    Without manifest.json, single files are checked: .tar, .npy, .npz, .pkl, .bvh, .wav, .txt.

    Example: `motionloom data check shards`

    Example: `motionloom data check HumanML3D/new_joint_vecs --layout h3d263`
    """
    from motionloom.pipeline.cli.data_commands import check_command

    rules = {"layout": layout, "fps": fps, "texts": texts, "seconds": seconds}
    console = make_console(aside=as_json)
    problems = check_command(path, rules, strict=strict, every=every, console=console, as_json=as_json)
    raise typer.Exit(1 if problems else 0)


@data_app.command()
def joints(
    source: Annotated[
        str,
        typer.Argument(help="A .bvh file, or a folder or archive of them; or a skeleton: smpl22, smplx52."),
    ] = "smpl22",
    skeleton: Annotated[
        str, typer.Option(help="Of a file: the skeleton to map to, smpl22 or smplx52 (with fingers).")
    ] = "smpl22",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Also write the joint map, to be completed.")
    ] = None,
) -> None:
    """Joint names of a skeleton of ours; or which joints of a BVH file stand for them, as far as can be said.

    Example: `motionloom data joints smplx52`

    Example: `motionloom data joints walk.bvh -o joint_map.json`
    """
    from motionloom.pipeline.cli.data_commands import joints_command

    joints_command(source, skeleton, out, console=make_console())


@data_app.command()
def report(
    root: Annotated[Path, typer.Argument(help="Folder with manifest.json.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; default ROOT/report.html.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Also check the whole set, and show what was found.")
    ] = False,
    clips: Annotated[int, typer.Option(help="Clips to watch, at most.")] = 12,
) -> None:
    """One self-contained page about a data set: counts, captions, features, rejected clips, clips to watch.

    Example: `motionloom data report shards -o shards.html`
    """
    from motionloom.pipeline.cli.data_commands import report_command

    report_command(root, out, check=check, clips=clips, console=make_console())


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
    from motionloom.pipeline.cli.data_commands import stats_command

    stats_command(root, group=group, out=out, console=make_console())
