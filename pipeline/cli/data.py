"""`motionloom data …`: make, convert, check and describe shards."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.errors import UserError
from motionloom.datasets.base.records import Dropped
from motionloom.datasets.shards.left_out import grouped
from motionloom.pipeline.cli.convert import convert_app, say_manifest
from motionloom.pipeline.cli.options import (
    AsJson,
    Commands,
    Workers,
    fields_of,
    plain,
    print_json,
    set_option,
)
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_file_place, require_folder

_ALIKE = 5
"""Findings that say the same and are still listed one by one."""

data_app = Commands(
    help="Shards: synthesise, convert, check, describe.", no_args_is_help=True, rich_markup_mode="markdown"
)
data_app.add_typer(convert_app, name="convert")

Out = Annotated[Path, typer.Argument(help="Folder for the shards.")]
Root = Annotated[Path, typer.Argument(help="Folder with manifest.json.")]


@data_app.command()
def synth(
    out: Out,
    clips: Annotated[int, typer.Option(help="Number of clips over all splits.")] = 512,
    workers: Workers = 2,
    sets: Annotated[
        list[str] | None,
        set_option(
            "What to make: seed=1; layout=body133 (default wholebody363, with hands and face); "
            "dances={}, which adds dances with their music; actions=all, ..."
        ),
    ] = None,
) -> None:
    """Procedural whole-body motion whose captions are true.

    Example: `motionloom data synth shards --clips 200`
    """
    from motionloom.datasets.synth.generate import SynthConfig, synthesize

    config = SynthConfig.parse({"clips": clips, **fields_of(sets, "--set")}, "data synth")
    require_folder(out)
    say_manifest(synthesize(config, out, workers=workers), out, make_console())


@data_app.command()
def join(out: Annotated[str, typer.Argument(help="Folder or bucket with the shards of all parts.")]) -> None:
    """One data set of the parts that `data convert --part` made; one that is missing is named.

    Example: `motionloom data join shards`
    """
    from motionloom.datasets.shards.finish import join_parts

    console = make_console()
    manifest = join_parts(out)
    say_manifest(manifest, out, console)
    for note in manifest.notes:
        say(console, f"note: {note}")


@data_app.command()
def copy(
    source: Annotated[str, typer.Argument(metavar="SRC", help="Folder or URL of a data set.")],
    target: Annotated[
        str, typer.Argument(metavar="DST", help="Folder, s3://BUCKET/FOLDER or hf://datasets/OWNER/NAME.")
    ],
) -> None:
    """Carry a data set to a bucket, the hub or a folder, or back; every file is compared by its sha256.

    Given again it goes on: what lies there whole is not sent. The manifest goes last.

    Example: `motionloom data copy shards s3://my-bucket/shards`
    """
    from motionloom.datasets.shards.copy import copy_dataset

    console = make_console()
    copied = copy_dataset(source, target, progress=console.is_terminal)
    say(console, f"{target}: {copied.sent} files sent, {copied.kept} were there")


@data_app.command()
def remove(
    root: Root,
    subject: Annotated[
        list[str] | None, typer.Option(help="All clips of a person or folder; may be repeated.")
    ] = None,
    clip: Annotated[list[str] | None, typer.Option("--id", help="One clip; may be repeated.")] = None,
) -> None:
    """Clips out of a set for good, without its source; later conversions into the folder keep them out.

    Killed, give it again. Copies of the set and models trained on it stay as they are.

    Example: `motionloom data remove shards --subject anna`
    """
    from motionloom.datasets.convert.common.removed import remove

    made = remove(root, ids=clip or (), subjects=subject or ())
    say(
        make_console(),
        f"{root}: {made.clips:,} clips removed; {made.shards:,} shards written again; removed.json keeps "
        f"them out of later conversions",
    )


@data_app.command()
def check(
    root: Root,
    strict: Annotated[bool, typer.Option("--strict", help="Warnings count as problems.")] = False,
    as_json: AsJson = False,
) -> None:
    """Checksums, schema, finite values, ranges, people on a floor, duplicates, leaks. Exit code 1 and a list.

    Example: `motionloom data check shards`
    """
    from motionloom.datasets.base.pool import usable_cores
    from motionloom.datasets.check.dataset import examine

    console = make_console(aside=as_json)
    if not root.exists():
        raise UserError(f"{root}: no such folder")
    report = examine(root, workers=usable_cores(), progress=console.is_terminal)
    for title, problems in (("warning: ", report.warnings), ("", report.errors)):
        findings = [Dropped(source=problem.where, reason=problem.message) for problem in problems]
        for group in grouped(findings):
            if group.count > _ALIKE:
                first = group.members[0]
                others = f"(and {group.count - 1:,} more like it; each: --json)"
                say(console, f"{title}{first.source}: {first.reason} {others}")
                continue
            for finding in group.members:
                say(console, f"{title}{finding.source}: {finding.reason}")
    if report.warning_kinds:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(report.warning_kinds.items()))
        say(console, f"{root}: warnings: {counts}")
    count = sum(report.error_kinds.values()) + strict * sum(report.warning_kinds.values())
    console.print(f"{root}: {count} problems" if count else f"{root}: no problems", markup=False)
    if as_json:
        print_json({"path": root, "problems": count, **plain(report)})
    raise typer.Exit(1 if count else 0)


@data_app.command()
def report(
    root: Root,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; default ROOT/report.html.")
    ] = None,
) -> None:
    """One self-contained page about a data set: counts, captions, rejected clips, clips to watch.

    Example: `motionloom data report shards -o shards.html`
    """
    from motionloom.pipeline.results.data_page import write_data_report

    console = make_console()
    path = out or root / "report.html"
    require_file_place(path, ".html")
    write_data_report(root, path, progress=console.is_terminal)
    console.print(str(path), markup=False, soft_wrap=True)
