"""`motionloom data clean`: suspect clips on a page, and what a person decided about them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from motionloom.datasets.base.records import Decisions
from motionloom.datasets.base.register import register
from motionloom.pipeline.cli.data import Root
from motionloom.pipeline.contract.command import Command
from motionloom.pipeline.launch.console import make_console, say
from motionloom.pipeline.store.files import require_file_place

_SUSPECTS = 60
"""Suspects on the page, at most: the worst."""


def clean(
    root: Root,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The page; default ROOT/clean.html.")
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Also judge captions by this run's, export's or shipped model's TMA.")
    ] = None,
    decisions: Annotated[
        Path | None,
        typer.Option(
            help="Leave out and keep what a file that the page saved says; `none` forgets all decisions, and "
            "every clip is back."
        ),
    ] = None,
) -> None:
    """Suspect clips on a page to watch and decide about; what is left out is listed, and nothing deleted.

    Duplicates, mirrored twins, feet off the floor, jumps, flipped limbs, frozen stretches, jitter, swapped
    sides, nobody at all; with --model captions that fit another clip better.

    Example: `motionloom data clean shards -o clean.html`

    Example: `motionloom data clean shards --decisions decisions.json`
    """
    console = make_console()
    page = out or root / "clean.html"
    # Imported here, so that `--help` stays quick.
    from motionloom.pipeline.curation.clean_page import kinds_of, suspects_of, write_clean_page
    from motionloom.pipeline.curation.suspects import decide, undo

    if decisions is not None:
        if decisions == Path("none"):
            manifest = undo(root)
        else:
            manifest = decide(root, Decisions.load_json(decisions), str(decisions))
        say(
            console,
            f"{root}: {len(manifest.excluded)} clips are left out; stages that read this set run again",
        )
        return
    require_file_place(page, ".html")
    found = suspects_of(root, model, progress=console.is_terminal)
    for suspect in list(found.values())[:_SUSPECTS]:
        say(console, f"{suspect.id}: {'; '.join(fault.text for fault in suspect.faults)}")
    write_clean_page(root, page, found, _SUSPECTS)
    kinds = ", ".join(f"{count} {kind}" for kind, count in kinds_of(found).items())
    say(console, f"{page}: {len(found)} suspects{f' ({kinds})' if kinds else ''}")


register(Command("data clean", clean))
